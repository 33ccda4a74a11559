"""The table ``skipped.parquet``: skipped and dropped rows of the logs, with reasons."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import pyarrow as pa

from crosscue.eval.runs.account import UNATTRIBUTED, LogAccount, TopicLine
from crosscue.replay.ledger import Ledger
from crosscue.replay.time.segments import ONE_SEGMENT, Timeline

from .columns import LOG_TIME, OF_RUN, arrow_schema
from .parquet import TableFolder, TableSink


def write_skipped(
    run: TableFolder,
    ledgers: Sequence[Ledger],
    reading: Sequence[LogAccount],
    kept: pa.Table | None = None,
    timeline: Timeline = ONE_SEGMENT,
) -> None:
    """Write ``skipped.parquet``, whose counts match the account for each reason.

    Args:
        run: The run.
        ledgers: Ledgers of all logs.
        reading: Accounts of the logs, as written to the manifest.
        kept: Rows of an earlier stage; those of topics that only it has read are kept.
        timeline: The drive's time segments; stamps in this table are as recorded.
    """
    rows = [asdict(one) | {"log": ledger.log} for ledger in ledgers for one in ledger.details]
    earlier = [] if kept is None else kept.to_pylist()
    names = OF_RUN["skipped"]
    with TableSink(run, "skipped", arrow_schema({**names, **LOG_TIME})) as sink:
        for log in reading:
            for topic, account in log.topics.items():
                # Rows of unknown topics are this stage's; others the earlier stage's if it has any.
                for rest in (rows, earlier) if topic == UNATTRIBUTED else (earlier, rows):
                    mine = [r for r in rest if (r["log"], r["topic"]) == (log.log, topic)]
                    if mine:
                        break
                mine += _in_bulk(mine, log.log, topic, account)
                if mine:
                    times = [row["t_ns"] for row in mine]
                    numbers = [timeline.number_of_stamp(t_ns) for t_ns in times]
                    columns = {name: [row[name] for row in mine] for name in names}
                    sink.write({**columns, "segment": numbers, "log_t_ns": times})


def _in_bulk(
    single: Sequence[Mapping[str, Any]], log: str, topic: str, account: TopicLine
) -> list[dict[str, Any]]:
    """Return a row for each reason that the account counts more often than the single rows."""
    rows = []
    for known_counts, is_dropped in ((account.skipped, False), (account.dropped, True)):
        listed: Counter[str] = Counter()
        for row in single:
            if row["is_dropped"] is is_dropped:
                listed[row["reason"]] += row["count"] or 0
        counts: list[tuple[str, int | None]] = [
            (why, n - listed[why]) for why, n in known_counts.items() if n != listed[why]
        ]
        if is_dropped:
            known = {row["reason"] for row in single if row["count"] is None}
            counts += [(why, None) for why in account.dropped_unknown if why not in known]
        rows += [
            {
                "t_ns": None,
                "topic": topic,
                "reason": why,
                "detail": "not listed one by one",
                "count": count,
                "is_dropped": is_dropped,
                "log": log,
            }
            for why, count in counts
        ]
    return rows
