"""Numbers of a metrics tree by path, such as ``cues.stop_sign.precision``."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class MetricValue:
    """One number and its interval.

    Attributes:
        value: Value; NaN if nothing was scored.
        low: Lower end; NaN if the metric has no interval.
        high: Upper end; NaN if the metric has no interval.
        of: Number of rows behind it; None if not reported.
    """

    value: float
    low: float = math.nan
    high: float = math.nan
    of: int | None = None


def metric_values(tree: Mapping[str, object], *, parts: bool = True) -> dict[str, MetricValue]:
    """Return all numbers of a tree by path; texts, flags and lists are ignored.

    Args:
        tree: As in ``metrics.json``. A branch with a ``value`` is one metric with an interval.
        parts: True to also include the parts of such branches under their own paths.
    """
    return dict(_walk(tree, "", parts))


def _walk(
    tree: Mapping[str, object], prefix: str, parts: bool
) -> Iterator[tuple[str, MetricValue]]:
    for name, branch in tree.items():
        path = f"{prefix}{name}"
        if isinstance(branch, Mapping):
            is_whole = "value" in branch
            if is_whole:
                yield path, _with_interval(branch)
            if parts or not is_whole:
                yield from _walk(branch, path + ".", parts)
        elif branch is None or (isinstance(branch, int | float) and not isinstance(branch, bool)):
            yield path, MetricValue(_number(branch))


def _with_interval(branch: Mapping[str, object]) -> MetricValue:
    """Return a metric with the wider of its intervals over rows and over clusters."""
    low = [_number(branch.get(name)) for name in ("low", "clusters_low")]
    high = [_number(branch.get(name)) for name in ("high", "clusters_high")]
    of = branch.get("of")
    return MetricValue(
        _number(branch["value"]),
        min((end for end in low if not math.isnan(end)), default=math.nan),
        max((end for end in high if not math.isnan(end)), default=math.nan),
        of if isinstance(of, int) else None,
    )


def _number(value: object) -> float:
    return float(value) if isinstance(value, int | float) else math.nan
