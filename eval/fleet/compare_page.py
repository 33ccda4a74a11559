"""Page of a comparison: what got better, worse or stayed undecided, and where two runs differ."""

import base64
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from crosscue.eval.catalog.compare import Comparison
from crosscue.eval.failures.record import APART_NS
from crosscue.eval.report.frame_pictures import draw_pictures
from crosscue.eval.report.html import words, write_page
from crosscue.eval.runs.folder import MANIFEST, RunFolder, open_run
from crosscue.eval.runs.moments import seconds_into, span_ns
from crosscue.eval.scoring.runs import remembered_truth
from crosscue.replay.columns import Int64s
from crosscue.replay.vehicle.fusion import NOT_FEATURES

MAX_PAIRS: Final = 4
# Min difference of a probability that is shown.
APART: Final = 0.5


class Difference(NamedTuple):
    """Successive frames in which two runs of one drive differ.

    Attributes:
        runs: The run before and the run after.
        t_ns: Time of the frame that is shown.
        text: What differs.
        frames: Number of frames.
    """

    runs: tuple[RunFolder, RunFolder]
    t_ns: int
    text: str
    frames: int


def write_compare_page(
    path: Path, found: Comparison, before: Sequence[Path], after: Sequence[Path]
) -> None:
    """Write the page, with pictures of the largest differences of runs of the same drive.

    Raises:
        RunError: A table is damaged.
        OutputError: The page cannot be written.
    """
    drives = {_drive(run): run for run in _runs(before)}
    differences = [
        one
        for run in _runs(after)
        if _drive(run) in drives
        for one in differences_of(drives[_drive(run)], run)
    ]
    # The largest of each subject before a second one of any.
    differences.sort(key=lambda one: (-one.frames, one.t_ns, one.text))
    firsts = {one.text: one for one in reversed(differences)}
    chosen = [one for one in differences if firsts[one.text] is one]
    chosen += [one for one in differences if firsts[one.text] is not one]
    judged = [one for one in found.judged if one.before != one.after]
    content = {
        "title": "Comparison",
        "found": found,
        "verdicts": [
            (verdict, [one for one in judged if one.verdict == verdict])
            for verdict in ("worse", "better", "undecided", "too few places")
        ],
        "equal": len(found.judged) - len(judged),
        "sides": (_named(before), _named(after)),
        "pairs": [_pictured(one) for one in chosen[:MAX_PAIRS]],
    }
    write_page(path, "compare.html.j2", content)


def differences_of(before: RunFolder, after: RunFolder) -> Iterator[Difference]:
    """Yield where two runs of one drive found other cues, or believed something else."""
    runs = before, after
    sides = [_found(run) for run in runs]
    for name in sorted(sides[0].keys() & sides[1].keys()):
        (times, values), (other_times, others) = sides[0][name], sides[1][name]
        t_ns, i, k = np.intersect1d(times, other_times, return_indices=True)
        apart = others[k] - values[i]
        for sign, text in ((1, "only after"), (-1, "only before")):
            for part in _episodes(t_ns, sign * apart > APART):
                yield Difference(runs, int(part[len(part) // 2]), f"{name} {text}", len(part))


def _found(run: RunFolder) -> dict[str, tuple[Int64s, np.typing.NDArray[np.float64]]]:
    """Return times and values, 0 to 1, of each cue and of each feature of the belief."""
    found = {}
    if run.file("cues.parquet").exists():
        table = run.table("cues", ["t_ns", "cue", "count"])
        t_ns, cue = table["t_ns"].to_numpy(), np.array(table["cue"].to_pylist(), np.str_)
        is_found = (table["count"].to_numpy() > 0).astype(np.float64)
        for name in np.unique(cue).tolist():
            found[f"{words(name)} found"] = t_ns[cue == name], is_found[cue == name]
    if run.file("belief.parquet").exists():
        table = run.table("belief")
        for name in table.column_names:
            if name not in NOT_FEATURES and str(table.schema.field(name).type) == "double":
                found[f"{words(name)} believed"] = table["t_ns"].to_numpy(), table[name].to_numpy()
    return found


def _episodes(t_ns: Int64s, differs: np.typing.NDArray[np.bool_]) -> list[Int64s]:
    times = t_ns[differs]
    parts = np.split(times, np.flatnonzero(np.diff(times) > APART_NS) + 1)
    return [part for part in parts if len(part)]


def _pictured(one: Difference) -> dict[str, object]:
    """Return a difference with the picture of each side and the command that opens it."""
    sides = []
    for side, run in zip(("before", "after"), one.runs, strict=True):
        drawn: list[str] = []

        def keep(_: int, picture: bytes, __: bytes, drawn: list[str] = drawn) -> None:
            drawn.append(base64.b64encode(picture).decode())

        known = remembered_truth(run)
        truth = None if known is None else known.path
        draw_pictures(run, [one.t_ns], keep, has_candidates=False, truth=truth)
        at_s = seconds_into(span_ns(run)[0], one.t_ns)
        sides.append((side, "".join(drawn), str(run.path), at_s))
    return {"text": one.text, "frames": one.frames, "sides": sides}


def _runs(paths: Sequence[Path]) -> list[RunFolder]:
    """Return the runs; folders of pooled scores have no pictures."""
    return [open_run(path) for path in paths if (path / MANIFEST).exists()]


def _drive(run: RunFolder) -> str:
    return "+".join(sorted(log.identity.digest for log in run.drive_manifest().logs))


def _named(paths: Sequence[Path]) -> str:
    return str(paths[0]) if len(paths) == 1 else f"{len(paths)} runs"
