"""A static site of failures: pages, pictures and charts that need no server and no build.

Lists are pages of a hundred; a script on the first page, which works without the others, filters
and sorts all failures there. Without the script, pages by kind, cue, cause, condition and distance
do. The same failures and runs give the same bytes.
"""

from __future__ import annotations

import base64
import hashlib
import json
import re
import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final
from urllib.parse import quote

from crosscue.eval.report.html import page_template, template_text
from crosscue.eval.runs.folder import RunFolder, open_run
from crosscue.replay.base import Limits, strict_json, write_bytes, write_text

from .chart import RunRows, belief_around
from .pictures import draw_pictures
from .record import Failure, distance_bin

if TYPE_CHECKING:
    import pyarrow as pa

MARKER: Final = "crosscue_site.json"
PER_PAGE: Final = 100
FACETS: Final = ("kind", "cue", "cause", "condition", "distance")
WEB_VIEWER: Final = "http://127.0.0.1:9090/?url=" + quote("rerun+http://127.0.0.1:9876/proxy", "")


@dataclass(frozen=True, slots=True)
class Entry:
    """A failure and its place in the site.

    Attributes:
        number: From 1, by severity.
        failure: The failure.
        picture: File name of its picture in ``p`` and ``t``.
    """

    number: int
    failure: Failure
    picture: str

    @property
    def page(self) -> str:
        """File name of its page in ``f``."""
        return f"{self.number:05d}.html"

    def facets(self, facet: str) -> tuple[str, ...]:
        """The values by which it is found."""
        one = self.failure
        return {
            "kind": (one.kind,),
            "cue": (one.what,),
            "cause": (one.cause,),
            "condition": one.conditions or ("none",),
            "distance": (distance_bin(one.distance_m),),
        }[facet]


@dataclass(frozen=True, slots=True)
class RunWork:
    """What is done for one run, here or in another process.

    Attributes:
        site: Folder.
        total: Failures of the site.
        logs: Where the runs' logs have moved to, if they have.
        has_recordings: Each failure has a recording beside its page.
        limits: On what one chunk of a log may declare.
    """

    site: Path
    total: int
    logs: Path | None
    has_recordings: bool
    limits: Limits

    def __call__(self, entries: Sequence[Entry]) -> tuple[frozenset[str], str]:
        """Write pictures and pages of one run's failures; pictures written, why some are not."""
        run = open_run(Path(entries[0].failure.run), self.logs, limits=self.limits)
        names = {one.failure.t_ns: one.picture for one in entries}
        written: set[str] = set()

        def keep(t_ns: int, picture: bytes, small: bytes) -> None:
            write_bytes(self.site / "p" / names[t_ns], picture)
            write_bytes(self.site / "t" / names[t_ns], small)
            written.add(names[t_ns])

        why = draw_pictures(run, names, keep)
        rows, render = _rows(run), page_template("failure.html.j2", {"number": _number})
        for one in entries:
            content = {
                "one": one.failure,
                "entry": one,
                "total": self.total,
                "picture": one.picture if one.picture in written else None,
                "why": why or "it cannot be decoded",
                "chart": belief_around(rows, one.failure),
                "before": f"{one.number - 1:05d}.html" if one.number > 1 else None,
                "after": f"{one.number + 1:05d}.html" if one.number < self.total else None,
                "recording": f"{one.number:05d}.rrd" if self.has_recordings else None,
                "viewer": WEB_VIEWER,
                "command": shlex.quote(one.failure.run),
            }
            write_text(self.site / "f" / one.page, render(content))
        return frozenset(written), why


def entries_of(failures: Sequence[Failure]) -> tuple[Entry, ...]:
    """Failures with their numbers and the names of their pictures, one for each frame."""
    runs = {run: number for number, run in enumerate(dict.fromkeys(f.run for f in failures), 1)}
    return tuple(
        Entry(number, one, f"{runs[one.run]:04d}-{one.t_ns}.jpg")
        for number, one in enumerate(failures, 1)
    )


