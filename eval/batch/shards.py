"""Shards: the part of many drives that one task of a scheduler processes.

A hash of a drive's identity selects its shard, not its position in a list. Drives can therefore be
added, removed or named in another order, and every other drive stays in its shard.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

from crosscue.replay.errors import UsageError

AUTO: Final = "auto"
SLURM: Final = "SLURM_ARRAY_TASK_"
# Variables that torchrun, MPI launchers for PyTorch and many schedulers set; ranks start at 0.
RANKS: Final = ("RANK", "WORLD_SIZE")


@dataclass(frozen=True, slots=True)
class Shard:
    """One of several parts; written ``2/4``.

    Attributes:
        number: Index of the part, from 1.
        count: Number of parts.
    """

    number: int
    count: int

    def holds(self, identity: str) -> bool:
        """Return whether the drive of this identity belongs to this part, and so to no other."""
        digest = hashlib.sha256(identity.encode()).digest()
        return int.from_bytes(digest, "big") % self.count == self.number - 1

    def __str__(self) -> str:
        return f"{self.number}/{self.count}"


def read_shard(text: str, environment: Mapping[str, str]) -> Shard:
    """Parse ``2/4``, or read a scheduler's variables for ``auto``.

    Args:
        text: Value of ``--shard``.
        environment: Environment variables by name.

    Raises:
        UsageError: The text has neither form, the variables are missing or belong to two
            schedulers, or array tasks are not numbered in equal steps.
    """
    if text == AUTO:
        return _of_scheduler(environment)
    found = re.fullmatch(r"([0-9]{1,9})/([0-9]{1,9})", text)
    shard = Shard(*map(int, found.groups())) if found else Shard(0, 0)
    if not 1 <= shard.number <= shard.count:
        raise UsageError(f"--shard {text}: expected i/n with i from 1 to n, such as 2/4, or {AUTO}")
    return shard


def _of_scheduler(environment: Mapping[str, str]) -> Shard:
    is_array = f"{SLURM}ID" in environment
    is_ranked = all(name in environment for name in RANKS)
    if is_array and is_ranked:
        raise UsageError(
            f"--shard {AUTO}: both {SLURM}ID and {RANKS[0]} are set; use --shard i/n instead"
        )
    if is_array:
        return _of_array(environment)
    if not is_ranked:
        raise UsageError(
            f"--shard {AUTO}: neither {SLURM}ID nor {' and '.join(RANKS)} is set; run it as a task "
            "of a scheduler, or use --shard i/n"
        )
    rank, size = (_number(environment, name) for name in RANKS)
    return _checked(rank + 1, size, f"{RANKS[0]}={rank}, {RANKS[1]}={size}")


def _of_array(environment: Mapping[str, str]) -> Shard:
    """Return the shard of a SLURM array task, for any first number and step."""
    here, count = (_number(environment, SLURM + name) for name in ("ID", "COUNT"))
    first = _number(environment, f"{SLURM}MIN", 0)
    step = max(_number(environment, f"{SLURM}STEP", 1), 1)
    last = _number(environment, f"{SLURM}MAX", first + (count - 1) * step)
    values = f"{SLURM}ID={here}, MIN={first}, MAX={last}, STEP={step}, COUNT={count}"
    # A list such as --array=1,3,7 does not determine the index of a task.
    if last - first != (count - 1) * step or (here - first) % step:
        raise UsageError(
            f"--shard {AUTO}: {values}: expected array tasks in equal steps, such as --array=1-8"
        )
    return _checked((here - first) // step + 1, count, values)


def _number(environment: Mapping[str, str], name: str, default: int | None = None) -> int:
    text = environment.get(name, "" if default is None else str(default))
    if not re.fullmatch(r"[0-9]{1,9}", text):
        raise UsageError(f"--shard {AUTO}: {name}={text!r}: expected a whole number")
    return int(text)


def _checked(number: int, count: int, values: str) -> Shard:
    if not 1 <= number <= count:
        raise UsageError(f"--shard {AUTO}: {values}: outside its own range; use --shard i/n")
    return Shard(number, count)
