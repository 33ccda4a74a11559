"""The ``crosscue`` command: a table of commands, one boundary for errors.

Only the module of the command that was asked for is imported, so ``crosscue --help`` answers at
once. A command is one file in ``commands`` with ``add_arguments(parser)`` and ``run(args) -> int``,
and one line in ``COMMANDS``.
"""

from __future__ import annotations

import argparse
import errno
import io
import os
import signal
import sys
from collections.abc import Sequence
from importlib import import_module
from types import FrameType
from typing import TYPE_CHECKING, Final, NoReturn, Protocol, cast

from crosscue.replay.errors import CrosscueError, one_line
from crosscue.replay.losses import losses_heard
from crosscue.replay.safe_text import visible
from crosscue.replay.versions import installed

if TYPE_CHECKING:
    from typing_extensions import Buffer

COMMANDS: Final[dict[str, tuple[str, str]]] = {
    "info": ("info", "topics, counts, clocks, gaps and health of a log"),
    "convert": ("convert", "any log or data set to MCAP with ROS 2 types"),
    "seal": ("seal", "a hash of each MiB beside a log, or check a log against it"),
    "vehicle init": ("vehicle.init", "write a first vehicle file from what a log holds"),
    "decode": ("decode", "every stream as columns: a Parquet file for each topic or CAN message"),
    "detect": ("detect", "run detectors over the camera: detections, road, cues"),
    "estimate": ("estimate", "estimate a run again, from what detectors found before"),
    "replay": ("replay", "the main job: from a log to a run folder"),
    "score": ("score", "runs against truth: metrics, figures, report, gates"),
    "compare": ("compare", "what changed between two runs, with tolerances"),
    "merge": ("merge", "the runs of batches as one folder of tables"),
    "view": ("view", "a run in Rerun"),
    "fit compass": ("fit.compass", "compass mounting, hard and soft iron from a drive"),
    "fit signs": ("fit.signs", "the sign threshold for a wanted precision"),
    "fit ranges": ("fit.ranges", "from heights in pixels to ranges, with residuals"),
    "fit messages": ("fit.messages", "how far each cue is to be believed, from annotated drives"),
    "fit landmarks": ("fit.landmarks", "the match threshold for a wanted false-match rate"),
    "landmarks add": ("landmarks.add", "pictures and where they were taken into a database"),
    "landmarks list": ("landmarks.list", "what a landmark database holds"),
    "landmarks match": ("landmarks.match", "one picture against a landmark database"),
    "truth": ("truth.write", "write the truth that a data set carries"),
    "truth import": ("truth.import_annotations", "annotations from COCO or CVAT as truth"),
    "truth check": ("truth.check", "does a truth file fit its log?"),
    "truth schema": ("truth.schema", "the JSON Schema of truth.json"),
    "simulate": ("simulate", "drives up to intersections, with camera, CAN, Mobileye and truth"),
    "train road": ("train.road", "the road network, on simulated or own pictures"),
    "study intersections": (
        "study.intersections",
        "the published experiment on simulated drives, table beside table",
    ),
    "train frames": ("train.frames", "pictures of simulated intersections to train on, with COCO"),
    "train mask-rcnn": ("train.mask_rcnn", "a Mask R-CNN on COCO annotations"),
    "study range": ("study.range", "how far without landmarks: thousands of simulated drives"),
    "study landmarks": ("study.landmarks", "who reaches the goal, by strategy, density and rate"),
    "study field": ("study.field", "the field protocol, simulated, through logs and the replay"),
    "study drive": ("study.drive", "one simulated drive: picture, log, replay, recording"),
    "plugins": ("plugins", "detectors, cues, readers and data sets of other packages"),
    "demo": ("demo", "make a small drive, replay it, score it, show it"),
}

EXIT_STATUS: Final = """\
exit status:
  0  all done
  1  failed, or a gate failed
  2  wrong usage
  3  finished, with losses reported
  4  input unreadable
  130, 143  interrupted"""


class _Parser(argparse.ArgumentParser):
    """Wrong usage is one line, like every other error."""

    def error(self, message: str) -> NoReturn:
        """Say what is wrong, with the nearest option to one that does not exist."""
        import difflib

        hint = f"see {self.prog} --help"
        if message.startswith("unrecognized arguments: -"):
            known = [name for action in self._actions for name in action.option_strings]
            asked = message.partition(": ")[2].split()[0].partition("=")[0]
            close = difflib.get_close_matches(asked, known, n=1)
            hint = f"did you mean {close[0]}? {hint}" if close else hint
        line = one_line(ValueError(f"crosscue: {message}; {hint}"))
        self.exit(2, f"{visible(line)}\n")


class Command(Protocol):
    """What a module in ``commands`` offers."""

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        """Declare flags."""
        ...

    def run(self, args: argparse.Namespace) -> int:
        """Do it; the exit status comes back."""
        ...


def main(argv: Sequence[str] | None = None) -> NoReturn:
    """Run the command line and leave with its exit status."""
    _prepare_streams()
    try:
        status = run(sys.argv[1:] if argv is None else argv)
        sys.stdout.flush()
    except KeyboardInterrupt:
        print("crosscue: interrupted", file=sys.stderr)
        status = 130
    except BrokenPipeError:
        status = _without_reader()
    except OSError as error:
        print(f"crosscue: standard output: {error.strerror}; write it elsewhere", file=sys.stderr)
        status = _without_reader()
    sys.exit(status)


