"""What a log must hold: topics, rates, gaps and delays, in a TOML file.

::

    version = 1
    [topics."/imu"]
    min_rate_hz = 80.0
    max_gap_s = 0.05
    max_delay_s = 0.1
"""

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final, Literal

from crosscue.replay.errors import UsageError
from crosscue.replay.files.whole_file import write_text
from crosscue.replay.logs.log_summary import LogSummary, TopicSummary
from crosscue.replay.vehicle.section import Positive, Section
from crosscue.replay.vehicle.validation_errors import read_model

# Margins of a specification that is written from a good log.
RATE_MARGIN: Final = 0.8
GAP_MARGIN: Final = 2.0
DELAY_MARGIN: Final = 2.0
LEAST_DELAY_S: Final = 0.05


class TopicSpec(Section):
    """What one topic must hold."""

    min_rate_hz: Positive | None = None
    """Lowest mean rate."""
    max_gap_s: Positive | None = None
    """Longest time between two rows."""
    max_delay_s: Positive | None = None
    """Largest difference between header stamp and log time, either way."""


class LogSpec(Section):
    """What a log must hold."""

    version: Literal[1]
    topics: dict[str, TopicSpec]
    """By name of the topic."""


def read_spec(path: Path | str) -> LogSpec:
    """Read a specification.

    Raises:
        UsageError: It cannot be read, or is not valid.
    """
    return read_model(Path(path), LogSpec, UsageError, "expected a specification, as of --init")


def spec_faults(spec: LogSpec, summaries: Sequence[LogSummary]) -> Iterator[tuple[str, str]]:
    """Yield the name of each requirement, with what is wrong; empty if it holds."""
    topics = {topic.name: topic for log in summaries for topic in log.topics if topic.found}
    for name, wanted in spec.topics.items():
        topic = topics.get(name)
        if topic is None:
            yield f"{name}: there", "the topic is missing, or has no rows"
            continue
        yield f"{name}: there", ""
        rate_hz, gap_s, delay_s = _measured(topic)
        for label, limit, value, is_lower in (
            ("min_rate_hz", wanted.min_rate_hz, rate_hz, True),
            ("max_gap_s", wanted.max_gap_s, gap_s, False),
            ("max_delay_s", wanted.max_delay_s, delay_s, False),
        ):
            if limit is not None:
                holds = value is not None and (value >= limit if is_lower else value <= limit)
                shown = "unknown" if value is None else f"{value:.4g}"
                bound = "at least" if is_lower else "at most"
                yield f"{name}: {label}", "" if holds else f"{shown}, expected {bound} {limit:g}"


def _measured(topic: TopicSummary) -> tuple[float | None, float | None, float | None]:
    report = topic.clocks
    if report is None:
        return None, None, None
    gap_ns = report.of_used.longest_step_ns
    line = None if report.header is None else report.header.line
    return (
        report.rate_hz,
        None if gap_ns is None else gap_ns * 1e-9,
        None if line is None else abs(line.offset_ns) * 1e-9,
    )


def write_spec(path: Path, summaries: Sequence[LogSummary]) -> None:
    """Write what a good log holds, with margins.

    Raises:
        OutputError: It cannot be written.
    """
    lines = [
        "# Written from a log by: crosscue check LOG --spec THIS_FILE --init",
        f"# Margins: {RATE_MARGIN:g} of the rate, {GAP_MARGIN:g} times the longest gap and delay.",
        "version = 1",
    ]
    for topic in (topic for log in summaries for topic in log.topics if topic.found):
        rate_hz, gap_s, delay_s = _measured(topic)
        quoted = topic.name.replace("\\", "\\\\").replace('"', '\\"')
        lines += ["", f'[topics."{quoted}"]']
        if rate_hz:
            lines.append(f"min_rate_hz = {_rounded(RATE_MARGIN * rate_hz)}")
        if gap_s:
            lines.append(f"max_gap_s = {_rounded(GAP_MARGIN * gap_s)}")
        if delay_s is not None and delay_s < 60.0:
            lines.append(f"max_delay_s = {_rounded(DELAY_MARGIN * delay_s + LEAST_DELAY_S)}")
    write_text(path, "\n".join(lines) + "\n")


def _rounded(value: float) -> str:
    digits = 2 - math.floor(math.log10(value))
    return str(float(round(value, digits)))
