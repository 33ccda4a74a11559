"""Sphinx settings; ``make docs`` builds the site with warnings as errors."""

import atexit
import os
import shutil
import sys
import tempfile
from importlib.metadata import version as installed
from pathlib import Path

HERE = Path(__file__).parent
# Sphinx reads only what lies below this folder.
shutil.rmtree(HERE / "notebooks", ignore_errors=True)
shutil.copytree(HERE.parent / "notebooks", HERE / "notebooks")

sys.path.insert(0, str(HERE / "extensions"))

# Notebooks about the same drive share what detectors found, in no cache of the user's.
CACHE = tempfile.mkdtemp()
os.environ["XDG_CACHE_HOME"] = CACHE
atexit.register(shutil.rmtree, CACHE, ignore_errors=True)

project = "crosscue"
author = "the crosscue developers"
release = installed("crosscue")
copyright = "the crosscue developers, Apache-2.0"  # noqa: A001

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
    "crosscue_reference",
    "crosscue_math",
]
exclude_patterns = ["_build", "extensions"]
html_theme = "furo"
html_title = "crosscue"
html_math_renderer = "mathml"
nitpicky = True
nitpick_ignore_regex = [
    # Types of libraries whose own documentation is not consulted offline.
    ("py:.*", r"(numpy|np|pyarrow|pa|pathlib|collections|typing|NDArray|polars|pandas)(\..*)?"),
    # Private modules: the interface documents what is public of them under its public name.
    ("py:.*", r"crosscue\.(replay|detectors|fusion|localization|datasets|eval|results)\..*"),
    # Private types in annotations, and what pydantic says of a field with limits.
    ("py:class", r"[A-Z]\w*|.*[ =(].*"),
    ("py:.*", r"(contextlib|ExitStack|Bytes)(\..*)?"),
    ("py:.*", r"(Path|Sequence|Mapping|Callable|Iterator|Iterable|Any|Final|Literal|Detector)"),
]
myst_enable_extensions = ["dollarmath", "deflist", "colon_fence"]
myst_heading_anchors = 3
autodoc_typehints = "description"
autodoc_member_order = "bysource"
napoleon_google_docstring = True
# Not "cache": it compares the text of a notebook, and the code that it calls may have changed.
nb_execution_mode = "force"
nb_execution_raise_on_error = True
nb_execution_show_tb = True
nb_execution_timeout = 600
