"""Reader of ROS 2 bag folders: all storage files, listed or not, in order of time.

``metadata.yaml`` is a hint. Files that it lists but the folder lacks are dropped with their
declared counts. If it counts more rows than the files have, the difference is dropped. If the files
have more rows, a notice is added.
"""

from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Final, cast

import numpy as np

from crosscue.replay.base import EVERYTHING, Selection
from crosscue.replay.columns import Block, Messages, Topic
from crosscue.replay.errors import LogError
from crosscue.replay.files.closing import Closing
from crosscue.replay.ledger import DETAILS_KEPT, OTHER_TYPE, Ledger
from crosscue.replay.limits import DEFAULT_LIMITS, Limits

from .inflate import DAMAGED, inflated
from .merge import StorageStream, merge_streams
from .metadata import SplitHint, read_metadata
from .split import PACKED, PACKED_DAMAGED, Split, examined, open_storage, stored_files

MISSING: Final = "storage file is missing"
UNREADABLE: Final = "storage file cannot be opened"
BY_METADATA: Final = "metadata.yaml counts more"


class FolderLog(Closing):
    """An open ROS 2 bag folder; see ``crosscue.replay.base.Log``."""

    format: Final = "rosbag2"

    def __init__(self, path: Path, limits: Limits = DEFAULT_LIMITS) -> None:
        """Find the storage files and their topics.

        Raises:
            LogError: No storage file can be opened.
            OSError: The folder cannot be listed.
        """
        self.path: Final = path
        self._limits = limits
        self._notices: list[str] = []
        self._metadata = read_metadata(path / "metadata.yaml")
        if self._metadata.fault:
            self._notices.append(
                f"metadata.yaml: {self._metadata.fault}; the storage files were read without it"
            )
        files = stored_files(path, self._metadata, self._notices)
        self._splits = [examined(file, self._metadata, limits) for file in files]
        if not any(not split.fault for split in self._splits):
            why = "; ".join(split.fault for split in self._splits)
            raise LogError(
                f"{path}: {why or 'no .db3 or .mcap file in it'}; expected at least one "
                "readable storage file"
            )
        self._topics = _union(self._splits)

    @property
    def topics(self) -> tuple[Topic, ...]:
        """Topics of all storage files, with counts if all files with the topic declare one."""
        return tuple(self._topics.values())

    def read(self, ledger: Ledger, selection: Selection = EVERYTHING) -> Iterator[Block]:
        """Yield the blocks of all storage files; files with overlapping times are merged."""
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
                    yield from merge_streams(streams)
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
        """Report missing, unreadable and truncated storage files; see ``KnowsItsEnd``."""
        for split in self._splits:
            if split.fault:
                ledger.drop("", UNREADABLE, None, split.fault)
            for one in split.missing:
                ledger.drop(one.topic, one.reason, one.count, f"{split.path.name}: {one.detail}")
        for hint in self._absent():
            ledger.drop("", MISSING, hint.count, hint.name)

    def _stream(
        self, split: Split, ledger: Ledger, selection: Selection, stack: ExitStack
    ) -> StorageStream:
        log, fault = stack.enter_context(open_storage(split.path, self._limits))
        if fault:
            ledger.drop("", PACKED_DAMAGED, None, fault)
        elif split.path.name.endswith(PACKED):
            ledger.notice("was decompressed to a temporary file")
        names = frozenset(topic.name for topic in split.topics)
        odd = frozenset(
            t.name for t in split.topics if t.type_name != self._topics[t.name].type_name
        )
        blocks = self._blocks(log.read(ledger, selection), odd, ledger)
        return StorageStream(blocks, names)

    def _blocks(
        self, blocks: Iterator[Block], odd: frozenset[str], ledger: Ledger
    ) -> Iterator[Block]:
        """Yield blocks with decompressed messages, without topics of another type."""
        for block in blocks:
            if block.topic in odd:
                ledger.skip(block.topic, OTHER_TYPE, len(block))
            elif not isinstance(block.rows, Messages):
                yield block
            else:
                yield from _unpacked(block, self._limits, ledger)

    def _absent(self) -> list[SplitHint]:
        """Return the storage files in ``metadata.yaml`` that the folder lacks."""
        held = {split.path.name for split in self._splits}
        present = held | {name.removesuffix(PACKED) for name in held} | {n + PACKED for n in held}
        return [hint for hint in self._metadata.splits if hint.name not in present]

    def _settle(self, ledger: Ledger) -> None:
        """Compare with the counts in ``metadata.yaml``, and account for missing files."""
        metadata = self._metadata
        absent = self._absent()
        shut = [split for split in self._splits if split.fault]
        gone = [(hint.name, MISSING) for hint in absent] + [
            (split.path.name, UNREADABLE) for split in shut
        ]
        reason = gone[0][1] if gone else BY_METADATA
        detail = ", ".join(name for name, _ in gone)
        # Dropped rows of unknown topics must not be counted again.
        is_counted = "" in ledger.accounts and ledger.accounts[""].dropped.total() > 0
        # The same number of rows under another name is a renamed topic, not a loss.
        held = sum(account.in_file for account in ledger.accounts.values())
        is_short = not ledger.is_whole or bool(gone) or sum(metadata.counts.values()) > held
        missing: dict[str, int] = {}
        for name, count in metadata.counts.items():
            in_file = ledger.accounts[name].in_file if name in ledger.accounts else 0
            missing[name] = count - in_file
            if missing[name] > 0 and is_short and not is_counted:
                counted = f"metadata.yaml counts {count} messages, the files contain {in_file}"
                ledger.drop(name, reason, missing[name], detail or counted)
            elif missing[name]:
                ledger.notice(
                    f"{name}: metadata.yaml counts {count} messages, the files contain {in_file}"
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
    """Group splits with overlapping times, by start time; one group if a split has no times."""
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
    """Return the declared counts of a split's topics, with 1 for an unknown count."""
    return [1 if topic.declared is None else topic.declared for topic in split.topics]


def _unpacked(block: Block, limits: Limits, ledger: Ledger) -> Iterator[Block]:
    """Decompress the individually compressed messages of a block."""
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
