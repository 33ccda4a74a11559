"""``crosscue fit ranges``: curves from heights in pixels to ranges, and their residuals."""

import json
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from crosscue.datasets.truth.truth import Truth, save
from crosscue.detectors.ranging.height_to_range import FAMILIES, fit_range, range_of
from crosscue.eval.cli import run
from crosscue.eval.fit.ranges.fit import pairs_of_run, pairs_of_truth
from crosscue.replay.vehicle.vehicle import RangeCurve


@pytest.mark.parametrize("family", FAMILIES)
def test_fit_recovers_curve_and_residual_of_generated_pairs(family: str) -> None:
    parameters = {"pinhole": (750.0,), "pinhole-offset": (700.0, 2.5), "power": (600.0, -0.9)}
    curve = RangeCurve(
        family=family,  # type: ignore[arg-type]
        parameters=parameters[family],
        residual_sd_m=1.0,
    )
    height = np.linspace(9.0, 90.0, 80)
    noise = np.random.default_rng(3).normal(0.0, 1.7, 80)

    fitted = fit_range(height, range_of(height, curve) + noise, curve.family)

    truth = range_of(height, curve)
    assert np.abs(range_of(height, fitted.curve) - truth).max() < 2.0
    assert fitted.curve.residual_sd_m == pytest.approx(1.7, rel=0.2)
    assert sum(b.pairs for b in fitted.bins) == 80


HEIGHTS = {"stop_sign": 750.0, "traffic_light": 1000.0}


def drive(folder: Path, noise_m: float = 0.0) -> Path:
    """Write the truth of an approach with a stop sign at the start and a light at the end."""
    folder.mkdir()
    rng = np.random.default_rng(2)
    images, objects, ranges = [], [], ["t_ns,approach,start_m,end_m"]
    for k in range(60):
        t_ns, start = 1_700_000_000_000_000_000 + k * 100_000_000, 70.0 - k
        ranges.append(f"{t_ns},0,{start},{start + 15.0}")
        images.append({"id": k, "t_ns": t_ns})
        for number, (cue, size) in enumerate(HEIGHTS.items()):
            true_m = start if cue == "stop_sign" else start + 15.0
            height = size / (true_m + rng.normal(0.0, noise_m))
            objects.append(
                {"image_id": k, "category_id": number, "visible": 1.0, "bbox": [5, 5, 9, height]}
            )
            objects.append(
                {"image_id": k, "category_id": number, "visible": 0.5, "bbox": [5, 5, 9, 3.0]}
            )
    names = [cue.replace("_", " ") for cue in HEIGHTS]
    tree = {
        "images": images,
        "annotations": objects,
        "categories": [{"id": i, "name": name} for i, name in enumerate(names)],
    }
    (folder / "objects.json").write_text(json.dumps(tree))
    (folder / "ranges.csv").write_text("\n".join(ranges))
    save(
        Truth(
            version=1,
            start_ns=1_700_000_000_000_000_000,
            end_ns=1_700_000_007_000_000_000,
            objects="objects.json",
            ranges="ranges.csv",
        ),
        folder,
    )
    return folder


@pytest.mark.parametrize("cue", HEIGHTS)
def test_signs_pair_with_start_and_lights_with_end(cue: str, tmp_path: Path) -> None:
    pairs = pairs_of_truth(drive(tmp_path / "a"), cue)

    assert len(pairs.range_m) == 60
    np.testing.assert_allclose(pairs.height_px * pairs.range_m, HEIGHTS[cue])


def test_fitted_curve_is_evaluated_on_other_drives(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    fitted, other = drive(tmp_path / "a"), drive(tmp_path / "b", noise_m=1.0)
    figure = tmp_path / "f.png"
    argv = (
        f"fit ranges --cue stop_sign --truth {fitted} --test {other} --figure {figure} "
        "--family pinhole"
    ).split()

    assert run([*argv, "--json"]) == 0

    reported = json.loads(capsys.readouterr().out)
    assert reported["fits"][0]["residual_sd_m"] < 0.01
    assert reported["tested"]["residual_sd_m"] == pytest.approx(1.0, rel=0.3)
    assert reported["tested"]["pairs"] == 60
    assert figure.read_bytes().startswith(b"\x89PNG")
    assert run(argv) == 1  # the figure already exists
    assert run([*argv, "--overwrite"]) == 0
    assert "on other drives, 60 pairs" in capsys.readouterr().out


def test_confident_detections_of_run_are_paired_with_truth_ranges(tmp_path: Path) -> None:
    truth = drive(tmp_path / "a")
    t_ns = [1_700_000_000_000_000_000 + k * 100_000_000 for k in (3, 4, 5)] + [9]
    table = pa.table(
        {
            "t_ns": t_ns,
            "label": ["stop sign", "stop sign", "car", "stop sign"],
            "score": [0.95, 0.5, 0.99, 0.99],
            "height_px": [20.0] * 4,
        }
    )
    pq.write_table(table, tmp_path / "detections.parquet")

    pairs = pairs_of_run(tmp_path, truth, "stop_sign", 0.9)

    assert pairs.range_m.tolist() == [67.0]
