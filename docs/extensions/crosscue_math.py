"""Equations as MathML, which browsers draw themselves: pages need no script and no network."""

import re
from typing import Any, Final

from docutils import nodes
from latex2mathml.converter import convert
from sphinx.application import Sphinx
from sphinx.writers.html5 import HTML5Translator

_TAG: Final = re.compile(r"\\tag\{(\w+)\}")


def _inline(page: HTML5Translator, node: nodes.math) -> None:
    page.body.append(convert(node.astext()))
    raise nodes.SkipNode


def _block(page: HTML5Translator, node: nodes.math_block) -> None:
    # The converter puts a tag right behind its equation.
    text = _TAG.sub(r"\\qquad (\1)", node.astext())
    page.body.append(page.starttag(node, "div", CLASS="math", STYLE="margin: 0.8em 0"))
    page.body.append(convert(text, display="block"))
    page.body.append("</div>\n")
    raise nodes.SkipNode


def setup(app: Sphinx) -> dict[str, Any]:
    """Register the renderer, which ``html_math_renderer`` selects."""
    app.add_html_math_renderer("mathml", (_inline, None), (_block, None))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
