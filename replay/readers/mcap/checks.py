"""Counts of the checks of one pass, and their report."""

from dataclasses import dataclass, field

from crosscue.replay.ledger import Ledger
from crosscue.replay.safe_text import counted


@dataclass(slots=True)
class CaseCount:
    """Number of cases, with a description of the first one."""

    count: int = 0
    first: str = ""

    def add(self, case: str) -> None:
        """Count a case."""
        self.count += 1
        self.first = self.first or case


@dataclass(slots=True)
class Checks:
    """Counts of checks over all recordings of a file."""

    chunks: int = 0
    chunks_right: int = 0
    chunks_bare: int = 0
    chunks_unread: int = 0
    rows_bare: int = 0
    sections_right: int = 0
    sections_wrong: int = 0
    sections_unread: int = 0
    summaries_right: int = 0
    attachments: int = 0
    attachments_unread: int = 0
    attachments_right: int = 0
    bad_attachments: CaseCount = field(default_factory=CaseCount)
    bad_indexes: CaseCount = field(default_factory=CaseCount)
    bad_heads: CaseCount = field(default_factory=CaseCount)
    bad_definitions: CaseCount = field(default_factory=CaseCount)
    ignored: CaseCount = field(default_factory=CaseCount)

    def report(self, ledger: Ledger) -> None:
        """Report the checks in the ledger."""
        ledger.integrity = self._integrity()
        if self.chunks_bare and self.chunks_right:
            ledger.notice(
                f"{self.chunks_bare} of {self.chunks} chunks have no checksum, unlike the others"
            )
        for tally, sentence in (
            (
                self.bad_indexes,
                "message indexes that do not match their chunks; these were scanned",
            ),
            (
                self.bad_heads,
                "chunks that match their checksum but not what the file states about them",
            ),
            (self.bad_attachments, "attachments that do not match their checksum"),
            (self.bad_definitions, "schemas or channels that cannot be read or contradict"),
            (self.ignored, "records of unknown kinds, ignored"),
        ):
            if tally.count:
                ledger.notice(f"{tally.count} {sentence}; the first: {tally.first}")

    def _integrity(self) -> str:
        right: list[str] = []
        read = self.chunks - self.chunks_unread
        if read and not self.chunks_unread:
            right.append(f"{self.chunks_right} of {counted(self.chunks, 'chunk')}")
        elif self.chunks_right != read:
            right.append(counted(self.chunks_right, "chunk"))
        if self.sections_right:
            right.append("the data section")
        if self.summaries_right:
            right.append("the summary")
        if self.attachments > self.attachments_unread:
            right.append(f"{self.attachments_right} of {counted(self.attachments, 'attachment')}")
        has_any = self.chunks_right + self.sections_right + self.summaries_right
        parts = [f"CRC-32 verified: {', '.join(right)}"] if has_any and right else []
        if self.chunks_bare or self.rows_bare:
            what = [counted(self.chunks_bare, "chunk")] if self.chunks_bare else []
            bare = counted(self.rows_bare, "message")
            what += [f"{bare} outside complete chunks"] if self.rows_bare else []
            parts.append(f"no checksum covers {' and '.join(what)}")
        if self.chunks_unread:
            verb = "was" if read == 1 else "were"
            verified = " and verified" if read and read == self.chunks_right else ""
            parts.append(
                f"of {counted(self.chunks, 'chunk')} {read} {verb} read{verified}; the rest was not"
            )
        if self.attachments_unread:
            parts.append(f"{counted(self.attachments_unread, 'attachment')} not read")
        if self.sections_unread:
            parts.append("the data section's checksum was not compared, which takes every byte")
        if self.sections_wrong:
            parts.append("the data section's checksum is wrong")
        return "; ".join(parts) or "the file has no checksums"
