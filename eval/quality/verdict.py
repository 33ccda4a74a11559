"""The verdict on a drive, for each purpose."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

from crosscue.eval.logs.log import Log, UnopenedLog, opened
from crosscue.eval.logs.seals import SealCheck
from crosscue.eval.vehicle.mounting import MountingWatch
from crosscue.localization.camera_delay import CameraDelay
from crosscue.replay.errors import OutputError
from crosscue.replay.safe_text import terminal_width, wrapped
from crosscue.replay.vehicle.vehicle import Vehicle
from crosscue.results import HIDDEN, Result

from .checks import CHECKS, PURPOSES, Finding
from .drive import QualityDrive, examine_drive
from .spec import LogSpec, spec_faults, write_spec

# Verdicts, from the best to the worst.
GOOD, LIMITED, NOT_POSSIBLE = "good", "limited", "not possible"


@dataclass(frozen=True, slots=True)
class PurposeVerdict:
    """Verdict for one purpose.

    Attributes:
        purpose: ``pose``, ``cues``, ``range`` or ``landmarks``.
        verdict: ``good``, ``limited`` or ``not possible``.
        because: Names of the checks that found something.
    """

    purpose: str
    verdict: str
    because: tuple[str, ...]


@dataclass(frozen=True, slots=True, repr=False)
class LogCheck(Result):
    """Whether a log is good enough.

    Attributes:
        log: The logs of the drive.
        seconds: Length of what a run would use.
        used: What each topic would be used for.
        purposes: Verdict for each purpose asked for.
        findings: What was found, by check.
        delays: Delay of the pictures by each signal.
        mounting: Pitch, yaw and height of the camera over the drive; None where unknown.
        spec: Requirements of the specification, with what is wrong.
        seal: The comparison with the seal, if the log has one.
        written: Specification that was written.
    """

    log: tuple[str, ...]
    seconds: float
    used: dict[str, str]
    purposes: tuple[PurposeVerdict, ...]
    findings: tuple[Finding, ...]
    delays: tuple[CameraDelay, ...] = ()
    mounting: MountingWatch | None = None
    spec: tuple[tuple[str, str], ...] = ()
    seal: SealCheck | None = None
    written: Path | None = field(default=None, metadata=HIDDEN)

    also: ClassVar = {"verdict": "verdict"}

    @property
    def verdict(self) -> str:
        """The worst verdict."""
        order = (GOOD, LIMITED, NOT_POSSIBLE)
        return max((one.verdict for one in self.purposes), key=order.index, default=GOOD)

    @property
    def exit_status(self) -> int:
        """1 if a purpose is not possible or the specification does not hold, 3 if limited, 0."""
        if self.verdict == NOT_POSSIBLE or any(why for _, why in self.spec):
            return 1
        return 3 if self.verdict == LIMITED else 0

    def cases(self) -> Iterator[tuple[str, str]]:
        """Yield test cases of a JUnit file: name and failure, which is empty if passed."""
        for check in CHECKS:
            why = "; ".join(one.text for one in self.findings if one.check == check.name)
            yield f"{check.name}: {check.title}", why
        yield from ((f"spec: {name}", why) for name, why in self.spec)

    def lines(self) -> Iterator[str]:
        """Yield the verdicts, what was found with what would help, and the camera's values."""
        width = terminal_width()
        used = ", ".join(f"{use} ({topic})" for topic, use in self.used.items()) or "nothing"
        yield wrapped(f"{self.seconds:.1f} s; a run would use: {used}", width, "")
        for one in self.purposes:
            why = f": {', '.join(one.because)}" if one.because else ""
            yield f"{one.purpose:10} {one.verdict}{why}"
        for finding in self.findings:
            purposes = ", ".join(finding.purposes)
            text = f"{finding.check}, {finding.kind}: {finding.text} ({purposes}); {finding.help}"
            yield wrapped(text, width, "- ")
        for delay in self.delays:
            yield wrapped(f"delay of the pictures: {delay}", width, "")
        yield from self._mounting_lines()
        yield from (f"spec {name}: {why or 'holds'}" for name, why in self.spec)
        if self.written is not None:
            yield f"written: {self.written}"
        if self.seal is not None:
            yield from self.seal.lines()

    def _mounting_lines(self) -> Iterator[str]:
        windows = () if self.mounting is None else self.mounting.windows
        starts = sorted({one.start_ns for one in windows})
        for start_ns in starts:
            here = [one for one in windows if one.start_ns == start_ns]
            values = ", ".join(f"{one.value} {one}" for one in here)
            begin_s = (start_ns - starts[0]) * 1e-9
            yield f"camera from {begin_s:.0f} s: {values}"


@dataclass(frozen=True, slots=True)
class LogCheckSettings:
    """How a log is checked.

    Attributes:
        purposes: Purposes to judge.
        vehicle: Vehicle file; None for the one beside the log, or defaults.
        spec: Specification to hold against the log.
        new_spec: Specification to write from the log.
        overwrite: True to replace an existing specification.
    """

    purposes: Sequence[str] = PURPOSES
    vehicle: Vehicle = field(default_factory=lambda: Vehicle(version=1))
    spec: LogSpec | None = None
    new_spec: Path | None = None
    overwrite: bool = False


def check_log(log: Log | UnopenedLog | Path | str, settings: LogCheckSettings) -> LogCheck:
    """Judge whether a drive is good enough.

    Raises:
        LogError: The log cannot be read.
        OutputError: The specification exists, or cannot be written.
    """
    if settings.new_spec is not None and settings.new_spec.exists() and not settings.overwrite:
        raise OutputError(f"{settings.new_spec}: exists; give another name or --overwrite")
    with opened(log) as drive:
        seen = examine_drive(drive.logs, settings.vehicle, drive.selection)
    found = judge(seen, settings.purposes)
    faults = () if settings.spec is None else tuple(spec_faults(settings.spec, seen.summaries))
    if settings.new_spec is not None:
        write_spec(settings.new_spec, seen.summaries)
    start_ns, end_ns = seen.span_ns
    return LogCheck(
        tuple(one.path for one in seen.summaries),
        (end_ns - start_ns) * 1e-9,
        seen.used_topics,
        tuple(_verdict(purpose, found) for purpose in settings.purposes),
        found,
        seen.delays,
        seen.mounting,
        faults,
        written=settings.new_spec,
    )


def judge(drive: QualityDrive, purposes: Sequence[str] = PURPOSES) -> tuple[Finding, ...]:
    """Return what the checks find that matters for some purposes."""
    return tuple(
        finding
        for check in CHECKS
        for finding in check(drive)
        if not set(purposes).isdisjoint(finding.purposes)
    )


def _verdict(purpose: str, findings: Sequence[Finding]) -> PurposeVerdict:
    mine = [one for one in findings if purpose in one.purposes]
    verdict = GOOD
    if mine:
        is_missing = any(one.kind == "missing" for one in mine)
        verdict = NOT_POSSIBLE if is_missing else LIMITED
    return PurposeVerdict(purpose, verdict, tuple(dict.fromkeys(one.check for one in mine)))
