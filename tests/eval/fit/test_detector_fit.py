"""Thresholds with valid bounds, calibrations, and a card that changes a cue."""

import re
from pathlib import Path

import numpy as np
import pytest

import crosscue
from crosscue.datasets.truth.box_labels import read_box_labels
from crosscue.detectors.catalog.card import read_card
from crosscue.detectors.catalog.class_scores import Platt
from crosscue.detectors.training.operating_point import fit_platt
from crosscue.eval.fit.detector.class_fit import TRIED, bounded_threshold, fewest_detections
from crosscue.eval.scoring.boxes.reliability import class_calibration
from crosscue.eval.scoring.intervals import lower_bound
from crosscue.replay.errors import FitError, SchemaError, UsageError
from support.onnx_models import constant_model, write_card
from support.pictures import picture_log
from support.sign_scenes import boxes, write_lights


def test_lower_bound_equals_clopper_pearson() -> None:
    # For n of n, the bound is the n-th root of the risk (rule of three: about 1 - 3 / n).
    assert lower_bound(59, 59, 0.95) == pytest.approx(0.05 ** (1 / 59))
    assert lower_bound(59, 59, 0.95) > 0.95 > lower_bound(58, 58, 0.95)
    assert lower_bound(0, 10, 0.95) == 0.0
    n = fewest_detections(0.95, 0.95)
    assert lower_bound(n, n, 1 - 0.05 / TRIED) >= 0.95 > lower_bound(n - 1, n - 1, 1 - 0.05 / TRIED)


def probability(scores: np.ndarray) -> np.ndarray:
    """Probability that a detection with this score is right, in the simulation."""
    return 1.0 / (1.0 + np.exp(-12.0 * (scores - 0.45)))


def test_chosen_threshold_reaches_precision_with_stated_confidence() -> None:
    """Simulated: 400 fits to 600 detections each; the true precision above a score is known."""
    rng = np.random.default_rng(11)
    grid = np.linspace(0.2, 1.0, 4001)
    # Scores are uniform, so the precision above s is the mean of the probability over [s, 1].
    above = np.cumsum(probability(grid)[::-1])[::-1] / np.arange(len(grid), 0, -1)
    found, too_low = 0, 0
    for _ in range(400):
        scores = rng.uniform(0.2, 1.0, 600)
        is_right = rng.random(600) < probability(scores)
        chosen = bounded_threshold(scores, is_right, 0.95, 0.95)
        if chosen is not None:
            found += 1
            too_low += bool(np.interp(chosen.score, grid, above) < 0.95)

    assert found > 300
    assert too_low / 400 <= 0.05


def test_calibrated_scores_are_probabilities_in_the_same_order() -> None:
    rng = np.random.default_rng(2)
    scores = rng.random(4000)
    is_right = rng.random(4000) < probability(scores)
    by = fit_platt(scores, is_right)

    fresh = rng.random(4000)
    right = rng.random(4000) < probability(fresh)
    after = by.probabilities(fresh)

    assert class_calibration("", fresh, right).error > 0.1
    assert class_calibration("", after, right).error < 0.05
    order = np.argsort(fresh)
    assert (np.diff(after[order]) > 0.0).all()


