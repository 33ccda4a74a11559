"""Pages from the templates of this package; all inserted values are escaped."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib.resources import files
from pathlib import Path

from crosscue.replay.files.whole_file import write_text


def write_page(
    path: Path,
    template: str,
    content: Mapping[str, object],
    formats: Mapping[str, Callable[..., str]],
) -> None:
    """Render a template and write the page.

    Args:
        path: The output file.
        template: The template's file name, with its ending.
        content: Values by their names in the template; a missing name is an error, never left
            empty.
        formats: Functions that the template calls.

    Raises:
        OutputError: The file cannot be written.
    """
    write_text(path, page_template(template, formats)(content))


def page_template(
    template: str, formats: Mapping[str, Callable[..., str]]
) -> Callable[[Mapping[str, object]], str]:
    """Load a template for many pages.

    Args:
        template: The template's file name, with its ending.
        formats: Functions that the template calls.

    Returns:
        Function from the content to the HTML.
    """
    from jinja2 import Environment, StrictUndefined

    environment = Environment(
        autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.globals |= formats
    compiled = environment.from_string(template_text(template))
    return lambda content: compiled.render(**content)


def template_text(name: str) -> str:
    """Return the unchanged text of a file in the folder of the templates."""
    return files("crosscue.eval.report").joinpath("templates", name).read_text(encoding="utf-8")
