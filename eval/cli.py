"""The ``crosscue`` command: a table of commands, one boundary for errors.

Only the module of the command that was asked for is imported, so ``crosscue --help`` answers at
once. A command is a function of the package and one line in ``COMMANDS``; ``command_line`` makes
its parser from the function's signature and docstring.
"""

from __future__ import annotations

import argparse
import atexit
import difflib
import errno
import gc
import io
import os
import re
import signal
import sys
import warnings
from collections.abc import Iterable, Sequence
from importlib import import_module
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any, Final, NoReturn

# Not from crosscue.replay.base, which needs numpy: the list of commands is printed without it.
from crosscue.replay.errors import CrosscueError, OutputError, one_line, without_secrets
from crosscue.replay.losses import losses_heard
from crosscue.replay.remote.address import is_remote
from crosscue.replay.safe_text import visible
from crosscue.replay.versions import installed

if TYPE_CHECKING:
    from typing_extensions import Buffer

    from crosscue.eval.command_line import Call

COMMANDS: Final = {
    "info": "eval.logs.summary:info",
    "check": "eval.check:check",
    "fetch": "datasets.real.recordings:fetch",
    "convert": "eval.logs.convert:convert",
    "seal": "eval.logs.seals:seal",
    "vehicle init": "eval.vehicle.draft:draft_vehicle",
    "decode": "eval.catalog.decoded_logs:decode",
    "detect": "eval.drives.replay:detect_drive",
    "estimate": "eval.drives.replay:estimate_run",
    "replay": "eval.drives.many:replay",
    "score": "eval.drives.score_runs:score_runs",
    "score detector": "eval.drives.detector_score:score_detector",
    "compare": "eval.fleet.compare:compare_command",
    "status": "eval.batch.journal:batch_status",
    "history": "eval.fleet.history:history",
    "merge": "eval.batch.merge:merge",
    "tag": "eval.fleet.tags:tag",
    "query": "eval.fleet.query:query",
    "view": "eval.recording.view:view",
    "report": "eval.drives.report:report",
    "failures": "eval.failures.search:failures",
    "browse": "eval.failures.browse:browse",
    "export": "eval.failures.labels:export",
    "model list": "detectors.catalog.known_models:models",
    "model show": "detectors.catalog.known_models:model",
    "model fetch": "detectors.catalog.known_models:fetch_models",
    "model init": "detectors.catalog.cards:draft_card",
    "fit compass": "eval.fit.compass:fit_compass",
    "fit odometry": "eval.fit.odometry:fit_odometry",
    "fit signs": "eval.fit.signs.threshold:fit_signs",
    "fit ranges": "eval.fit.ranges.fit:fit_ranges",
    "fit detector": "eval.fit.detector.fit:fit_detector",
    "fit messages": "eval.fit.messages:fit_messages",
    "fit temporal": "eval.fit.temporal:fit_temporal",
    "fit landmarks": "eval.fit.landmarks.fit:fit_landmarks",
    "landmarks add": "eval.landmarks:add_landmarks",
    "landmarks list": "eval.landmarks:list_landmarks",
    "landmarks match": "eval.landmarks:match_landmarks",
    "truth": "datasets.truth.truth:write_truth",
    "truth from-gnss": "eval.fit.gnss_truth:truth_from_gnss",
    "truth from-map": "eval.fit.map_truth:truth_from_map",
    "truth import": "eval.failures.imported_truth:import_truth",
    "truth schema": "datasets.truth.truth:truth_schema",
    "simulate": "datasets.simulate:simulate_approaches",
    "train frames": "eval.training.frames:render_training_frames",
    "train mask-rcnn": "eval.training.mask_rcnn:train_mask_rcnn",
    "train road": "eval.training.road:train_road",
    "study intersections": "eval.studies.intersections.run:run_intersection_study",
    "study layouts": "eval.studies.layouts.run:run_layout_study",
    "study range": "eval.studies.town.run:run_range_study",
    "study landmarks": "eval.studies.town.run:run_landmark_study",
    "study field": "eval.studies.town.field_study:run_field_study",
    "demo": "eval.drives.demo:demo",
    "plugins": "detectors.plugins:plugins",
    "completion": "eval.completion:completion",
}

