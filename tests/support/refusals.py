"""Commands that fail as the documentation says: an exit status and one line."""

import io
from contextlib import redirect_stderr, redirect_stdout

from crosscue.eval import cli


def refusal(status: int | tuple[int, ...], *words: object) -> str:
    """Run a command that has to fail with an exit status, and return the one line it prints."""
    printed, error = io.StringIO(), io.StringIO()
    with redirect_stdout(printed), redirect_stderr(error):
        ended = cli.run([str(word) for word in words])
    line = error.getvalue()
    assert ended in (status if isinstance(status, tuple) else (status,)), line
    assert printed.getvalue() == ""
    assert line.startswith("crosscue: ")
    assert line.count("\n") == 1, line
    return line
