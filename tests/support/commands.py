"""Commands that end as they should, and what they print."""

import io
import json
from contextlib import redirect_stdout
from typing import Any

from crosscue.eval import cli


def output_of(*words: object, status: int = 0) -> str:
    """Run a command that has to end with an exit status, and return what it prints."""
    out = io.StringIO()
    with redirect_stdout(out):
        ended = cli.run([str(word) for word in words])
    assert ended == status
    return out.getvalue()


def json_of(*words: object, status: int = 0) -> Any:
    """Run a command with ``--json``, and return what it prints."""
    return json.loads(output_of(*words, "--json", status=status))
