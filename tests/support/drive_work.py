"""Work on made-up drives, importable by workers; the word in a log selects the outcome."""

import os
import signal
import time
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import pyarrow as pa

from crosscue.eval.batch.jobs import Job
from crosscue.eval.runs.account import LogAccount, account
from crosscue.eval.runs.folder import clear, create, locked, write_manifest
from crosscue.eval.runs.tables.parquet import TableSink
from crosscue.replay.errors import LogFormatError, LossWarning

from .manifests import estimated, log_account

SCHEMA = pa.schema([("t_ns", pa.int64()), ("letter", pa.string())])


@dataclass(frozen=True, slots=True)
class Letters:
    """Result of the work on one made-up drive."""

    rows: int
    exit_status: int
    pid: int
    threads: str


def write_jobs(folder: Path, words: Sequence[str], runs: str = "runs") -> list[Job]:
    """Write one log for each word, and return their jobs."""
    folder.mkdir(parents=True, exist_ok=True)
    jobs = []
    for i, word in enumerate(words):
        log = folder / f"drive{i}.txt"
        if not log.exists():
            log.write_text(word)
        jobs.append(Job(f"drive{i}", (str(log),), folder / runs / f"drive{i}", "settings 1"))
    return jobs


def letters(job: Job) -> Letters:
    """Write the letters of the log's word as rows, or fail in the way that the word names."""
    log = Path(job.logs[0])
    word = log.read_text()
    run = create(job.run, overwrite=True)
    with locked(run):
        clear(run, {"identity": [word], "settings": {"word": word}})
        with TableSink(run, "pose", SCHEMA) as sink:
            sink.write({"t_ns": range(len(word)), "letter": list(word)})
            _obey(word, log)
        write_manifest(run, estimated(account=account([_account(log, word)])))
    status = 3 if word == "loss" else 0
    return Letters(len(word), status, os.getpid(), os.environ.get("OMP_NUM_THREADS", ""))


def _account(log: Path, word: str) -> LogAccount:
    found = log_account(str(log), "letters", used=len(word) - 1, skipped={"dull": 1})
    return found.model_copy(update={"is_whole": word != "loss"})


def _node() -> str:
    """Return the identifier of the Ray node on which this process runs."""
    import ray

    return str(ray.get_runtime_context().get_node_id())


def _obey(word: str, log: Path) -> None:
    match word:
        case "damaged":
            raise LogFormatError(f"{log}: cut; copy it again")
        case "warns":
            warnings.warn(f"{log}: bytes 0 to 5 differ from the seal", LossWarning, stacklevel=1)
        case "bug":
            raise ZeroDivisionError("a\nbug")
        case "memory":
            raise MemoryError
        case "dies":
            os.kill(os.getpid(), signal.SIGKILL)
        case "dies once" if not log.with_suffix(".died").exists():
            log.with_suffix(".died").touch()
            os.kill(os.getpid(), signal.SIGKILL)
        case "leaves":
            os._exit(7)
        case "waits once" if not log.with_suffix(".begun").exists():
            log.with_suffix(".begun").write_text(_node())
            end = time.monotonic() + 60.0
            while time.monotonic() < end and not log.with_suffix(".go").exists():
                time.sleep(0.05)
        case "slow":
            log.with_suffix(".begun").write_text(str(os.getpid()))
            time.sleep(60.0)
        case _:
            return
