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
from typing import Final, NoReturn, Protocol, cast

from crosscue.replay.errors import CrosscueError, one_line

from .plain_text import visible

COMMANDS: Final[dict[str, tuple[str, str]]] = {
    "info": ("info", "topics, counts, clocks, gaps and health of a log"),
    "convert": ("convert", "any log or data set to MCAP with ROS 2 types"),
    "vehicle init": ("vehicle_init", "write a first vehicle file from what a log holds"),
    "decode": ("decode", "every stream as columns: a Parquet file for each topic or CAN message"),
    "detect": ("detect", "run detectors over the camera: detections, road, cues"),
    "estimate": ("estimate", "estimate a run again, from what detectors found before"),
    "replay": ("replay", "the main job: from a log to a run folder"),
    "score": ("score", "runs against truth: metrics, figures, report, gates"),
    "compare": ("compare", "what changed between two runs, with tolerances"),
    "view": ("view", "a run in Rerun"),
    "fit compass": ("fit_compass", "compass mounting, hard and soft iron from a drive"),
    "fit signs": ("fit_signs", "the sign threshold for a wanted precision"),
    "fit ranges": ("fit_ranges", "from heights in pixels to ranges, with residuals"),
    "fit messages": ("fit_messages", "how far each cue is to be believed, from annotated drives"),
    "fit landmarks": ("fit_landmarks", "the match threshold for a wanted false-match rate"),
    "landmarks add": ("landmarks_add", "pictures and where they were taken into a database"),
    "landmarks list": ("landmarks_list", "what a landmark database holds"),
    "landmarks match": ("landmarks_match", "one picture against a landmark database"),
    "truth": ("truth", "write the truth that a data set carries"),
    "truth import": ("truth_import", "annotations from COCO or CVAT as truth"),
    "truth check": ("truth_check", "does a truth file fit its log?"),
    "truth schema": ("truth_schema", "the JSON Schema of truth.json"),
    "simulate": ("simulate", "drives up to intersections, with camera, CAN, Mobileye and truth"),
    "train road": ("train_road", "the road network, on simulated or own pictures"),
    "study intersections": (
        "study_intersections",
        "the published experiment on simulated drives, table beside table",
    ),
    "train frames": ("train_frames", "pictures of simulated intersections to train on, with COCO"),
    "train mask-rcnn": ("train_mask_rcnn", "a Mask R-CNN on COCO annotations"),
    "study range": ("study_range", "how far without landmarks: thousands of simulated drives"),
    "study landmarks": ("study_landmarks", "who reaches the goal, by strategy, density and rate"),
    "study field": ("study_field", "the field protocol, simulated, through logs and the replay"),
    "study drive": ("study_drive", "one simulated drive: picture, log, replay, recording"),
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
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            # A topic's name must never stop a command because the terminal cannot show it.
            stream.reconfigure(errors="backslashreplace")
    sys.exit(run(sys.argv[1:] if argv is None else argv))


def run(argv: Sequence[str]) -> int:
    """Run one command line; every error of ours becomes one line on stderr.

    Returns:
        The exit status, as ``EXIT_STATUS`` lists them.
    """
    if not argv or argv[0] in ("-h", "--help"):
        print(_overview())
        return 0 if argv else 2
    if argv[0] == "--version":
        from importlib.metadata import version

        print(f"crosscue {version('crosscue')}")
        return 0
    name = _command_of(argv)
    if name is None:
        return _unknown(argv)
    module = cast("Command", import_module(f"crosscue.eval.commands.{COMMANDS[name][0]}"))
    parser = argparse.ArgumentParser(
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
    return _guarded(module, args)


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
        # Whoever read our stdout has gone; nothing is left to say, and no flush at exit may fail.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
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