# The commands that ``crosscue --help`` lists, by what they are for; ``--help all`` lists the rest.
FRONT: Final = {
    "start": ("demo", "info", "check"),
    "run": ("replay", "score", "compare"),
    "look": ("view", "query"),
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

    def parse_known_args(  # type: ignore[override]
        self, args: Sequence[str] | None = None, namespace: argparse.Namespace | None = None
    ) -> tuple[argparse.Namespace, list[str]]:
        """Parse; an unknown option is the first thing to report, before what it leaves missing."""
        known = [name for action in self._actions for name in action.option_strings]
        for word in args or ():
            if word == "--":
                break
            name = word.partition("=")[0]
            if name.startswith("--") and name not in known:
                close = difflib.get_close_matches(name, known, n=1)
                self.error(f"no option {name}" + (f"; did you mean {close[0]}?" if close else ""))
        known_args, rest = super().parse_known_args(args, namespace)
        for action in self._actions:
            value = getattr(known_args, action.dest, None)
            for path in value if isinstance(value, list) else [value]:
                if isinstance(path, Path) and is_remote(str(path).replace(":/", "://", 1)):
                    self.error(f"{path}: expected a path on this machine, found a URL; copy it")
        return known_args, rest

    def error(self, message: str) -> NoReturn:
        end = "" if message.endswith("?") else ";"
        line = one_line(ValueError(f"crosscue: {message}{end} see {self.prog} --help"))
        self.exit(2, f"{visible(line)}\n")


def main(argv: Sequence[str] | None = None) -> NoReturn:
    """Run the command line and leave with its exit status."""
    _prepare_streams()
    # Before NumPy is imported: starting threads for its linear algebra takes longer than a small
    # log, and sums of another order differ from machine to machine.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # Plug-ins of pydantic are not ours, and looking for them reads all installed packages.
    os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "__all__")
    # Starting makes 75,000 objects that stay; looking for garbage among them, and once more among
    # all of them at the end, takes a sixth of a short command's time.
    gc.set_threshold(50_000, 20, 20)
    atexit.register(gc.freeze)
    warnings.formatwarning = lambda message, *_, **__: f"crosscue: {visible(str(message))}\n"
    if "_ARGCOMPLETE" in os.environ:
        from crosscue.eval.completion import complete

        complete(COMMANDS, lambda name: parser_of(name)[1])
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


class _PublicText(io.TextIOWrapper):
    """Standard error without secrets of URLs: libraries print there, too."""

    def write(self, text: str, /) -> int:
        return super().write(without_secrets(text))


