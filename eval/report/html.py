"""Pages from the templates beside this file; whatever is put into them is escaped."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib.resources import files
from pathlib import Path

from crosscue.replay.base import write_text


def write_page(
    path: Path,
    template: str,
    content: Mapping[str, object],
    formats: Mapping[str, Callable[..., str]],
) -> None:
    """Write the page that a template makes.

    Args:
        path: Its file.
        template: The template's file name, with its ending.
        content: By the names that the template has for it; a name it asks for and is not given is
            an error, never an empty place.
        formats: Functions that the template calls.

    Raises:
        OutputError: It cannot be written.
    """
    write_text(path, page_template(template, formats)(content))


def page_template(
    template: str, formats: Mapping[str, Callable[..., str]]
) -> Callable[[Mapping[str, object]], str]:
    """A template that makes many pages.

    Args:
        template: Its file's name, with its ending.
        formats: Functions that the template calls.

    Returns:
        From the content to the HTML.
    """
    from jinja2 import Environment, StrictUndefined

    environment = Environment(
        autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.globals |= formats
    compiled = environment.from_string(template_text(template))
    return lambda content: compiled.render(**content)


def template_text(name: str) -> str:
    """A file beside the templates, as it is."""
    return files("crosscue.eval.report").joinpath("templates", name).read_text(encoding="utf-8")
