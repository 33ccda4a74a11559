"""Pages from the templates beside this file; whatever is put into them is escaped."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib.resources import files


def render_page(
    template: str, content: Mapping[str, object], formats: Mapping[str, Callable[..., str]]
) -> str:
    """The HTML of a template.

    Args:
        template: Its file's name, with its ending.
        content: By the names that the template has for it; a name it asks for and is not given is
            an error, never an empty place.
        formats: Functions that the template calls.
    """
    from jinja2 import Environment, StrictUndefined

    environment = Environment(
        autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.globals |= formats
    source = (
        files("crosscue.eval.report").joinpath("templates", template).read_text(encoding="utf-8")
    )
    return environment.from_string(source).render(**content)
