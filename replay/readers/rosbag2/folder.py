"""ROS 2 bag folders: every storage file in them, listed or not, in the order of time.

``metadata.yaml`` is a hint. What it lists and the folder lacks is dropped with its declared counts,
and so is what it counts beyond the rows in the files; what the files hold beyond that is a notice.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Final, cast

import numpy as np

from crosscue.replay.base import (
    DEFAULT_LIMITS,
    DETAILS_KEPT,
    EVERYTHING,
    Block,
    Closing,
    Ledger,
    Limits,
    LogError,
    Messages,
    Selection,
    Topic,
)

from .inflate import DAMAGED, inflated
from .merge import Stream, merged
from .metadata import SplitHint, read_metadata
from .split import PACKED, PACKED_DAMAGED, Split, look_into, opened, stored_files

MISSING: Final = "storage file is missing"
UNREADABLE: Final = "storage file cannot be opened"
BY_METADATA: Final = "metadata.yaml counts more"
OTHER_TYPE: Final = "another message type on the same topic"


class FolderLog(Closing):
    """An open ROS 2 bag folder; see ``crosscue.replay.base.Log``."""

    def __init__(self, path: Path, limits: Limits) -> None:
        """Find its storage files and learn their topics.

        Raises:
            LogError: Not one storage file can be opened.
            OSError: The folder cannot be listed.
        """
        self._path = path
        self._limits = limits
        self._notices: list[str] = []
        self._metadata = read_metadata(path / "metadata.yaml")
        if self._metadata.fault:
            self._notices.append(
                f"metadata.yaml: {self._metadata.fault}; the storage files were read without it"
            )
        files = stored_files(path, self._metadata, self._notices)
        self._splits = [look_into(file, self._metadata, limits) for file in files]
        if not any(not split.fault for split in self._splits):
            why = "; ".join(split.fault for split in self._splits)
            raise LogError(
                f"{path}: {why or 'no .db3 or .mcap file in it'}; expected at least one "
                "storage file that opens"
            )
        self._topics = _union(self._splits)

    @property
    def path(self) -> Path:
        """Where it is."""
        return self._path

    @property
    def format(self) -> str:
        """``rosbag2``."""
        return "rosbag2"

    @property
    def topics(self) -> tuple[Topic, ...]:
        """Topics of all storage files; a count is known where every file with the topic has one."""
        return tuple(self._topics.values())

    def read(self, ledger: Ledger, selection: Selection = EVERYTHING) -> Iterator[Block]:
        """Blocks of all storage files; where their times overlap, topics are merged by time."""
        for sentence in self._notices:
            ledger.notice(sentence)
        for topic in self.topics:
            ledger.declare(topic.name, topic.declared)
        integrity: dict[str, list[str]] = {}
        for group in _groups([split for split in self._splits if not split.fault]):
            own = [Ledger(str(split.path)) for split in group]
            with ExitStack() as stack:
                streams = [
                    self._stream(split, one, selection, stack)
                    for split, one in zip(group, own, strict=True)
                ]
                try:
                    yield from merged(streams)
                finally:
                    for split, one in zip(group, own, strict=True):
                        _absorb(ledger, one, split.path.name)
                        integrity.setdefault(one.integrity, []).append(split.path.name)
        self._settle(ledger)
        ledger.integrity = " | ".join(
            said if len(integrity) == 1 else f"{', '.join(names)}: {said}"
            for said, names in integrity.items()
        )

    def report_missing(self, ledger: Ledger) -> None:
        """Storage files that are missing, cannot be opened or are cut; see ``KnowsItsEnd``."""
        for split in self._splits:
            if split.fault:
                ledger.drop("", UNREADABLE, None, split.fault)
            for one in split.missing:
                ledger.drop(one.topic, one.reason, one.count, f"{split.path.name}: {one.detail}")
        for hint in self._absent():
            ledger.drop("", MISSING, hint.count, hint.name)

    def close(self) -> None:
        """Nothing stays open between reads."""

    def _stream(
        self, split: Split, ledger: Ledger, selection: Selection, stack: ExitStack
    ) -> Stream:
        log, fault = stack.enter_context(opened(split.path, self._limits))
        if fault:
            ledger.drop("", PACKED_DAMAGED, None, fault)
        elif split.path.name.endswith(PACKED):
            ledger.notice("was unpacked to a temporary file")
        names = frozenset(topic.name for topic in split.topics)
        odd = frozenset(
            t.name for t in split.topics if t.type_name != self._topics[t.name].type_name
        )
        blocks = self._blocks(log.read(ledger, selection), odd, ledger)
        return Stream(blocks, names)

    def _blocks(
        self, blocks: Iterator[Block], odd: frozenset[str], ledger: Ledger
    ) -> Iterator[Block]:
        """Blocks with messages decompressed; topics of another type are left out."""
        for block in blocks:
            if block.topic in odd:
                ledger.skip(block.topic, OTHER_TYPE, len(block))
            elif not isinstance(block.rows, Messages):
                yield block
            else:
                yield from _unpacked(block, self._limits, ledger)

    def _absent(self) -> list[SplitHint]:
        """Storage files that ``metadata.yaml`` lists and the folder lacks."""
        held = {split.path.name for split in self._splits}
        present = held | {name.removesuffix(PACKED) for name in held} | {n + PACKED for n in held}
        return [hint for hint in self._metadata.splits if hint.name not in present]

    def _settle(self, ledger: Ledger) -> None:
        """Compare with what ``metadata.yaml`` says and account for files that are not there."""
        metadata = self._metadata
        absent = self._absent()
        shut = [split for split in self._splits if split.fault]
        gone = [(hint.name, MISSING) for hint in absent] + [
            (split.path.name, UNREADABLE) for split in shut
        ]
        reason = gone[0][1] if gone else BY_METADATA
        detail = ", ".join(name for name, _ in gone)
        # Rows lost from a known number of nameless ones must not be counted a second time.
        is_counted = "" in ledger.accounts and ledger.accounts[""].dropped.total() > 0
        # As many rows under another name are a renamed topic, not missing rows.
        held = sum(account.in_file for account in ledger.accounts.values())
        is_short = not ledger.is_whole or bool(gone) or sum(metadata.counts.values()) > held
        missing: dict[str, int] = {}
        for name, count in metadata.counts.items():
            in_file = ledger.accounts[name].in_file if name in ledger.accounts else 0
            missing[name] = count - in_file
            if missing[name] > 0 and is_short and not is_counted:
                counted = f"metadata.yaml counts {count} messages, the files hold {in_file}"
                ledger.drop(name, reason, missing[name], detail or counted)
            elif missing[name]:
                ledger.notice(
                    f"{name}: metadata.yaml counts {count} messages, the files hold {in_file}"
                )
        for name, why in gone:
            hint = next((h for h in metadata.splits if h.name == name), None)
            if not any(count > 0 for count in missing.values()):
                ledger.drop("", why, hint.count if hint is not None else None, name)
            else:
                ledger.notice(f"{name}: {why}")
        for split in shut:
            ledger.notice(split.fault)


def _union(splits: list[Split]) -> dict[str, Topic]:
    topics: dict[str, Topic] = {}
    for topic in (topic for split in splits for topic in split.topics):
        first = topics.get(topic.name)
        if first is None:
            topics[topic.name] = topic
        elif first.type_name == topic.type_name:
            known = first.declared is not None and topic.declared is not None
            total = (first.declared or 0) + (topic.declared or 0) if known else None
            source = first if first.schema else topic
            topics[topic.name] = replace(source, declared=total)
    return topics


def _groups(splits: list[Split]) -> list[list[Split]]:
    """Splits by start time; those whose times overlap in one group, or all if one has no times."""
    timed = [split for split in splits if split.range_ns is not None]
    empty = [split for split in splits if split.range_ns is None and not any(_counted(split))]
    if len(timed) + len(empty) < len(splits):
        return [splits]
    groups = [[split] for split in empty]
    end_ns: int | None = None
    for split in sorted(timed, key=lambda s: s.range_ns or (0, 0)):
        first_ns, last_ns = split.range_ns or (0, 0)
        if end_ns is not None and first_ns < end_ns:
            groups[-1].append(split)
            end_ns = max(end_ns, last_ns)
        else:
            groups.append([split])
            end_ns = last_ns
    return groups


def _counted(split: Split) -> list[int]:
    """Declared counts of its topics, one for an unknown count."""
    return [1 if topic.declared is None else topic.declared for topic in split.topics]


def _unpacked(block: Block, limits: Limits, ledger: Ledger) -> Iterator[Block]:
    """The block with messages that were compressed one by one decompressed."""
    messages = cast("Messages", block.rows)
    for part, plain, damaged in inflated(messages, limits):
        if plain is messages:
            yield block
            continue
        stretch = replace(block.take(part), rows=plain)
        for i, why in damaged.items():
            ledger.find(block.topic, -1)
            ledger.drop(block.topic, DAMAGED, 1, why, int(stretch.log_ns[i]))
        if damaged:
            stretch = stretch.take(np.delete(np.arange(len(stretch)), list(damaged)))
        yield stretch


def _absorb(ledger: Ledger, own: Ledger, name: str) -> None:
    """Add one storage file's account to the folder's."""
    for topic, account in own.accounts.items():
        total = ledger.topic(topic)
        total.found += account.found
        total.skipped.update(account.skipped)
        total.dropped.update(account.dropped)
        total.dropped_unknown.extend(account.dropped_unknown)
    room = max(0, DETAILS_KEPT - len(ledger.details))
    ledger.details.extend(
        replace(detail, detail=f"{name}: {detail.detail}") for detail in own.details[:room]
    )
    for sentence in own.notices:
        ledger.notice(f"{name}: {sentence}")


def open_folder(path: Path, limits: Limits = DEFAULT_LIMITS) -> FolderLog:
    """Open a ROS 2 bag folder.

    Raises:
        LogError: Not one storage file in it can be opened.
        OSError: The folder cannot be listed.
    """
    return FolderLog(path, limits)
