"""Base class of what is open, and closed at the end of a ``with`` block."""

from typing import Self


class Closing:
    """Context manager that calls ``close`` on exit; what keeps no file open inherits it."""

    def close(self) -> None:
        """Release files."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *failure: object) -> None:
        self.close()
