"""An error of a function names its argument in Python, and the option on the command line."""

from collections.abc import Callable
from pathlib import Path
from typing import Final

import pytest

import crosscue
from crosscue.eval import cli
from support.refusals import refusal

WRONG: Final[list[tuple[Callable[[], object], str, str, str]]] = [
    (
        lambda: crosscue.fit_ranges("stop_sign", "gone.csv", bin_m=-1.0),
        "bin_m: -1, expected more than 0",
        "fit ranges gone.csv --cue stop_sign --bin-m -1",
        "--bin-m -1: expected more than 0",
    ),
    (
        lambda: crosscue.fit_ranges("stop_sign"),
        "truth: expected drives",
        "fit ranges --cue stop_sign",
        "--truth: expected drives",
    ),
    (
        lambda: crosscue.fit_ranges("stop_sign", None, ["a", "b"], ["run"]),
        "runs: 1 runs for 2 drives",
        "fit ranges --cue stop_sign --truth a b --runs run",
        "--runs: 1 runs for 2 drives",
    ),
    (
        lambda: crosscue.fit_signs(["gone"], ["stop"], test_every=0),
        "test_every: 0, expected 1 or more",
        "fit signs gone --label stop --test-every 0",
        "--test-every 0: expected 1 or more",
    ),
    (
        lambda: crosscue.fit_landmarks("gone", false_match_rate=1.0),
        "false_match_rate: 1, expected 0 or more, below 1",
        "fit landmarks --pairs gone --false-match-rate 1",
        "--false-match-rate 1: expected 0 or more, below 1",
    ),
    (
        lambda: crosscue.fit_detector("gone", "labels", hold_out=1.0),
        "hold_out: 1.0, expected above 0 and below 1",
        "fit detector gone --labels labels --hold-out 1",
        "--hold-out 1.0: expected above 0 and below 1",
    ),
    (
        lambda: crosscue.fit_detector("gone", "labels", test=["other"]),
        "test_labels: 0 for 1 runs; expected one for each",
        "fit detector gone --labels labels --test other",
        "--test-labels: 0 for 1 runs; expected one for each",
    ),
    (
        lambda: crosscue.fit_temporal(["a", "b"], ["truth.json"]),
        "truth: 2 runs, 1 truth files",
        "fit temporal a b --truth truth.json",
        "--truth: 2 runs, 1 truth files",
    ),
]


@pytest.mark.parametrize(("call", "message", "line", "printed"), WRONG)
def test_error_of_fit_names_argument_or_option(
    call: Callable[[], object],
    message: str,
    line: str,
    printed: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    with pytest.raises(crosscue.UsageError) as raised:
        call()
    assert str(raised.value).startswith(message)

    assert cli.run(line.split()) == 2
    assert capsys.readouterr().err.startswith(f"crosscue: {printed}")


# Command lines with a wrong value, and what the error says; no file that they name exists.
LINES: Final[dict[str, str]] = {
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
