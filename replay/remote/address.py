"""Addresses of logs at URLs: text without secrets, and one door to the complete form."""

from __future__ import annotations

import re
from typing import Final, Self, TypeGuard

from crosscue.replay.errors import UsageError, is_host, split_address

_ADDRESS: Final = re.compile(r"([a-z][a-z0-9+.-]+)://(.*)", re.IGNORECASE | re.DOTALL)
_URL: Final = re.compile(r"[a-z][a-z0-9+.:-]+://", re.IGNORECASE)
_CHAIN: Final = re.compile(r"::[a-z][a-z0-9+.-]*://", re.IGNORECASE)


def is_remote(path: object) -> TypeGuard[str]:
    """Return whether ``path`` is a URL; never for a ``Path``, which collapses the slashes."""
    return isinstance(path, str) and _URL.match(path) is not None


class LogAddress(str):
    """URL of a log or of a folder of runs, whose text has no user, password, query or fragment.

    Whatever prints, stores, hashes, compares or cuts the string gets the public form. Only
    ``with_secrets`` returns the complete one, and pickling, for worker processes, keeps it.
    """

    __slots__ = ("_secret_query", "_secret_user")

    _secret_query: str
    _secret_user: str

    def __new__(cls, url: str) -> Self:
        """Split a URL; an address that is split already keeps its secrets.

        Raises:
            UsageError: It is not one URL with a valid host and port. It is not quoted.
        """
        if isinstance(url, cls):
            return url
        form = _ADDRESS.fullmatch(url)
        if form is None or _CHAIN.search(url):
            raise UsageError("URL of a log: expected SCHEME://HOST/PATH, not chained by '::'")
        scheme = form[1].lower()
        user, place, query = split_address(scheme, form[2])
        if not is_host(place.partition("/")[0].rpartition("@")[2]):
            raise UsageError(
                f"{scheme}://...: no valid host or port; write / ? # @ in a password as %2F %3F..."
            )
        address = super().__new__(cls, f"{scheme}://{place}")
        address._secret_user = user
        # A fragment is never sent to a server.
        address._secret_query = query.partition("#")[0] if scheme.startswith("http") else query
        return address

    def __str__(self) -> Self:
        return self

    def __reduce__(self) -> tuple[type[Self], tuple[str]]:
        return type(self), (self.with_secrets(),)

    @property
    def name(self) -> str:
        """Last part of the path."""
        return self.rstrip("/").rpartition("/")[2]

    @property
    def has_query(self) -> bool:
        """True if the complete form has a query."""
        return bool(self._secret_query)

    def with_secrets(self) -> str:
        """Return the complete URL, to open it. Never print, store or raise it."""
        scheme, mark, place = self.partition("://")
        return f"{scheme}{mark}{self._secret_user}{place}{self._secret_query}"

    def hide(self, text: str) -> str:
        """Return a message of another library without any part of the secrets."""
        parts = [
            self._secret_user,
            self._secret_query,
            *re.split("[:@?&=#]", self._secret_user + self._secret_query),
        ]
        for part in parts:
            text = text.replace(part, "...") if len(part) > 3 else text
        return text

    def at(self, url: str) -> LogAddress:
        """Return the address of another object of the same store, with the same secrets."""
        other = LogAddress(url)
        scheme, mark, place = other.partition("://")
        return LogAddress(f"{scheme}{mark}{self._secret_user}{place}{self._secret_query}")
