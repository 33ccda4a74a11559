"""The one page: head, style, tables and folded parts, which the templates of sections fill.

All inserted values are escaped. A page needs no network; only the first list of failures has a
script.
"""

import math
import shlex
from collections.abc import Callable, Mapping
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any, Final

from crosscue.eval.scoring.intervals import MIN_CLUSTERS, TOO_FEW
from crosscue.replay import colours
from crosscue.replay.files.whole_file import write_text

# Classes of what is drawn, in charts and in their legends.
STYLES: Final[Mapping[str, colours.Colour]] = {
    **{f"s{i}": colours.FEATURES[name] for i, name in enumerate(colours.FEATURES)},
    "s4": colours.OTHERS[0],
    "truth": colours.TRUTH,
    "found": colours.FOUND,
    "sigma": colours.SIGMA,
    "start": colours.START,
    "end": colours.END,
}
# Fraction of white that colours are mixed with on a dark page.
LIGHTER: Final = 0.3


def write_page(
    path: Path,
    template: str,
    content: Mapping[str, object],
    formats: Mapping[str, Callable[..., object]] | None = None,
) -> None:
    """Render the sections of a template into the page and write it.

    Args:
        path: The output file.
        template: The template's file name, with its ending.
        content: Values by their names in the template; a missing name is an error, never left
            empty.
        formats: Functions that the template calls, besides those of every page.

    Raises:
        OutputError: The file cannot be written.
    """
    write_text(path, page_template(template, formats)(content))


def page_template(
    template: str, formats: Mapping[str, Callable[..., object]] | None = None
) -> Callable[[Mapping[str, object]], str]:
    """Load a template for many pages; return the function from the content to the HTML."""
    from jinja2 import Environment, FunctionLoader, StrictUndefined

    environment = Environment(
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        loader=FunctionLoader(template_text),
    )
    environment.globals |= {"style": page_style(), "min_places": MIN_CLUSTERS}
    environment.globals |= {**FORMATS, **(formats or {})}
    environment.filters["words"] = words
    compiled = environment.get_template(template)
    return lambda content: compiled.render(**content)


def template_text(name: str) -> str:
    """Return the unchanged text of a file in the folder of the templates."""
    return files("crosscue.eval.report").joinpath("templates", name).read_text(encoding="utf-8")


@cache
def page_style() -> str:
    """Return the style sheet of every page, with the colours of ``replay.colours``."""

    def variables(lighter: float) -> str:
        named = {**STYLES, "bad": colours.WRONG}
        return " ".join(f"--{name}: {colours.css(one, lighter)};" for name, one in named.items())

    rules = [
        f".p .{n} {{ background: var(--{n}); }} svg .line.{n} {{ stroke: var(--{n}); }} "
        f"svg .fill.{n} {{ fill: var(--{n}); stroke: var(--{n}); fill-opacity: .8; }} "
        f"svg .band.{n} {{ fill: var(--{n}); opacity: .2; }} svg .bar.{n} {{ fill: var(--{n}); }} "
        f".key .{n} {{ background: var(--{n}); }}"
        for n in STYLES
    ]
    text = template_text("page.css")
    text = text.replace("/* light */", variables(0.0)).replace("/* dark */", variables(LIGHTER))
    return "\n".join([text, *rules])


def style_of(feature: str) -> str:
    """Return the class of a feature; user-defined features share one colour."""
    known = [*colours.FEATURES]
    return f"s{known.index(feature) if feature in known else 4}"


def words(name: str) -> str:
    """Return an identifier as words."""
    return name.replace("_", " ")


def shell(text: str) -> str:
    """Return a word of a command, quoted where a shell would split or expand it."""
    return shlex.quote(text)


def number(value: float | None, digits: int = 2) -> str:
    """Return a number, or a dash if it is unknown."""
    return "-" if _is_unknown(value) else f"{value:.{digits}f}"


def rounded(value: float | None) -> str:
    """Return a number with four significant figures."""
    return "-" if _is_unknown(value) else f"{value:.4g}"


def signed(value: float | None, digits: int = 1) -> str:
    """Return a number with its sign, or a dash if it is unknown."""
    return "-" if _is_unknown(value) else f"{value:+.{digits}f}"


def never(value: float | None) -> str:
    """Return a distance, which is None for an event that never happened."""
    return "never" if value is None else "unknown" if math.isnan(value) else f"{value:.1f}"


def ends(low: float | None, high: float | None) -> str:
    """Return the ends of an interval."""
    return "-" if _is_unknown(low) or _is_unknown(high) else f"{low:.2f} to {high:.2f}"


def by_cluster(fraction: Mapping[str, Any]) -> str:
    """Return the interval of a fraction over clusters, or why it is missing."""
    text = ends(fraction["clusters_low"], fraction["clusters_high"])
    return TOO_FEW if text == "-" and fraction["of"] else text


def span(mean: Mapping[str, Any], digits: int = 2) -> str:
    """Return an interval in brackets, or why it is missing; empty without rows."""
    low, high = mean["low"], mean["high"]
    if _is_unknown(low) or _is_unknown(high):
        return f" ({TOO_FEW})" if mean["of"] else ""
    return f" ({low:.{digits}f} to {high:.{digits}f})"


def short(text: str) -> str:
    """Return the name of a version in a few letters."""
    is_hash = len(text) >= 20 and all(letter in "0123456789abcdef" for letter in text)
    return text[:7] if is_hash else text if len(text) <= 9 else text[:8] + "…"


def _is_unknown(value: float | None) -> bool:
    return value is None or not math.isfinite(value)


FORMATS: Final[Mapping[str, Callable[..., object]]] = {
    one.__name__: one
    for one in (shell, number, rounded, signed, never, ends, by_cluster, span, short, style_of)
}
