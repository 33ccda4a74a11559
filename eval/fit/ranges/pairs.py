"""Pairs of an object's height in pixels and its true range, to which curves are fitted."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from crosscue.datasets.truth.truth import FILE, read_truth
from crosscue.detectors.ranging.height_to_range import RangeFit, range_of
from crosscue.eval.runs.folder import RunFolder
from crosscue.replay.columns import Floats, Int64s
from crosscue.replay.errors import AnnotationError, SchemaError
from crosscue.replay.files import door
from crosscue.replay.files.bounded import read_at_most
from crosscue.replay.files.tree_text import json_tree
from crosscue.replay.files.whole_file import write_whole
from crosscue.replay.limits import MIB

MAX_BYTES: Final = 256 * MIB
LABELS: Final[Mapping[str, str]] = {"stop_sign": "stop sign", "traffic_light": "traffic light"}
# Column of true ranges by cue: stop signs are at the intersection's start, lights at its end.
REFERENCES: Final[Mapping[str, str]] = {"stop_sign": "start_m", "traffic_light": "end_m"}
# Min visible fraction of an object; the height of an occluded one does not show its range.
MIN_VISIBLE: Final = 0.9
# Max time difference between a detection and its true range.
NEAREST_NS: Final = 20_000_000


class RangePairs(NamedTuple):
    """N heights in pixels, and true ranges of the rear axle along the path in metres."""

    height_px: Floats
    range_m: Floats


def concatenate_pairs(parts: Iterable[RangePairs]) -> RangePairs:
    """Concatenate sets of pairs."""
    heights, ranges = zip(*parts, strict=True)
    return RangePairs(np.concatenate(heights), np.concatenate(ranges))


def range_pairs(path: Path) -> RangePairs:
    """Read pairs from a CSV or Parquet file with the columns ``height_px`` and ``range_m``.

    Raises:
        AnnotationError: The file does not exist, is too large, or lacks these columns.
    """
    try:
        columns = _parquet(path) if path.suffix == ".parquet" else _csv(path, RangePairs._fields)
    except OSError as error:
        raise AnnotationError(
            f"{path}: {error.strerror or error}; give a table (CSV or Parquet) with height_px and "
            "range_m"
        ) from None
    except UnicodeDecodeError:
        raise AnnotationError(
            f"{path}: is not text; give a table (CSV or .parquet) with height_px and range_m"
        ) from None
    except (KeyError, ValueError):
        raise AnnotationError(
            f"{path}: expected the columns height_px and range_m, all numbers"
        ) from None
    return RangePairs(*columns)


def pairs_of_truth(truth: Path, cue: str) -> RangePairs:
    """Return pairs from a drive's annotated objects that are neither occluded nor truncated.

    Args:
        truth: ``truth.json``, or its folder.
        cue: ``stop_sign`` or ``traffic_light``.

    Raises:
        SchemaError: The truth has no objects or ranges, or they cannot be read.
    """
    t_ns, range_m = _true_ranges(truth, cue)
    tree = _objects(truth)
    try:
        numbers = {c["id"] for c in tree["categories"] if c["name"] == LABELS[cue]}
        times = {image["id"]: int(image["t_ns"]) for image in tree["images"]}
        rows = [
            (times[one["image_id"]], float(one["bbox"][3]))
            for one in tree["annotations"]
            if one["category_id"] in numbers
            and one.get("visible", 1.0) >= MIN_VISIBLE
            and one.get("in_picture", 1.0) >= 1.0
        ]
    except (KeyError, TypeError, ValueError, IndexError) as error:
        raise AnnotationError(f"{truth}: objects: no COCO file ({error!r}); repair it") from None
    return _paired(rows, t_ns, range_m)


def pairs_of_run(run: Path, truth: Path, cue: str, score: float) -> RangePairs:
    """Return pairs from the detections of a run.

    Args:
        run: A run folder with ``detections.parquet``.
        truth: Truth of its drive.
        cue: ``stop_sign`` or ``traffic_light``.
        score: Threshold that the scores of detections must exceed.

    Raises:
        UnreadableRunError: The run has no detections.
        SchemaError: The truth has no ranges.
    """
    names = ["t_ns", "label", "score", "height_px"]
    table = RunFolder(run).table("detections", names)
    t_ns, label, scores, height = (table[name].to_pylist() for name in names)
    rows = [
        (t, float(h))
        for t, one, s, h in zip(t_ns, label, scores, height, strict=True)
        if one == LABELS[cue] and s > score and h is not None and h > 0.0
    ]
    return _paired(rows, *_true_ranges(truth, cue))


def _paired(rows: list[tuple[int, float]], t_ns: Int64s, range_m: Floats) -> RangePairs:
    if not rows or not len(t_ns):
        return RangePairs(np.empty(0), np.empty(0))
    times = np.array([t for t, _ in rows], np.int64)
    height = np.array([h for _, h in rows])
    after = np.clip(np.searchsorted(t_ns, times), 1, max(len(t_ns) - 1, 1))
    before, after = after - 1, np.minimum(after, len(t_ns) - 1)
    nearer = np.abs(t_ns[before] - times) <= np.abs(t_ns[after] - times)
    at = np.where(nearer, before, after)
    keep = (np.abs(t_ns[at] - times) <= NEAREST_NS) & (range_m[at] > 0.0)
    return RangePairs(height[keep], range_m[at][keep])


def _true_ranges(truth: Path, cue: str) -> tuple[Int64s, Floats]:
    """Return the times and true ranges of a drive's pictures, sorted by time."""
    name = read_truth(truth).ranges
    if name is None:
        raise SchemaError(f"{truth}: has no ranges; name a file with them as ranges")
    path = _folder(truth) / name
    try:
        t_ns, range_m = _csv(path, ("t_ns", REFERENCES[cue]))
    except (OSError, UnicodeDecodeError, KeyError, ValueError) as error:
        raise AnnotationError(f"{path}: no table of true ranges ({error}); repair it") from None
    order = np.argsort(t_ns, kind="stable")
    return t_ns[order].astype(np.int64), range_m[order]


