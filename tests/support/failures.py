"""A table of failures, for commands that read one."""

from pathlib import Path

from crosscue.eval.failures.record import Failure, write_failures


def table_of_failures(run: Path, table: Path, *times_ns: int) -> Path:
    """Write a table in which a run established ``left`` too late at the given times."""
    failures = [
        Failure(
            run=str(run),
            kind="late",
            level="approach",
            what="left",
            cause="no cue",
            reported="no cue",
            t_ns=t_ns,
            at_s=1.0,
            start_ns=t_ns,
            end_ns=t_ns,
            frames=1,
            approach=1,
            intersection="made",
            conditions=(),
            distance_m=20.0,
            severity=1.0,
        )
        for t_ns in times_ns
    ]
    write_failures(failures, table)
    return table
