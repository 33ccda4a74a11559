"""An error of a fit names its argument in Python, and the option on the command line."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import pytest

import crosscue
from crosscue.eval import cli

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
        lambda: crosscue.fit_landmarks(None, pairs="gone", same_within_m=60.0),
        "same_within_m: 60, expected less than 50",
        "fit landmarks --pairs gone --same-within 60",
        "--same-within 60: expected less than 50",
    ),
    (
        lambda: crosscue.fit_landmarks("gone.mcap", every_m=float("nan")),
        "every_m: nan, expected metres, above 0",
        "fit landmarks gone.mcap --every nan",
        "argument --every: 'nan': expected metres, above 0",
    ),
    (
        lambda: crosscue.fit_landmarks(None),
        "pairs: expected labelled pairs",
        "fit landmarks",
        "--pairs: expected labelled pairs",
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
