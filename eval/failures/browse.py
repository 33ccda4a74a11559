"""Write failures as a static site to browse, which needs neither a server nor a build.

Lists have a hundred failures per page. A script on the first page filters and sorts all failures.
Browsers without scripts use the lists by kind, cue, cause, condition and distance. The same
failures and runs yield the same bytes.
"""

from __future__ import annotations

import base64
import hashlib
import json
import re
import shlex
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, ClassVar, Final
from urllib.parse import quote

import numpy as np
import pyarrow as pa
from markupsafe import Markup
from numpy.typing import NDArray

from crosscue.datasets.truth.truth import FILE
from crosscue.eval.failures.order import ranked
from crosscue.eval.pipeline.run import moved_to
from crosscue.eval.report.frame_pictures import draw_pictures
from crosscue.eval.report.html import page_style, page_template, style_of, template_text
from crosscue.eval.report.svg_plot import Panel, SvgChart
from crosscue.eval.runs import owned
from crosscue.eval.runs.folder import RunFolder, open_run
from crosscue.eval.runs.tables.columns import LOG_TIME
from crosscue.eval.scoring.runs import remembered_truth
from crosscue.replay.errors import CrosscueError, EmptyResultError, UsageError
from crosscue.replay.files.whole_file import write_bytes, write_text
from crosscue.replay.limits import DEFAULT_LIMITS, Limits, LimitsGiven
from crosscue.replay.processes import in_processes
from crosscue.replay.progress import Progress, emit
from crosscue.replay.safe_text import counted, visible
from crosscue.replay.vehicle.fusion import NOT_FEATURES
from crosscue.results import HIDDEN, Result
from crosscue.verb import Option, keywords

from .record import Failure, distance_bin, read_failures
from .search import ENDINGS, Failures, FailureSettings, search

MARKER: Final = "crosscue_site.json"
PER_PAGE: Final = 100
FACETS: Final = ("kind", "cue", "cause", "condition", "distance")
WEB_VIEWER: Final = "http://127.0.0.1:9090/?url=" + quote("rerun+http://127.0.0.1:9876/proxy", "")

AROUND_S: Final = 6.0
WIDTH: Final = 560.0
LANES: Final = 8
THRESHOLD: Final = 0.9
# Max gap that a line is drawn across, seconds.
BREAK_S: Final = 1.0


@dataclass(frozen=True, slots=True)
class Entry:
    """A failure and its page in the site.

    Attributes:
        number: Rank by severity, from 1.
        failure: The failure.
        picture: File name of its picture in ``p`` and of its thumbnail in ``t``.
    """

    number: int
    failure: Failure
    picture: str

    @property
    def page(self) -> str:
        """File name of its page in ``f``."""
        return f"{self.number:05d}.html"

    def facets(self, facet: str) -> tuple[str, ...]:
        """Return the values of a facet under which the failure is listed."""
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
    """Work on one run's failures, picklable so that it can run in another process.

    Attributes:
        site: Folder of the site.
        total: Number of failures of the site.
        logs: Folder to which the runs' logs have moved, if any.
        limits: Limits on the declared size of a chunk of a log.
        truth: Truth of all runs; None for that of each run's last score.
    """

    site: Path
    total: int
    logs: Path | None
    limits: Limits
    truth: Path | None = None

    def __call__(self, entries: Sequence[Entry]) -> tuple[frozenset[str], str]:
        """Write pictures and pages; return the pictures written and why others are missing."""
        run = open_run(Path(entries[0].failure.run), self.logs, limits=self.limits)
        names = {one.failure.t_ns: one.picture for one in entries}
        written: set[str] = set()

        def keep(t_ns: int, picture: bytes, small: bytes) -> None:
            write_bytes(self.site / "p" / names[t_ns], picture)
            write_bytes(self.site / "t" / names[t_ns], small)
            written.add(names[t_ns])

        known = remembered_truth(run) if self.truth is None else None
        truth = self.truth if known is None else known.path
        if truth is not None and truth.is_dir():
            truth = truth / FILE
        why = draw_pictures(run, names, keep, truth=truth)
        rows, render = _rows(run), page_template("failure.html.j2")
        command = f"crosscue view {shlex.quote(entries[0].failure.run)}"
        if self.truth is not None:
            command += f" --truth {shlex.quote(str(self.truth))}"
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
                "viewer": WEB_VIEWER,
                "command": f"{command} --at {one.failure.at_s:.3f}",
                "has_truth": truth is not None,
            }
            write_text(self.site / "f" / one.page, render(content))
        return frozenset(written), why