PICTURES = 700


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write simulated pictures of one box; bright boxes are more often traffic lights."""
    return write_lights(tmp_path_factory.mktemp("lights"), PICTURES)


@pytest.mark.slow
def test_fitted_card_reaches_required_precision_of_cues(drive: Path) -> None:
    before = crosscue.score_detector(drive / "run", drive / "labels", has_figures=False)
    found = crosscue.fit_detector(drive / "run", drive / "labels", drive / "net_fitted.toml")
    # Of single frames; by default, lights are decided by their tracks.
    frames = drive / "frames.toml"
    frames.write_text('version = 1\n[cues]\nkind = "frames"\n')
    run = crosscue.replay_drive(
        drive / "log", drive / "run_fitted", vehicle=frames, detectors=[f"{drive}/net_fitted.toml"]
    )
    after = crosscue.score_detector(run, drive / "labels", has_figures=False)

    (one,) = found.classes
    assert one.held_out is not None
    assert one.bound >= 0.95
    assert 0.95 <= one.held_out.bound < one.held_out.precision
    assert f"at least {one.held_out.bound:.3f} with 95% confidence: 0.95 is shown" in str(found)
    assert one.held_out.error_after < one.held_out.error_before
    assert before.scores[0].right + before.scores[0].wrong == PICTURES
    precise, imprecise = after.scores[1].precision.value, before.scores[1].precision.value
    assert imprecise < 0.9 < 0.95 <= precise
    # The cue counts detections above the card's threshold, in the run's own tables.
    cues = run["cues"].to_pydict()
    counts = [
        n for cue, n in zip(cues["cue"], cues["count"], strict=True) if cue == "traffic_light"
    ]
    assert sum(counts) == after.scores[1].right + after.scores[1].wrong
    card = read_card(drive / "net_fitted.toml")
    assert card.is_calibrated
    assert card.evidence[0].value == pytest.approx(one.held_out.precision, abs=1e-4)
    assert "bound" in card.evidence[0].note

    again = crosscue.fit_detector(drive / "run", drive / "labels", card=drive / "net_fitted.toml")
    assert again.classes[0].scores == one.scores


def test_calibration_that_is_worse_on_held_out_images_is_refused(
    drive: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    wrong = Platt(kind="platt", slope=1.0, offset=-3.0)
    monkeypatch.setattr("crosscue.eval.fit.detector.class_fit.fit_platt", lambda *_: wrong)
    output = drive / "net_worse.toml"

    with pytest.raises(FitError, match=r"traffic light 0\.\d+ after, 0\.\d+ before"):
        crosscue.fit_detector(drive / "run", drive / "labels", output)

    assert not output.exists()
    kept = crosscue.fit_detector(drive / "run", drive / "labels", keep=True).classes[0].held_out
    assert kept is not None
    assert kept.error_after > kept.error_before


def test_held_out_calibration_is_reported_without_threshold(drive: Path) -> None:
    output = drive / "net_unreached.toml"

    found = crosscue.fit_detector(drive / "run", drive / "labels", output, precision=0.9999)

    (one,) = found.classes
    assert not found.has_threshold
    assert one.held_out is not None
    assert one.held_out.detections == PICTURES // 2
    assert one.held_out.error_after < one.held_out.error_before
    errors = f"{one.held_out.error_before:.3f} before, {one.held_out.error_after:.3f} after"
    assert f"  held out    calibration error {errors}, 350 detections" in str(found)
    assert "precision nan" not in str(found)
    card = read_card(output)
    assert card.scores["traffic light"].threshold is None
    assert card.evidence == ()


def test_class_without_labelled_box_is_not_labelled(tmp_path: Path) -> None:
    """Three detections of trucks, and labels that list the class but have no box of it."""
    run = two_labels_on_one_object(tmp_path)
    labels = car_labels(tmp_path)

    found = crosscue.score_detector(run, labels, has_figures=False)
    fitted = crosscue.fit_detector(run, labels)

    (line,) = [line for line in str(found).splitlines() if line.startswith("truck")]
    assert line.split()[:2] == ["truck", "all"]
    assert line.endswith("not labelled: 3 detections not judged")
    assert "of truck" not in str(found)
    assert "0.000" not in line
    (scored,) = [one for one in found.scores if one.label == "truck"]
    assert np.isnan(scored.precision.value)
    assert "truck      not labelled, 1 detection" in str(fitted)
    (row,) = re.findall("<tr><td>truck</td>.*?</tr>", found.report.read_text(), re.DOTALL)
    assert "not labelled: 3 detections not judged" in row
    assert "<td>-" not in row
    assert "truck 0.000" not in found.report.read_text()


def test_page_of_run_without_detections_says_that_there_are_none(tmp_path: Path) -> None:
    run, labels = two_labels_on_one_object(tmp_path, 0.1), car_labels(tmp_path)

    page = crosscue.score_detector(run, labels, has_figures=False).report.read_text()

    assert "the detections stored in the run, of which there are none. Precision" in page
    assert "a score of at least" not in page


@pytest.mark.parametrize(
    ("rows", "meanings", "error", "message"),
    [
        ({"frame_9999.txt": "0 .5 .5 .2 .2"}, {}, SchemaError, "none of its 1 images is in"),
        (
            {"frame_1.txt": "1 .5 .5 .2 .2"},
            {"cat": "dog"},
            UsageError,
            "meanings: cat=dog, no such",
        ),
        (
            {"frame_1.txt": "7 .5 .5 .2 .2"},
            {},
            crosscue.CrosscueError,
            "class 7, but 2 class names",
        ),
        ({"frame_1.txt": "0 .5 .5 nan .2"}, {}, crosscue.CrosscueError, "expected numbers"),
        ({"frame_1.txt": "0 5 5 .2 .2"}, {}, crosscue.errors.EmptyResultError, "no box of a class"),
        ({"frame_1.txt": ""}, {}, crosscue.errors.EmptyResultError, "no box of a class"),
        ({}, {}, crosscue.CrosscueError, "no labels of boxes"),
    ],
)
def test_invalid_labels_are_refused_in_one_line_without_output(
    drive: Path,
    tmp_path: Path,
    rows: dict[str, str],
    meanings: dict[str, str],
    error: type[Exception],
    message: str,
) -> None:
    for name, row in rows.items():
        (tmp_path / name).write_text(row + "\n")
    if rows:
        (tmp_path / "classes.txt").write_text("traffic light\nvan\n")
    out = tmp_path / "out"

    with pytest.raises(error, match=message) as raised:
        crosscue.score_detector(drive / "run", tmp_path, out, meanings=meanings)

    assert "\n" not in str(raised.value)
    assert not out.exists()


def two_labels_on_one_object(folder: Path, factor: float = 1.0) -> crosscue.Run:
    """Run a network that reports a car (0.9) and a truck (0.8) on one object, and another car."""
    rows = np.array([[[8, 8, 24, 24, 0.9, 0], [9, 8, 24, 24, 0.8, 1], [40, 8, 60, 24, 0.7, 0]]])
    rows[..., 4] *= factor
    model = constant_model((1, 3, 48, 64), {"rows": rows.astype(np.float32)})
    output = 'kind = "end-to-end"\nclasses = ["car", "truck"]\noverlap = 1.0'
    card = write_card(folder, model, output)
    log = picture_log(folder / "log", [np.full((48, 64), i, np.uint8) for i in range(3)])
    return crosscue.detect_drive(log, folder / "run", detectors=[str(card)])


def car_labels(folder: Path) -> Path:
    """Label both cars of these pictures; the class truck has no box."""
    labels = folder / "labels"
    labels.mkdir()
    (labels / "classes.txt").write_text("car\ntruck\n")
    for number in range(3):
        text = "0 .25 .3333 .25 .3333\n0 .78125 .3333 .3125 .3333\n"
        (labels / f"frame_{number}.txt").write_text(text)
    return labels


def test_labels_mapped_to_one_class_count_once_per_object(tmp_path: Path) -> None:
    run = two_labels_on_one_object(tmp_path)
    labels = car_labels(tmp_path)
    meanings = {"car": "vehicle", "truck": "vehicle"}

    found = crosscue.score_detector(run, labels, meanings=meanings, has_figures=False)
    apart = crosscue.score_detector(run, labels, has_figures=False)

    assert (found.scores[0].right, found.scores[0].wrong) == (6, 0)
    assert found.scores[0].ap50.value == pytest.approx(1.0)
    why = "detections of vehicle on a better one with another label"
    assert dict(found.labelled.left_out) == {why: 3}
    assert dict(apart.labelled.left_out) == {}
    assert apart.scores[0].right == 6


def test_left_out_labels_are_counted_by_reason(drive: Path, tmp_path: Path) -> None:
    box = (drive / "labels" / "frame_0.txt").read_text() or "0 .375 .333 .25 .333\n"
    (tmp_path / "classes.txt").write_text("traffic light\nvan\n")
    (tmp_path / "frame_0.txt").write_text(box + "0 .95 .5 .2 .2\n0 3 3 .1 .1\n1 .5 .5 .2 .2\n")
    (tmp_path / "frame_9999.txt").write_text(box)

    found = crosscue.score_detector(drive / "run", tmp_path, tmp_path / "out", has_figures=False)

    assert dict(found.labelled.left_out) == {
        "images that are not in the run": 1,
        "boxes cut off at the picture's edge": 1,
        "boxes outside the picture, or without area": 1,
        "boxes of classes that the detector does not report (van)": 1,
    }
    page = found.report.read_text()
    assert "1 images that are not in the run" in page
    assert found.parts.num_rows == len(found.scores)


def picture_labels(folder: Path, path: Path, separator: str = ",") -> Path:
    """Write which pictures of the drive show a light, and that none shows a van."""
    rows = [
        f"{file.stem}.png{separator}{'yes' if file.read_text() else 'no'}{separator}0"
        for file in sorted((folder / "labels").glob("frame_*.txt"))
    ]
    path.write_text("\n".join([f"picture{separator}traffic light{separator}van", *rows]) + "\n")
    return path


@pytest.mark.slow
def test_fit_to_labels_of_pictures_equals_that_to_their_only_boxes(
    drive: Path, tmp_path: Path
) -> None:
    labels = picture_labels(drive, tmp_path / "lights.csv")

    by_picture = crosscue.fit_detector(drive / "run", labels, drive / "net_by_picture.toml")
    by_box = crosscue.fit_detector(drive / "run", drive / "labels")

    (one,), (other,) = by_picture.classes, by_box.classes
    assert (one.scores, one.bound, one.labels) == (other.scores, other.bound, other.labels)
    assert one.held_out is not None
    assert other.held_out is not None
    assert (one.held_out.right, one.held_out.of) == (other.held_out.right, other.held_out.of)
    assert f"{one.labels} pictures with it, {one.detections} pictures with" in str(by_picture)
    assert f"{other.labels} boxes" in str(by_box)
    (evidence,) = read_card(drive / "net_by_picture.toml").evidence
    assert "fitted to" in evidence.note
    assert "pictures with it" in evidence.note
    assert "traffic light in a picture" in evidence.metric


def test_best_detection_of_a_picture_counts(tmp_path: Path) -> None:
    """Three pictures with two cars each, of which the second picture shows none."""
    run = two_labels_on_one_object(tmp_path)
    labels = tmp_path / "cars.tsv"
    labels.write_text("picture\tcar\nframe_0.png\t1\nframe_1.png\t0\nframe_2.png\t1\n")

    found = crosscue.fit_detector(run, labels, hold_out=0.01)

    (one,) = found.classes
    assert (one.labels, one.detections, one.right) == (2, 3, 2)


def test_labels_of_pictures_are_no_boxes_to_score(drive: Path, tmp_path: Path) -> None:
    labels = picture_labels(drive, tmp_path / "lights.tsv", "\t")

    with pytest.raises(UsageError, match=r"lights.tsv: .*no boxes.*crosscue fit detector"):
        crosscue.score_detector(drive / "run", labels)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "expected a heading"),
        ("picture\na.png\n", "expected a heading"),
        ("picture,car\na.png,maybe\n", "cars.csv:2: 'maybe', expected yes or no"),
        ("picture,car\na.png\n", "cars.csv:2: 1 columns, the heading has 2"),
        ("picture,car\n\xff.png,1\n", "not UTF-8 text"),
    ],
)
def test_damaged_labels_of_pictures_are_refused_with_their_line(
    tmp_path: Path, text: str, message: str
) -> None:
    path = tmp_path / "cars.csv"
    path.write_text(text, encoding="latin-1")

    with pytest.raises(crosscue.CrosscueError, match=message) as caught:
        read_box_labels(path)

    assert "\n" not in str(caught.value)


def test_pictures_without_an_object_are_labels_to_test_on(tmp_path: Path) -> None:
    run = two_labels_on_one_object(tmp_path)
    labels = tmp_path / "none.csv"
    labels.write_text("picture,car\n" + "".join(f"frame_{i}.png,no\n" for i in range(3)))

    (one,) = crosscue.fit_detector(run, labels).classes

    assert (one.labels, one.detections, one.right) == (0, 1, 0)
    assert one.notes == ("not labelled",)


@pytest.mark.slow
def test_recall_is_said_where_nothing_is_above_the_threshold(drive: Path, tmp_path: Path) -> None:
    """The run to test on has three lights, all with low scores."""
    log = picture_log(tmp_path / "log", boxes([140, 141, 142]))
    dark = crosscue.detect_drive(log, tmp_path / "run", detectors=[str(drive / "net.toml")])
    labels = tmp_path / "dark.csv"
    labels.write_text("picture,traffic light\n" + "".join(f"frame_{i}.png,1\n" for i in range(3)))

    found = crosscue.fit_detector(
        drive / "run",
        picture_labels(drive, tmp_path / "lights.csv"),
        test=[dark],
        test_labels=[labels],
        calibration="none",
    )

    assert "  held out    no detection above it, recall 0.000 (0 of 3)" in str(found)
