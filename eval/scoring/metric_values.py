"""Every number of a metrics tree under its path, such as ``cues.stop_sign.precision``."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class MetricValue:
    """One number and its interval.

    Attributes:
        value: NaN where nothing was scored.
        low: NaN where the metric has no interval.
        high: The same.
        of: How many rows it stands on, or None where it does not say.
    """

    value: float
    low: float = math.nan
    high: float = math.nan
    of: int | None = None


def metric_values(tree: Mapping[str, object], *, parts: bool = True) -> dict[str, MetricValue]:
    """All numbers of a tree by path; texts, flags and lists are passed over.

    Args:
        tree: As in ``metrics.json``. A branch with a ``value`` is one metric with an interval.
        parts: Give the parts of such branches paths of their own, too.
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
    """The wider of both intervals where rows were also counted by drive or approach."""
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