def site_entries(failures: Sequence[Failure]) -> tuple[Entry, ...]:
    """Return failures with their ranks and picture names; failures of one frame share a picture."""
    runs = {run: number for number, run in enumerate(dict.fromkeys(f.run for f in failures), 1)}
    return tuple(
        Entry(number, one, f"{runs[one.run]:04d}-{one.t_ns}.jpg")
        for number, one in enumerate(failures, 1)
    )


def by_run(entries: Sequence[Entry]) -> tuple[tuple[Entry, ...], ...]:
    """Group entries by run."""
    found: dict[str, list[Entry]] = {}
    for one in entries:
        found.setdefault(one.failure.run, []).append(one)
    return tuple(tuple(some) for some in found.values())


def write_lists(site: Path, entries: Sequence[Entry], pictures: frozenset[str]) -> None:
    """Write the pages of lists, the style sheet, and the file that marks the folder as a site.

    Args:
        site: Folder of the site.
        entries: All failures.
        pictures: File names of the pictures that could be read.

    Raises:
        OutputError: A file cannot be written.
    """
    write_text(site / "style.css", page_style())
    render = page_template("failures.html.j2")
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
    owned.write_marker(site / MARKER, {"format": 1, "failures": len(entries)})


def _pages(
    entries: Sequence[Entry], first: str, others: str
) -> Iterator[tuple[bool, str, Sequence[Entry], Sequence[str]]]:
    """Yield for each page: True if it is the first, its name and entries, and all pages' names."""
    count = max(-(-len(entries) // PER_PAGE), 1)
    names = [first, *(f"{others}-{number:04d}" for number in range(2, count + 1))]
    for k, name in enumerate(names):
        yield k == 0, name, entries[PER_PAGE * k : PER_PAGE * (k + 1)], names


def _facets(entries: Sequence[Entry]) -> Mapping[str, Mapping[str, tuple[str, int]]]:
    """Return the page name and number of failures by facet and value, the largest first."""
    found: dict[str, dict[str, tuple[str, int]]] = {}
    for facet in FACETS:
        counts = Counter(value for one in entries for value in one.facets(facet))
        found[facet] = {}
        for value, count in sorted(counts.items(), key=lambda pair: (-pair[1], pair[0])):
            plain = re.sub(r"[^a-z0-9]+", "-", value.lower()).strip("-")[:40]
            # Two values may have the same plain text; their digests differ.
            digest = hashlib.sha256(value.encode()).hexdigest()[:6]
            found[facet][value] = f"{facet}-{plain}-{digest}", count
    return found


def _rows_json(entries: Sequence[Entry], pictures: frozenset[str]) -> str:
    """Return the script's rows as JSON that is safe inside a page."""
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


def _rows(run: RunFolder) -> ChartTables:
    tables = (run.filled(name) for name in ("belief", "cues"))
    return ChartTables(*(None if one is None else one.sort_by("t_ns") for one in tables))


@dataclass(frozen=True, slots=True, eq=False)
class ChartTables:
    """Tables of a run's belief and cues for its charts; None where missing."""

    belief: pa.Table | None
    cues: pa.Table | None


def belief_around(rows: ChartTables, failure: Failure) -> Markup | None:
    """Draw the probabilities within 6 s of a failure; return None for a run without belief."""
    if rows.belief is None:
        return None
    t_s = _seconds(rows.belief["t_ns"].to_numpy(), failure.t_ns)
    near = np.flatnonzero(np.abs(t_s) <= AROUND_S)
    if not len(near):
        return None
    lanes = _lanes(rows.cues, failure)
    panel = Panel(130, 30, WIDTH - 150, 150, (-AROUND_S, AROUND_S), (0.0, 1.0))
    drawing = SvgChart(
        WIDTH,
        panel.bottom + 44 + 15.0 * len(lanes),
        f"Belief around {failure.at_s:g} s",
        "Probability of each feature over the seconds around the failure; "
        "below, the frames in which each cue was found.",
    )
    begin, end = (
        float(np.clip(_seconds(np.array([t]), failure.t_ns)[0], -AROUND_S, AROUND_S))
        for t in (failure.start_ns, failure.end_ns)
    )
    left, right = panel.x(begin), panel.x(end)
    drawing.rect(left, panel.top, max(right - left, 1.0), panel.height, "span")
    drawing.axes(panel, "seconds from the failure", "", y_ticks=[0.0, 0.5, 1.0])
    drawing.rule(panel.left, panel.y(THRESHOLD), panel.right, panel.y(THRESHOLD), "line dash")
    names = [name for name in rows.belief.column_names if name not in (*NOT_FEATURES, *LOG_TIME)]
    breaks = np.flatnonzero(np.diff(t_s[near]) > BREAK_S) + 1
    times = np.insert(t_s[near], breaks, np.nan)
    for name in names:
        values = rows.belief[name].to_numpy(zero_copy_only=False).astype(np.float64)[near]
        style = f"line {style_of(name)}{' thick' if name == failure.what else ''}"
        drawing.curve(panel, times, np.insert(values, breaks, np.nan), style)
    drawing.rule(panel.x(0.0), panel.top, panel.x(0.0), panel.bottom, "line now")
    drawing.legend(10, 14, [(f"line {style_of(name)}", name) for name in names])
    for lane, (name, found_s) in enumerate(lanes):
        y = panel.bottom + 46 + 15.0 * lane
        drawing.text(panel.left - 6, y, name.replace("_", " "), anchor="end")
        for first_s, last_s in found_s:
            x = panel.x(first_s)
            drawing.rect(x, y - 8, max(panel.x(last_s) - x, 1.5), 8, "bar")
    return drawing.svg()


def _seconds(t_ns: NDArray[np.int64], zero_ns: int) -> NDArray[np.float64]:
    return np.asarray((t_ns - zero_ns) * 1e-9, np.float64)


def _lanes(
    cues: pa.Table | None, failure: Failure
) -> Sequence[tuple[str, list[tuple[float, float]]]]:
    """Return the time spans of the cues found around a failure, the most frequent cue first."""
    if cues is None:
        return []
    t_s = _seconds(cues["t_ns"].to_numpy(), failure.t_ns)
    near = np.flatnonzero((np.abs(t_s) <= AROUND_S) & (cues["count"].to_numpy() > 0))
    names = cues["cue"].take(near).to_pylist()
    by_cue: dict[str, list[float]] = {}
    for name, when in zip(names, t_s[near].tolist(), strict=True):
        by_cue.setdefault(name, []).append(when)
    ordered = sorted(by_cue.items(), key=lambda pair: (-len(pair[1]), pair[0]))[:LANES]
    return [(name, _spans(np.array(sorted(times)))) for name, times in ordered]


def _spans(times: NDArray[np.float64]) -> list[tuple[float, float]]:
    step = max(float(np.median(np.diff(times))) if len(times) > 2 else 0.1, 0.02)
    parts = np.split(times, np.flatnonzero(np.diff(times) > 2.5 * step) + 1)
    return [(float(part[0]), float(part[-1]) + 0.5 * step) for part in parts]


# Number of reasons for missing pictures to print.
PRINTED: Final = 3


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Site(Result):
    """A static site of failures; its text is the output of ``crosscue browse``.

    Attributes:
        index: First page of the site.
        failures: Number of failures.
        pictures: Number of frames with a picture.
        without_picture: Number of failures without a picture.
        reasons: Reasons for missing pictures.
        found: The failures; None if they were read from a table.
    """

    index: Path
    failures: int
    pictures: int
    without_picture: int
    reasons: tuple[str, ...]
    found: Failures | None = field(metadata=HIDDEN)

    also: ClassVar = {"failed": "failed"}

    @property
    def is_whole(self) -> bool:
        """True if every run could be examined."""
        return self.found is None or not self.found.failed

    @property
    def failed(self) -> Mapping[Path, CrosscueError]:
        """Errors of the runs that could not be examined."""
        return {} if self.found is None else self.found.failed

    def lines(self) -> Iterator[str]:
        """Yield counts, reasons of missing pictures, and the page to open."""
        yield f"failures   {self.failures:,}, {counted(self.pictures, 'picture')}"
        if self.without_picture:
            yield f"           {counted(self.without_picture, 'failure')} without a picture"
        yield from (f"           {visible(why)}" for why in self.reasons[:PRINTED])
        if len(self.reasons) > PRINTED:
            yield f"           and {counted(len(self.reasons) - PRINTED, 'more reason')} (--json)"
        yield from (f"left out   {visible(str(error))}" for error in self.failed.values())
        yield f"open       {visible(str(self.index.resolve()))}"


@dataclass(frozen=True, slots=True, kw_only=True)
class BrowseSettings(FailureSettings):
    """Settings of a site of failures.

    Attributes:
        logs: Folder that the run's logs have moved to; they are recognised by content.
        limits: Limits for reading the logs.
        overwrite: Replace an existing site.
    """

    logs: Annotated[Path | str | None, Option(metavar="DIR")] = None
    limits: LimitsGiven = DEFAULT_LIMITS
    overwrite: bool = False


@keywords(BrowseSettings, 2)
def browse(
    runs: Annotated[Sequence[str | Path] | Path | str, Option(metavar="RUN")],
    output: Path | str,
    settings: BrowseSettings,
) -> Site:
    """Write failures as a static site with pictures and filters.

    It needs no server. RUN is a run folder, a folder of runs, or a table from crosscue failures.
    Open index.html in a browser. Each failure is shown with its picture (with boxes, masks and
    regions), the belief around that time, and the command that opens Rerun at that time.

    Examples:
        crosscue browse runs -o site
        crosscue browse worst.parquet -o site

    Args:
        runs: Run folders, folders of them, or a table.
        output: Folder of the site.
        settings: What to show.

    Raises:
        UsageError: A value is out of range, or a table is combined with other runs.
        EmptyResultError: There is no failure.
        UsageError: ``overwrite`` would delete files that an earlier call did not write.
        OutputError: The folder is not empty, or cannot be written.
    """
    folder = Path(output)
    owned.check_place(folder, MARKER, overwrite=settings.overwrite)
    moved = moved_to(settings.logs)
    chosen, found = _given(runs, settings)
    if not chosen:
        raise EmptyResultError(f"{folder}: no failure to show; nothing was written")
    entries = site_entries(chosen)
    with owned.new_folder(folder, MARKER) as made:
        for part in ("f", "p", "t", "by"):
            (made / part).mkdir()
        truth = None if settings.truth is None else Path(settings.truth)
        work = RunWork(made, len(entries), moved, settings.limits, truth)
        groups, pictures, reasons = by_run(entries), frozenset[str](), []
        for done, (written, why) in enumerate(in_processes(work, groups, settings.workers), 1):
            pictures |= written
            reasons += [why] if why else []
            emit(Progress("drawing", done, len(groups), "runs"))
        write_lists(made, entries, pictures)
    bare = sum(one.picture not in pictures for one in entries)
    return Site(
        folder / "index.html", len(entries), len(pictures), bare, tuple(sorted(set(reasons))), found
    )


def _given(
    runs: Sequence[Path | str] | Path | str, settings: FailureSettings
) -> tuple[tuple[Failure, ...], Failures | None]:
    """Return the failures of runs or of a table, and, for runs, how they were found."""
    given = [Path(one) for one in ([runs] if isinstance(runs, Path | str) else runs)]
    if any(one.suffix in ENDINGS for one in given):
        if len(given) > 1 or settings.top is not None:
            raise UsageError(f"{given[0]}: expected either runs, or one table without --top")
        return ranked(read_failures(given[0])), None
    found = search(given, settings)
    return ranked(found.failures), found
