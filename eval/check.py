"""Check the files of a drive before it is replayed: ``crosscue check``.

A file is recognised by its content, see ``KINDS``. Files that are named together are checked
against each other: a vehicle file and a truth against the log.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, ClassVar, Final

from crosscue.datasets.truth import truth as truth_file
from crosscue.detectors.catalog.architectures import WEIGHTS_SUFFIXES
from crosscue.detectors.catalog.cards import check_card
from crosscue.eval.fit.truth_check import check_truth
from crosscue.eval.logs.log import UnopenedLog, vehicle_of
from crosscue.eval.logs.seals import check_seal
from crosscue.eval.pipeline.run import open_run
from crosscue.eval.quality.checks import PURPOSES, Purpose
from crosscue.eval.quality.spec import read_spec
from crosscue.eval.quality.verdict import LogCheck, LogCheckSettings, check_log
from crosscue.eval.report.junit import cases_text
from crosscue.eval.runs.folder import MANIFEST
from crosscue.eval.runs.logs import log_location
from crosscue.eval.vehicle.drive_check import check_vehicle
from crosscue.replay.errors import CrosscueError, LogError, UnknownFormatError, UsageError
from crosscue.replay.files.bounded import read_at_most
from crosscue.replay.files.tree_text import json_tree, toml_tree
from crosscue.replay.files.whole_file import write_text
from crosscue.replay.limits import DEFAULT_LIMITS, MIB, Limits, LimitsGiven
from crosscue.replay.logs.opening import log_within
from crosscue.replay.progress import emit
from crosscue.replay.remote.address import is_remote
from crosscue.replay.seal.seal import SUFFIX, seal_over
from crosscue.replay.vehicle.vehicle import Vehicle, load, vehicle_given
from crosscue.results import Listing, Result
from crosscue.verb import Option

# A larger file is neither settings nor truth.
MAX_BYTES: Final = 64 * MIB
MODEL_SUFFIXES: Final = (".onnx", ".xml", *WEIGHTS_SUFFIXES)


@dataclass(frozen=True, slots=True)
class Together:
    """The files of one call, and how they are checked.

    Attributes:
        files: Each file with its kind.
        picture: Picture that a network is run on.
        output: Page or picture to write.
        start_s: First second of the signals to examine.
        seconds: Number of seconds to examine.
        overwrite: True to replace an existing output.
        limits: Limits for reading logs.
        drive: How a log is judged.
    """

    files: tuple[tuple[str, Kind], ...]
    picture: Path | str | None
    output: Path | str | None
    start_s: float
    seconds: float
    overwrite: bool
    limits: Limits
    drive: LogCheckSettings = field(default_factory=LogCheckSettings)

    def of_kind(self, *names: str) -> tuple[str, ...]:
        """Return the files of some kinds."""
        return tuple(file for file, kind in self.files if kind.name in names)

    def has_others(self) -> bool:
        """Return whether there are files that are compared with the logs."""
        return bool(self.of_kind("vehicle file", "truth"))


@dataclass(frozen=True, slots=True)
class Kind:
    """A kind of file.

    Attributes:
        name: Its name, with which an error lists what was expected.
        recognises: Whether a file is of this kind, from its name and its content as JSON or TOML.
        check: Check of a file, which raises ``CrosscueError`` or returns what was found.
    """

    name: str
    recognises: Callable[[str, Mapping[str, Any]], bool]
    check: Callable[[str, Together], Result]


@dataclass(frozen=True, slots=True, repr=False)
class Sound(Result):
    """A file that was read without an error, and compared with no other.

    Attributes:
        note: What was checked.
    """

    note: str

    def lines(self) -> Iterator[str]:
        """Yield the note."""
        yield self.note


@dataclass(frozen=True, slots=True, repr=False)
class CheckedRun(Result):
    """A run whose tables match their checksums, and whose logs are unchanged.

    Attributes:
        tables: Number of tables.
        logs: Present locations of its logs.
        is_whole: True if nothing was dropped in the run.
    """

    tables: int
    logs: tuple[str, ...]
    is_whole: bool

    def lines(self) -> Iterator[str]:
        """Yield what was compared."""
        yield f"{self.tables} tables match their checksums; unchanged: {', '.join(self.logs)}"
        if not self.is_whole:
            yield "something was dropped; the account in its manifest and report says what"


@dataclass(frozen=True, slots=True, repr=False)
class FileCheck(Result):
    """The check of one file.

    Attributes:
        file: The file, as named.
        kind: Its kind; None if it was not recognised.
        result: What was found; None after an error.
        error: Why the check failed; None if it did not.
    """

    file: str
    kind: str | None
    result: Result | None
    error: CrosscueError | None = None

    also: ClassVar = {"exit_status": "exit_status"}

    @property
    def exit_status(self) -> int:
        """Exit status of this check alone."""
        one = self.result or self.error
        return 0 if one is None else one.exit_status


class Checks(Listing[FileCheck]):
    """Checks of files, in the order of their names."""

    head = ("file", "kind", "status")
    root = "files"

    @property
    def exit_status(self) -> int:
        """The highest exit status of them."""
        return max(one.exit_status for one in self)

    def cells(self, row: FileCheck) -> tuple[object, ...]:
        """Return the cells of a row."""
        return (row.file, row.kind, row.exit_status)

    def lines(self) -> Iterator[str]:
        """Yield what was found in each file; errors are reported while the files are checked."""
        for number, row in enumerate(one for one in self if one.result is not None):
            if len(self) > 1:
                yield f"{'' if number == 0 else chr(10)}{row.file}: {row.kind}"
            yield repr(row.result)


def check(
    *files: Annotated[str | Path, Option(metavar="FILE")],
    picture: Path | str | None = None,
    output: Annotated[Path | str | None, Option(metavar="FILE")] = None,
    purposes: Annotated[Sequence[Purpose], Option("--for")] = PURPOSES,
    vehicle: Vehicle | Path | str | None = None,
    spec: Annotated[Path | str | None, Option(metavar="FILE")] = None,
    init: bool = False,
    junit: Path | str | None = None,
    start_s: float = 0.0,
    seconds: Annotated[float, Option(metavar="S")] = 10.0,
    overwrite: bool = False,
    limits: LimitsGiven = DEFAULT_LIMITS,
) -> Checks:
    """Say whether a log is good enough; check a vehicle file, truth, model or run.

    A log is judged for each purpose: pose, cues, range and landmarks. A purpose is good, limited
    (exit status 3), or not possible (1); the report says what is missing, slow, late, damaged or
    wrong, and what would help. Logs that are named together are one drive. A sealed log is
    compared with its seal, too.

    Each file is recognised by its content. Name the files of a drive together: a vehicle file is
    then checked on seconds of the log (its signals must not contradict each other), and truth must
    fit the log in its times, pictures and hash. A model is a card, the weights beside it, or a name
    of the catalog; its network is run. A run is compared with its checksums and its logs. The exit
    status is the highest of all files.

    Examples:
        crosscue check drive.mcap --vehicle car.toml --for pose cues
        crosscue check drive.mcap --spec fleet.toml --junit check.xml
        crosscue check car.toml drive.mcap -o check.html    signals, horizon, regions
        crosscue check truth.json drive.mcap
        crosscue check my.toml --picture street.jpg         a model card
        crosscue check drive.bag runs/drive                 a seal, and a run

    Args:
        files: Files, folders, or names of models.
        picture: JPEG, PNG or WebP file that a network is run on.
        output: Page (.html) or picture of a vehicle file's check, or detections in --picture.
        purposes: Purposes for which a log must do: pose, cues, range, landmarks (default: all).
        vehicle: Vehicle file for a log's signals (default: the vehicle.toml beside it).
        spec: Topics, rates, gaps and delays that must hold in a log (TOML).
        init: Write --spec from the log, with margins.
        junit: File for the results as JUnit XML, one test case for each check.
        start_s: Examine signals from this many seconds after the first message.
        seconds: Seconds of the log to examine.
        overwrite: Replace an existing output or specification.
        limits: Limits for reading the logs.

    Raises:
        UsageError: A setting is out of range, or applies to none of the files.
        OutputError: The JUnit file cannot be written.
    """
    if unknown := [one for one in purposes if one not in PURPOSES]:
        raise UsageError(f"purposes: {', '.join(unknown)}: expected {', '.join(PURPOSES)}")
    if init and spec is None:
        raise UsageError("init: needs a file to write; name it with spec")
    if not (math.isfinite(seconds) and seconds > 0.0):
        raise UsageError(f"seconds: {seconds:g}, expected more than 0")
    drive = LogCheckSettings(
        purposes,
        vehicle_given(vehicle),
        None if spec is None or init else read_spec(spec),
        Path(spec) if spec is not None and init else None,
        overwrite,
    )
    kinds: dict[str, Kind | CrosscueError] = {}
    for file in map(str, files):
        try:
            kinds[file] = _kind_of(file)
        except CrosscueError as error:
            kinds[file] = error
    known = tuple((file, kind) for file, kind in kinds.items() if isinstance(kind, Kind))
    together = Together(known, picture, output, start_s, seconds, overwrite, limits, drive)
    if vehicle is None and (logs := together.of_kind("log")) and not together.has_others():
        beside = vehicle_of(UnopenedLog(logs), None)
        together = replace(together, drive=replace(drive, vehicle=beside))
    _check_settings(together)
    rows = []
    for file, kind in kinds.items():
        if isinstance(kind, CrosscueError):
            rows.append(FileCheck(file, None, None, kind))
        elif kind.name != "log" or not _is_only_compared(file, together):
            rows.append(_checked(file, kind, together))
        if rows and rows[-1].file == file and rows[-1].error is not None:
            emit(rows[-1].error)
    if junit is not None:
        cases = [case for row in rows for case in _cases(row)]
        write_text(Path(junit), cases_text(cases, "crosscue check", "check"))
    return Checks(rows)


def _cases(row: FileCheck) -> Iterator[tuple[str, str]]:
    if isinstance(row.result, LogCheck):
        yield from ((f"{row.file}: {name}", why) for name, why in row.result.cases())
    else:
        failed = row.exit_status != 0
        why = str(row.error or "; ".join(row.result.lines() if row.result else ()))
        yield f"{row.file}: {row.kind}", why if failed else ""


def _checked(file: str, kind: Kind, together: Together) -> FileCheck:
    try:
        return FileCheck(file, kind.name, kind.check(file, together))
    except CrosscueError as error:
        return FileCheck(file, kind.name, None, error)


def _check_settings(together: Together) -> None:
    """Refuse a picture or an output that no file needs."""
    models = together.of_kind("model", "model card")
    if together.picture is not None and not models:
        raise UsageError(f"picture: {together.picture}, applies only to a model; name its card")
    shown = models if together.picture is not None else ()
    if together.of_kind("log"):
        shown += together.of_kind("vehicle file")
    if together.output is not None and len(shown) != 1:
        raise UsageError(
            f"output: {together.output}, expected one file to show, found {len(shown)}; name a "
            "vehicle file with its log, or a model with a picture"
        )


def _is_only_compared(log: str, together: Together) -> bool:
    """Return whether a log is only what other files are compared with."""
    return together.has_others() and (is_remote(log) or seal_over(Path(log)) is None)


def _kind_of(file: str) -> Kind:
    """Return the kind of a file."""
    tree = {} if is_remote(file) else _tree_of(Path(file))
    for kind in KINDS:
        if kind.recognises(file, tree):
            return kind
    expected = ", ".join(kind.name for kind in KINDS)
    if not Path(file).exists():
        raise LogError(f"{file}: no such file or folder; expected one of: {expected}")
    raise UnknownFormatError(f"{file}: not recognised; expected one of: {expected}")


def _tree_of(path: Path) -> Mapping[str, Any]:
    """Return the content of a JSON or TOML file; nothing for all other files."""
    try:
        if not path.is_file():
            return {}
        with path.open("rb") as file:
            if b"\0" in file.read(4096):
                return {}
        text = (read_at_most(path, MAX_BYTES) or b"").decode()
        tree = json_tree(text) if text.lstrip()[:1] == "{" else toml_tree(text)
    except (OSError, ValueError, RecursionError):
        return {}
    return tree if isinstance(tree, dict) else {}


def _is_log(file: str, tree: Mapping[str, Any]) -> bool:
    try:
        return is_remote(file) or log_within(Path(file)).exists()
    except LogError:
        return False


def _is_truth(file: str, tree: Mapping[str, Any]) -> bool:
    path = Path(file)
    return path.suffix == ".json" or "start_ns" in tree or (path / truth_file.FILE).is_file()


def _is_model(file: str, tree: Mapping[str, Any]) -> bool:
    path = Path(file)
    return path.suffix.lower() in MODEL_SUFFIXES or (
        path.name == file and not path.exists() and not path.suffix
    )


def _is_vehicle(file: str, tree: Mapping[str, Any]) -> bool:
    return Path(file).suffix == ".toml" or bool(tree.keys() & Vehicle.model_fields.keys())


def _check_drive(file: str, together: Together) -> Result:
    """Judge the drive of all logs, in the row of the first; a log with others only by its seal."""
    logs = together.of_kind("log")
    sealed = None if is_remote(file) or seal_over(Path(file)) is None else check_seal(file)
    if sealed is not None and (together.has_others() or not sealed.is_whole):
        return sealed
    if file != logs[0]:
        return sealed or Sound(f"a log of the same drive as {logs[0]}")
    found = check_log(UnopenedLog(logs, limits=together.limits), together.drive)
    return replace(found, seal=sealed)


def _check_run(file: str, together: Together) -> CheckedRun:
    run = open_run(file, without_images=True, limits=together.limits)
    manifest = run.folder.drive_manifest()
    for table in run.tables:
        run[table]
    logs = tuple(str(log_location(run.folder, row)) for row in manifest.logs)
    return CheckedRun(len(run.tables), logs, manifest.account.is_whole)


def _check_truth(file: str, together: Together) -> Result:
    logs, vehicles = together.of_kind("log"), together.of_kind("vehicle file")
    named = truth_file.read_truth(Path(file)).log
    log = next((log for log in logs if Path(log).name == named), next(iter(logs), None))
    return check_truth(file, log, next(iter(vehicles), None), limits=together.limits)


def _check_model(file: str, together: Together) -> Result:
    card = Path(file)
    if card.suffix.lower() in MODEL_SUFFIXES:
        card = card.with_suffix(".toml")
        if not card.is_file():
            raise UsageError(f"{card}: no such card; write it with: crosscue model init {file}")
    return check_card(card, together.picture, together.output if together.picture else None)


def _check_vehicle(file: str, together: Together) -> Result:
    logs = together.of_kind("log")
    if not logs:
        load(Path(file))
        return Sound(f"{file}: valid; name a log, too, to check its signals")
    return check_vehicle(
        UnopenedLog(logs, limits=together.limits),
        file,
        together.output,
        start_s=together.start_s,
        seconds=together.seconds,
        overwrite=together.overwrite,
    )


# Kinds of files, in the order in which they are tried.
KINDS: Final = (
    Kind(
        "seal",
        lambda file, tree: file.endswith(SUFFIX),
        lambda file, together: check_seal(file.removesuffix(SUFFIX)),
    ),
    Kind("run", lambda file, tree: (Path(file) / MANIFEST).is_file(), _check_run),
    Kind("truth", _is_truth, _check_truth),
    Kind("model card", lambda file, tree: "weights" in tree, _check_model),
    Kind("model", _is_model, _check_model),
    Kind("vehicle file", _is_vehicle, _check_vehicle),
    Kind("log", _is_log, _check_drive),
)
