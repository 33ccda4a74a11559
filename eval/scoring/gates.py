"""Gates: bounds on metrics, for CI.

A gate file is TOML::

    version = 1

    [[gate]]
    metric = "cues.stop_sign.precision"
    min = 0.95
    use = "low"      # compare the interval's lower end; default: "value"
    min_count = 100  # with fewer rows than this, the gate fails; default: 1
"""

import difflib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

from crosscue.replay.errors import UsageError
from crosscue.replay.vehicle.validation_errors import read_model

from .metric_values import MetricValue

Bound = Annotated[float, Field(allow_inf_nan=False)]


class Gate(BaseModel):
    """One bound on one metric."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    metric: Annotated[str, Field(min_length=1)]
    min: Bound | None = None
    max: Bound | None = None
    use: Literal["value", "low", "high"] = "value"
    """The metric itself, or an end of its interval (of the wider one if there are two)."""
    min_count: Annotated[int, Field(ge=1)] = 1
    """Min number of rows behind the metric, if the metric reports it."""

    @model_validator(mode="after")
    def _has_bounds(self) -> Self:
        if self.min is None and self.max is None:
            raise ValueError("expected min, max or both")
        if self.min is not None and self.max is not None and self.min > self.max:
            raise ValueError(f"min {self.min:g} is above max {self.max:g}")
        return self

    def text(self) -> str:
        """Return metric and bounds as text."""
        end = "" if self.use == "value" else f" ({self.use} end)"
        low = "" if self.min is None else f" >= {self.min:g}"
        high = "" if self.max is None else f" <= {self.max:g}"
        return f"{self.metric}{end}{low}{high}"


class GateFile(BaseModel):
    """A gate file."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    version: Literal[1]
    gate: Annotated[tuple[Gate, ...], Field(min_length=1)]


@dataclass(frozen=True, slots=True)
class GateResult:
    """The outcome of a gate.

    Attributes:
        gate: The gate.
        value: Compared value; NaN if nothing was scored.
        failure: Reason of the failure; empty if the gate passed.
    """

    gate: Gate
    value: float
    failure: str


def load_gates(path: Path) -> tuple[Gate, ...]:
    """Read a gate file.

    Raises:
        UsageError: The file is missing, not TOML, or not a gate file of version 1.
    """
    return read_model(path, GateFile, UsageError, "expected a gate file").gate


def check_gates(
    gates: Sequence[Gate], values: Mapping[str, MetricValue], not_scored: Mapping[str, str]
) -> tuple[GateResult, ...]:
    """Check gates against metrics.

    Args:
        gates: The gates.
        values: Metrics, from ``metric_values``.
        not_scored: Reasons by name of the sections without scores, whose gates fail.

    Raises:
        UsageError: A metric does not exist; the message suggests similar ones.
    """
    return tuple(_check(gate, values, not_scored) for gate in gates)


def _check(
    gate: Gate, values: Mapping[str, MetricValue], not_scored: Mapping[str, str]
) -> GateResult:
    found = values.get(gate.metric)
    section = gate.metric.partition(".")[0]
    if section in not_scored and (found is None or math.isnan(found.value)):
        return GateResult(gate, math.nan, f"not scored: {not_scored[section]}")
    if found is None:
        raise UsageError(f"gate {gate.metric!r}: no such metric; {_close(gate.metric, values)}")
    value = {"value": found.value, "low": found.low, "high": found.high}[gate.use]
    return GateResult(gate, value, _failure(gate, found, value))


def _close(name: str, values: Mapping[str, MetricValue]) -> str:
    close = difflib.get_close_matches(name, values, n=3, cutoff=0.6)
    if close:
        return f"did you mean {' or '.join(close)}?"
    return f"score --json lists all {len(values)}, such as {', '.join(sorted(values)[:2])}"


def _failure(gate: Gate, found: MetricValue, value: float) -> str:
    if math.isnan(found.value):
        return "not scored: no data for it"
    if math.isnan(value):
        return f"its interval has no {gate.use} end: too few drives"
    if found.of is not None and found.of < gate.min_count:
        return f"based on {found.of} rows, expected {gate.min_count} or more"
    if gate.min is not None and value < gate.min:
        return f"{value:.6g} is below {gate.min:g}"
    if gate.max is not None and value > gate.max:
        return f"{value:.6g} is above {gate.max:g}"
    return ""