def by_run(entries: Sequence[Entry]) -> tuple[tuple[Entry, ...], ...]:
    """Those of each run together."""
    found: dict[str, list[Entry]] = {}
    for one in entries:
        found.setdefault(one.failure.run, []).append(one)
    return tuple(tuple(some) for some in found.values())


def write_lists(site: Path, entries: Sequence[Entry], pictures: frozenset[str]) -> None:
    """Write the pages of lists, the style, and what says that this folder is a site.

    Args:
        site: Folder.
        entries: All failures.
        pictures: File names of the pictures that could be read.

    Raises:
        OutputError: A file cannot be written.
    """
    write_text(site / "style.css", template_text("failures.css"))
    write_text(site / MARKER, strict_json({"format": 1, "failures": len(entries)}) + "\n")
    render = page_template("failures.html.j2", {"number": _number})
    facets = _facets(entries)
    script = template_text("failures.js")
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    common = {"total": len(entries), "facets": facets, "pictures": pictures}
    with_script = {"script": script, "digest": digest, "rows": _rows_json(entries, pictures)}
    without: dict[str, Any] = {"script": "", "digest": "", "rows": ""}
    for first, name, some, names in _pages(entries, "index", "page"):
        more = with_script if first else without
        page = {"title": "Failures", "entries": some, "name": name, "names": names, "up": ""}
        write_text(site / f"{name}.html", render(common | more | page))
    for facet, values in facets.items():
        for value, (slug, _) in values.items():
            mine = [one for one in entries if value in one.facets(facet)]
            title = f"{facet}: {value.replace('_', ' ')}"
            for _, name, some, names in _pages(mine, slug, slug):
                page = {"title": title, "entries": some, "name": name, "names": names, "up": "../"}
                write_text(site / "by" / f"{name}.html", render(common | without | page))


def _pages(
    entries: Sequence[Entry], first: str, others: str
) -> Iterator[tuple[bool, str, Sequence[Entry], Sequence[str]]]:
    """Whether it is the first page, its name, its entries, and the names of all pages."""
    count = max(-(-len(entries) // PER_PAGE), 1)
    names = [first, *(f"{others}-{number:04d}" for number in range(2, count + 1))]
    for k, name in enumerate(names):
        yield k == 0, name, entries[PER_PAGE * k : PER_PAGE * (k + 1)], names


def _facets(entries: Sequence[Entry]) -> Mapping[str, Mapping[str, tuple[str, int]]]:
    """By facet and value: the name of its page and how many failures, the most first."""
    found: dict[str, dict[str, tuple[str, int]]] = {}
    for facet in FACETS:
        counts: dict[str, int] = {}
        for one in entries:
            for value in one.facets(facet):
                counts[value] = counts.get(value, 0) + 1
        found[facet] = {}
        for value, count in sorted(counts.items(), key=lambda pair: (-pair[1], pair[0])):
            plain = re.sub(r"[^a-z0-9]+", "-", value.lower()).strip("-")[:40]
            # Two values may read alike once plain; their digests differ.
            digest = hashlib.sha256(value.encode()).hexdigest()[:6]
            found[facet][value] = f"{facet}-{plain}-{digest}", count
    return found


def _rows_json(entries: Sequence[Entry], pictures: frozenset[str]) -> str:
    """What the script lists, as JSON that is safe inside a page."""
    rows = [
        [
            one.failure.kind,
            one.failure.what,
            one.failure.cause,
            list(one.facets("condition")),
            None if one.failure.distance_m is None else round(one.failure.distance_m, 1),
            round(one.failure.severity, 2),
            Path(one.failure.run).name,
            one.failure.at_s,
            one.picture if one.picture in pictures else "",
            one.facets("distance")[0],
        ]
        for one in entries
    ]
    return json.dumps(rows, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")


def _rows(run: RunFolder) -> RunRows:
    def table(name: str) -> pa.Table | None:
        return run.table(name).sort_by("t_ns") if run.file(f"{name}.parquet").exists() else None

    return RunRows(table("belief"), table("cues"))


def _number(value: float | None, digits: int = 1) -> str:
    return "-" if value is None else f"{value:.{digits}f}"