class _Messages(io.FileIO):
    """Standard error: that nobody reads it, or its disk is full, must not stop the work."""

    def write(self, content: Buffer, /) -> int:
        """Write, or forget what cannot be said."""
        try:
            return super().write(content)
        except OSError:
            return memoryview(content).nbytes


def _prepare_streams() -> None:
    """Make standard output and error safe to print to, whatever they are connected to."""
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            # Closed by whoever started us: the next file opened would take its number, and our
            # output with it.
            os.open(os.devnull, os.O_RDWR)
    if sys.stdout is None:
        sys.stdout = open(1, "w", closefd=False)  # noqa: SIM115
    # A topic's name must never stop a command because the terminal cannot show it.
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")
    if sys.stderr is None or isinstance(sys.stderr, io.TextIOWrapper):
        sys.stderr = io.TextIOWrapper(
            io.BufferedWriter(_Messages(2, "w", closefd=False)),
            errors="backslashreplace",
            line_buffering=True,
        )


def _without_reader() -> int:
    """Whoever read our stdout has gone: say nothing more, and let no flush at exit fail."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    return 1


def run(argv: Sequence[str]) -> int:
    """Run one command line; every error of ours becomes one line on stderr.

    Returns:
        The exit status, as ``EXIT_STATUS`` lists them.
    """
    if not argv or argv[0] in ("-h", "--help"):
        print(_overview())
        return 0 if argv else 2
    if argv[0] == "--version":
        print(f"crosscue {installed('crosscue')}")
        return 0
    name = _command_of(argv)
    if name is None:
        return _unknown(argv)
    module = cast("Command", import_module(f"crosscue.eval.commands.{COMMANDS[name][0]}"))
    parser = _Parser(
        prog=f"crosscue {name}",
        description=str(cast("object", module).__doc__),
        formatter_class=argparse.RawDescriptionHelpFormatter,
        epilog=EXIT_STATUS,
        allow_abbrev=False,
    )
    module.add_arguments(parser)
    talk = parser.add_mutually_exclusive_group()
    talk.add_argument("-q", "--quiet", action="store_true", help="say nothing but errors")
    talk.add_argument("-v", "--verbose", action="store_true", help="tracebacks with errors")
    try:
        args = parser.parse_args(list(argv[len(name.split()) :]))
    except SystemExit as stop:
        return int(stop.code or 0)
    with losses_heard() as losses:
        status = _guarded(module, args)
    for loss in losses:
        print(visible(f"crosscue: dropped: {loss}"), file=sys.stderr)
    return 3 if losses and not status else status


def _guarded(module: Command, args: argparse.Namespace) -> int:
    before = signal.signal(signal.SIGTERM, _terminate)
    try:
        status = module.run(args)
        sys.stdout.flush()
        return status
    except CrosscueError as error:
        return _complain(error, error.exit_status, args)
    except KeyboardInterrupt:
        print("crosscue: interrupted", file=sys.stderr)
        return 130
    except _TerminatedError:
        print("crosscue: terminated", file=sys.stderr)
        return 143
    except BrokenPipeError:
        return _without_reader()
    except MemoryError as error:
        return _complain(MemoryError(f"out of memory: {error or 'close other programs'}"), 1, args)
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        hint = (
            "free some space and run again"
            if error.errno == errno.ENOSPC
            else "check the path and its mode"
        )
        return _complain(OSError(f"{where}{error.strerror or error}; {hint}"), 1, args)
    except Exception as error:
        # The last resort: a bug of ours must still be one line, with a way to report it.
        text = (
            f"{type(error).__name__}: {error}; a bug in crosscue: run again with -v and report it"
        )
        if args.verbose:
            raise
        return _complain(RuntimeError(text), 1, args)
    finally:
        signal.signal(signal.SIGTERM, before)


class _TerminatedError(BaseException):
    """SIGTERM arrived; a BaseException, so that no ``except Exception`` keeps us alive."""


def _terminate(number: int, frame: FrameType | None) -> NoReturn:
    raise _TerminatedError


def _complain(error: BaseException, status: int, args: argparse.Namespace) -> int:
    if args.verbose:
        import traceback

        traceback.print_exc()
    print("crosscue: " + visible(one_line(error)), file=sys.stderr)
    return status


def _command_of(argv: Sequence[str]) -> str | None:
    for words in (2, 1):
        name = " ".join(argv[:words])
        if name in COMMANDS:
            return name
    return None


def _unknown(argv: Sequence[str]) -> int:
    import difflib

    asked = " ".join(argv[:2]) if any(n.startswith(argv[0] + " ") for n in COMMANDS) else argv[0]
    close = difflib.get_close_matches(asked, COMMANDS, n=1, cutoff=0.5)
    hint = f"did you mean {close[0]!r}?" if close else "see crosscue --help"
    print(f"crosscue: no command {visible(asked)!r}; {hint}", file=sys.stderr)
    return 2


def _overview() -> str:
    width = max(map(len, COMMANDS))
    lines = [f"  {name:{width}}  {what}" for name, (_, what) in COMMANDS.items()]
    return "\n".join(
        [
            "crosscue COMMAND ...      replay a drive log, score it, see it",
            "",
            *lines,
            "",
            "crosscue COMMAND --help explains one, with an example; --version says which this is.",
            "",
            EXIT_STATUS,
        ]
    )


if __name__ == "__main__":
    main()
