"""Show a run in Rerun, or write the recording to a file.

--at records 6 s, from 2 s before a moment, and marks the moment on the time line. (A recording
cannot set Rerun's cursor, so the viewer starts at the beginning.) --approach records one approach.
--only records some of the views: cameras, ahead, belief, ranges, cues, map, pose, notes. The
recording contains only what is shown.

examples:
  crosscue view runs/drive                    open Rerun's viewer
  crosscue view runs/drive --at 12.3          at 12.3 s from the first frame
  crosscue view runs/drive --approach 1 --only cameras,belief
  crosscue view runs/drive -o drive.rrd       write the recording, open nothing
  crosscue view runs/drive --web              serve the viewer to a browser on this machine
"""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import crosscue
from crosscue.eval.commands.shared.terminal import (
    add_logs_arguments,
    limits_of,
    print_json,
    refuse_existing,
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options to the parser."""
    parser.add_argument("run", type=Path, metavar="RUN", help="run folder")
    how = parser.add_mutually_exclusive_group()
    how.add_argument(
        "-o",
        "--output",
        type=Path,
        metavar="X.rrd",
        help="write the recording without opening the viewer",
    )
    how.add_argument(
        "--web", action="store_true", help="serve the viewer on 127.0.0.1 for a browser"
    )
    part = parser.add_mutually_exclusive_group()
    part.add_argument(
        "--at", metavar="T", help="seconds from the run's first frame, or a time (17...ns)"
    )
    part.add_argument(
        "--approach", type=int, metavar="N", help="number of an approach in belief.parquet"
    )
    parser.add_argument(
        "--only", default="", metavar="VIEWS", help="comma-separated views, such as cameras,belief"
    )
    add_logs_arguments(parser)
    parser.add_argument(
        "--truth",
        type=Path,
        metavar="T.json",
        help="truth file, to also draw the true track and ranges",
    )
    parser.add_argument("--overwrite", action="store_true", help="replace an existing recording")
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def run(args: argparse.Namespace) -> int:
    """Write the recording and open it; return 3 when the run has drops."""
    if args.output is not None and args.output.suffix != ".rrd":
        raise crosscue.UsageError(f"{args.output}: expected a name that ends in .rrd")
    refuse_existing(args)
    made = crosscue.open_run(
        args.run, args.logs, without_images=args.without_images, limits=limits_of(args)
    )
    path = crosscue.save_recording(
        made,
        args.output,
        args.truth,
        at=args.at,
        approach=args.approach,
        only=[name for name in args.only.split(",") if name],
    )
    if args.output is not None:
        if args.json:
            print_json({"recording": str(path)})
        elif not args.quiet:
            print(path)
    else:
        _open(path, args.web)
    return 0 if made.manifest.account.is_whole else 3


def _open(path: Path, web: bool) -> None:
    # Rerun's Python API listens on every address; only its command can be bound to localhost.
    command = [sys.executable, "-m", "rerun", "--bind", "127.0.0.1", str(path)]
    if web:
        command.append("--serve-web")
    environment = {**os.environ, "RERUN_ANALYTICS": "0"}
    try:
        viewer = subprocess.Popen(command, env=environment, process_group=0)
    except OSError as error:
        raise crosscue.CrosscueError(
            f"rerun: cannot be started ({error.strerror}); open {path}"
        ) from None
    try:
        status = viewer.wait()
    finally:
        # Rerun's command starts the viewer as a child process, which could outlive it.
        with suppress(ProcessLookupError):
            os.killpg(viewer.pid, signal.SIGTERM)
        viewer.wait()
    if status:
        raise crosscue.CrosscueError(
            f"rerun: ended with status {status}; open {path} with another viewer"
        )
