"""An error of a function names its argument in Python, and the option on the command line."""

from pathlib import Path
from typing import Final

import pytest

import crosscue
from support.refusals import refusal


def test_error_names_the_argument_of_a_function_and_the_option_of_its_command() -> None:
    with pytest.raises(crosscue.UsageError, match=r"^bin_m: -1, expected more than 0"):
        crosscue.fit_ranges("stop_sign", "gone.csv", bin_m=-1.0)

    line = "fit ranges gone.csv --cue stop_sign --bin-m -1"
    assert "--bin-m -1: expected more than 0" in refusal(2, *line.split())


# Command lines with a wrong value, and what the error says; no file that they name exists.
LINES: Final[dict[str, str]] = {
    "fit ranges --cue stop_sign": "--truth: expected drives",
    "fit ranges --cue stop_sign --truth a b --runs run": "--runs: got 1 for 2",
    "fit signs gone --label stop --test-every 0": "--test-every 0: expected 1 or more",
    "fit landmarks --pairs gone --false-match-rate 1": "--false-match-rate 1: expected 0 or more",
    "fit detector gone --labels labels --hold-out 1": "--hold-out 1.0: expected above 0",
    "fit detector gone --labels labels --test other": (
        "--test-labels: got 0 for 1; expected one for each run"
    ),
    "fit temporal a b --truth truth.json": "--truth: 2 runs, 1 truth files",
    "failures run --top 0": "--top 0: expected 1 or more",
    "failures run --threshold 0.4": "--threshold 0.4: expected 0.5 to 1",
    "failures run --workers 0": "--workers 0: expected 1 or more",
    "failures run -o x.csv": "expected a name that ends in",
    "status a a": "each named once",
    "tag weather=rain": "no run named",
    "view run -o drive.mp4": "expected a name that ends in .rrd",
    "landmarks list db --limit=-1": "--limit -1: expected 0 or more",
    "landmarks match db x.png --best=0": "--best 0: expected 1 or more",
    "landmarks list db --near=1,2": "expected x,y,radius in metres",
    "landmarks list db --near=a,b,c": "expected x,y,radius in metres",
    "landmarks add db": "expected LOG... with --poses",
    "landmarks add db --every=far": "--every",
    "study intersections -o out --layouts A,Z": "expected some of A to H, each once",
    "study intersections -o out --runs 0": "expected 1 or more",
    "study intersections -o out --width 100": "expected a multiple of 16",
    "info x.mcap --max-chunk -1": "expected MiB",
}


@pytest.mark.parametrize("line", LINES)
def test_wrong_value_is_refused_in_one_line_before_anything_is_read(
    line: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)

    assert LINES[line] in refusal(2, *line.split())
    assert not list(tmp_path.iterdir())
