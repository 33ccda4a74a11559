"""Log times as dates."""

from typing import Final

_YEAR_2000_NS: Final = 946_684_800_000_000_000


def is_date(t_ns: int) -> bool:
    """Return whether a log's time is a date; a clock that starts at boot counts from 0."""
    return t_ns > _YEAR_2000_NS
