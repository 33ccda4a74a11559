"""Heights in pixels to ranges: the curve that made the pairs comes back, with its scatter."""

from pathlib import Path

import numpy as np
import pytest

from crosscue.detectors.ranges import FAMILIES, fit_range, range_of
from crosscue.eval.cli import run
from crosscue.replay.errors import UsageError
from crosscue.replay.vehicle import RangeCurve, parse


@pytest.mark.parametrize("family", FAMILIES)
def test_the_curve_that_made_the_pairs_comes_back(family: str) -> None:
    parameters = {"pinhole": (750.0,), "pinhole-offset": (700.0, 2.5), "power": (600.0, -0.9)}
    curve = RangeCurve(
        family=family,  # type: ignore[arg-type]
        parameters=parameters[family], residual_sd_m=1.0,
    )  # fmt: skip
    height = np.linspace(9.0, 90.0, 80)
    noise = np.random.default_rng(3).normal(0.0, 1.7, 80)

    fitted = fit_range(height, range_of(height, curve) + noise, curve.family)

    truth = range_of(height, curve)
    assert np.abs(range_of(height, fitted.curve) - truth).max() < 2.0
    assert fitted.curve.residual_sd_m == pytest.approx(1.7, rel=0.2)
    assert sum(b.pairs for b in fitted.bins) == 80


@pytest.mark.parametrize(
    ("heights", "ranges", "said"),
    [([10.0, 20.0, -1.0], [5.0, 4.0, 3.0], "row 3"), ([10.0] * 3, [5.0] * 3, "different heights")],
)
def test_pairs_that_cannot_be_fitted_are_refused(
    heights: list[float], ranges: list[float], said: str
) -> None:
    with pytest.raises(UsageError, match=said):
        fit_range(np.array(heights), np.array(ranges), "pinhole")


def test_fit_ranges_writes_a_section_that_the_vehicle_file_takes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    table = tmp_path / "pairs.csv"
    rows = [f"{h},{750 / h + (0.5 if h % 2 else -0.5)}" for h in range(10, 80)]
    table.write_text("height_px,range_m\n" + "\n".join(rows) + "\n")

    assert run(["fit", "ranges", str(table), "--cue", "stop_sign", "--family", "pinhole"]) == 0

    section = capsys.readouterr().out.split("\n\n")[-1]
    curve = parse("version = 1\n" + section, "v.toml").ranges.stop_sign
    assert curve is not None
    assert curve.parameters[0] == pytest.approx(750.0, rel=0.01)
    assert curve.residual_sd_m == pytest.approx(0.5, rel=0.05)


def test_a_table_without_its_columns_is_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    table = tmp_path / "pairs.csv"
    table.write_text("a,b\n1,2\n")

    assert run(["fit", "ranges", str(table), "--cue", "stop_sign"]) == 2

    assert "want the columns height_px and range_m" in capsys.readouterr().err
