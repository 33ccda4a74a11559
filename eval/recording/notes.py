"""Page of text with the logs, dropped rows and the meaning of colours."""

import re
from collections.abc import Sequence
from typing import Final

import rerun as rr

from crosscue.eval.runs.folder import RunFolder
from crosscue.replay.safe_text import visible

COLOURS: Final = (
    "- everywhere: blue what was found or estimated, green the truth, orange 2 sigma, grey what is "
    "too uncertain to be a cue",
    "- camera: road hatched in teal, regions of interest teal while they hold road; arrows: orange "
    "cars cross, violet ones are parked and point to their front, white ones go along the road, "
    "pink ones beyond the intersection; an arrow on the road is the way of one second, with the "
    "ego vehicle's own motion removed",
    "- ahead of the vehicle: red bar the start, yellow bar the end of the intersection with its "
    "2-sigma band; white lines are the Mobileye's",
    "- range: red to the start, yellow to the end, thin the 2-sigma bands; s.d. is that of the "
    "heading, the ellipse its full major axis",
)


def notes(run: RunFolder, more: Sequence[str]) -> rr.TextDocument:
    """Return the page of notes on a run."""
    manifest = run.drive_manifest()
    logs = [f"- {inert(log.name)}" for log in manifest.logs]
    notices = [f"- {inert(sentence)}" for sentence in (*manifest.notices, *more)]
    dropped = sum(not log.is_whole for log in manifest.account.reading)
    losses = (
        "nothing is known to be dropped"
        if not dropped
        else f"{dropped} log(s) with losses: see manifest"
    )
    lines = [
        f"# {inert(run.path.name)}",
        "",
        f"Logs ({losses}):",
        *logs,
        "",
        "Notes:",
        *(notices or ["- none"]),
        "",
        "Colours:",
        *COLOURS,
    ]
    return rr.TextDocument("\n".join(lines), media_type="text/markdown")


def inert(text: str) -> str:
    """Escape text so that Markdown shows it literally, without links, pictures or markup."""
    return re.sub(r"([!-/:-@\[-`{-~])", r"\\\1", visible(text))