def _objects(truth: Path) -> Any:
    name = read_truth(truth).objects
    if name is None:
        raise SchemaError(f"{truth}: has no objects; name a COCO file with them as objects")
    path = _folder(truth) / name
    try:
        content = read_at_most(path, MAX_BYTES)
        if content is None:
            raise AnnotationError(f"{path}: over {MAX_BYTES // MIB} MiB; split the drive")
        return json_tree(content)
    except (OSError, ValueError) as error:
        raise AnnotationError(f"{path}: not readable as JSON ({error}); repair it") from None


def _folder(truth: Path) -> Path:
    return truth.parent if truth.name == FILE or truth.is_file() else truth


def _csv(path: Path, names: tuple[str, ...]) -> tuple[Floats, ...]:
    content = read_at_most(path, MAX_BYTES)
    if content is None:
        raise AnnotationError(f"{path}: over {MAX_BYTES // MIB} MiB; give fewer rows")
    reader = csv.DictReader(content.decode("utf-8").splitlines())
    if set(names) - set(reader.fieldnames or ()):
        raise KeyError(names)
    rows = list(reader)
    # As float64, nanoseconds since 1970 are exact to 256 ns, enough to identify a picture.
    return tuple(np.array([float(row[name] or "nan") for row in rows]) for name in names)


def _parquet(path: Path) -> tuple[Floats, ...]:
    import pyarrow.parquet as pq

    names = list(RangePairs._fields)
    with door.arrow_file(path.resolve()) as file:
        table = pq.read_table(file, columns=names, page_checksum_verification=True)
    return tuple(np.asarray(table[name].to_numpy(), np.float64) for name in names)


COLOURS = ("#1f77b4", "#ff7f0e", "#2ca02c")


def draw_range_fits(
    path: Path, cue: str, pairs: RangePairs, fits: list[RangeFit], tested: RangeFit | None
) -> None:
    """Write the figure as PNG.

    Args:
        path: Path of the figure.
        cue: The cue that was measured.
        pairs: Pairs that the curves were fitted to.
        fits: One fit for each family.
        tested: The best curve with its residuals on other pairs.

    Raises:
        OutputError: The file cannot be written.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.0, 4.2), layout="constrained")
    left, right = figure.subplots(1, 2)
    what = cue.replace("_", " ")
    left.plot(pairs.height_px, pairs.range_m, ".", ms=2, color="#999999", label="pairs")
    height = np.linspace(pairs.height_px.min(), pairs.height_px.max(), 400)
    for fit, colour in zip(fits, COLOURS, strict=False):
        label = f"{fit.curve.family}, s.d. {fit.curve.residual_sd_m:.2f} m"
        left.plot(height, range_of(height, fit.curve), color=colour, lw=1.5, label=label)
    left.set(xlabel=f"height of the {what} [px]", ylabel="range to the rear axle [m]")
    left.set_ylim(0.0, 1.1 * float(pairs.range_m.max()))
    left.legend(fontsize=8)
    best = min(fits, key=lambda fit: fit.curve.residual_sd_m)
    for of, label, colour in ((best, "fitted to", COLOURS[0]), (tested, "others", COLOURS[1])):
        if of is not None:
            middle = [(b.from_m + b.to_m) / 2 for b in of.bins]
            right.plot(middle, [b.sd_m for b in of.bins], "o-", color=colour, label=label)
    right.set(xlabel="range [m]", ylabel="r.m.s. residual [m]", title=best.curve.family)
    right.set_ylim(bottom=0.0)
    right.legend(fontsize=8)
    write_whole(path, lambda place: figure.savefig(place, dpi=130, format="png"))