class _Messages(io.FileIO):
    """Standard error: that nobody reads it, or its disk is full, must not stop the work."""

    def write(self, content: Buffer, /) -> int:
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
        sys.stderr = _PublicText(
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
    if list(argv[:1]) == ["help"]:
        about = list(argv[1:])
        argv = ["--help", *about] if about in ([], ["all"]) else [*about, "--help"]
    if not argv or argv[0] in ("-h", "--help"):
        print(_overview(has_all=list(argv[1:2]) == ["all"]))
        return 0 if argv else 2
    if argv[0] == "--version":
        print(f"crosscue {installed('crosscue')}")
        return 0
    name = _command_of(argv)
    if name is None:
        return _unknown(argv)
    call, parser = parser_of(name)
    try:
        args = parser.parse_args(list(argv[len(name.split()) :]))
    except SystemExit as stop:
        return int(stop.code or 0)
    with losses_heard() as losses:
        status = _guarded(call, args, parser, losses)
    for loss in losses:
        print(visible(f"crosscue: dropped: {loss}"), file=sys.stderr)
    return 3 if losses and not status else status


def parser_of(name: str) -> tuple[Call, argparse.ArgumentParser]:
    """The call that one command makes, and the parser of its options."""
    from crosscue.eval.command_line import fill

    parser = _Parser(
        prog=f"crosscue {name}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        epilog=EXIT_STATUS,
        allow_abbrev=False,
    )
    path, _, function = COMMANDS[name].partition(":")
    call = fill(parser, getattr(import_module(f"crosscue.{path}"), function))
    talk = parser.add_mutually_exclusive_group()
    talk.add_argument("-q", "--quiet", action="store_true", help="print only errors")
    talk.add_argument(
        "-v", "--verbose", action="store_true", help="print all lines, and tracebacks"
    )
    return call, parser


def _guarded(
    call: Call, args: argparse.Namespace, parser: argparse.ArgumentParser, losses: list[str]
) -> int:
    from crosscue.eval.command_line import with_options
    from crosscue.eval.terminal import print_found, watched

    before = signal.signal(signal.SIGTERM, _terminate)
    try:
        with watched(args):
            page = getattr(args, "page_of_result", None)
            if page is not None and page.exists() and not getattr(args, args.name_of_overwrite):
                raise OutputError(f"{page}: exists; give another name or --overwrite")
            found: Any = call(args)
            status = print_found(found, args)
            if page is not None:
                found.write_page(page, losses)
        sys.stdout.flush()
        return status
    except CrosscueError as error:
        error.args = (with_options(str(error), parser),)
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
        status = 4 if error.errno == errno.ENAMETOOLONG else 1
        return _complain(OSError(f"{where}{error.strerror or error}; {hint}"), status, args)
    except Exception as error:
        # The last resort: a bug in crosscue must still be one line, with a way to report it.
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

        print(without_secrets(traceback.format_exc()), end="", file=sys.stderr)
    print("crosscue: " + visible(one_line(error)), file=sys.stderr)
    return status


def _command_of(argv: Sequence[str]) -> str | None:
    for words in (2, 1):
        name = " ".join(argv[:words])
        if name in COMMANDS:
            return name
    return None


def _unknown(argv: Sequence[str]) -> int:
    members = [name for name in COMMANDS if name.startswith(argv[0] + " ")]
    if members and len(argv) > 1 and argv[1] in ("-h", "--help"):
        examples = [f"  {_docstring_of(name)[1]}" for name in members]
        lines = [*_lines(members, max(map(len, members))), "", "examples:", *examples]
        print("\n".join([*lines, "", f"crosscue {members[0]} --help describes a command."]))
        return 0
    if members and len(argv) == 1:
        print(f"crosscue: {argv[0]}: needs one of: {', '.join(members)}", file=sys.stderr)
        return 2
    asked = " ".join(argv[:2]) if members else argv[0]
    # "fti compass": the first of two words is the misspelt one.
    known = [*COMMANDS, "--help", "--version"]
    close = [
        match
        for text in dict.fromkeys((asked, " ".join(argv[:2])))
        for match in difflib.get_close_matches(text, known, n=1, cutoff=0.6)
    ]
    hint = f"did you mean {close[-1]!r}?" if close else "see crosscue --help"
    print(f"crosscue: no command {visible(asked)!r}; {hint}", file=sys.stderr)
    return 2


def _lines(names: Iterable[str], width: int) -> list[str]:
    return [f"  {_coloured(f'{name:{width}}', '36')}  {summary_of(name)}" for name in names]


def summary_of(name: str) -> str:
    """Return one line on a command: the first of its function's docstring."""
    return _docstring_of(name)[0]


def _docstring_of(name: str) -> tuple[str, str]:
    """Return the first line and the first example of a command's docstring.

    It is read from the source, because the list of commands is printed without any import.
    """
    where = COMMANDS[name]
    module, _, function = where.partition(":")
    path = Path(__file__).parents[1].joinpath(*module.split(".")).with_suffix(".py")
    text = path.read_text(encoding="utf-8")
    found = re.search(rf'^def {function}\(.*?"""(.*?)"""', text, re.DOTALL | re.MULTILINE)
    assert found is not None, where
    summary = found[1].partition("\n")[0].removesuffix(".")
    examples = re.sub(r"\\+\n +", "", found[1].rpartition("Examples:")[2])
    example = re.search(rf"^ +(crosscue {name}.*?)(?: {{3,}}.*)?$", examples, re.MULTILINE)
    return summary[:1].lower() + summary[1:], "" if example is None else example[1]


def _overview(*, has_all: bool) -> str:
    front = {name for names in FRONT.values() for name in names}
    groups = dict(FRONT)
    if has_all:
        groups["all other commands"] = tuple(name for name in COMMANDS if name not in front)
    width = max(len(name) for names in groups.values() for name in names)
    lines = ["crosscue COMMAND ...      replay drive logs, score them, show them"]
    for title, names in groups.items():
        lines += ["", _coloured(f"{title}:", "1"), *_lines(names, width)]
    rest = "" if has_all else f"; crosscue --help all lists {len(COMMANDS) - len(front)} more"
    lines += ["", f"crosscue COMMAND --help describes a command{rest}."]
    return "\n".join([*lines, "crosscue --version prints the version.", "", EXIT_STATUS])


def _coloured(text: str, code: str) -> str:
    """Return a text with a terminal's escape sequence, if a terminal shows it."""
    is_plain = "NO_COLOR" in os.environ or os.environ.get("TERM") == "dumb"
    return text if is_plain or not sys.stdout.isatty() else f"\033[{code}m{text}\033[0m"


if __name__ == "__main__":
    main()
