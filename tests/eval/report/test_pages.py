"""Every page is the one page; pages of a comparison; scores in MLflow."""

import html
import json
import re
import shlex
import shutil
from importlib.util import find_spec
from pathlib import Path
from urllib.parse import urlsplit

import cv2
import numpy as np
import pyarrow.parquet as pq
import pytest

import crosscue
from crosscue.datasets.truth.truth import CueTruth, read_truth, save
from crosscue.detectors.images import Encoded
from crosscue.detectors.overlay import NOTHING_TRUE, TrueMarks, draw_frame
from crosscue.eval import cli
from crosscue.eval.fleet.compare_page import differences_of
from crosscue.eval.recording.notes import COLOURS
from crosscue.eval.report.frame_pictures import draw_pictures
from crosscue.eval.report.html import page_style
from crosscue.eval.report.page import write_report_without_truth
from crosscue.eval.runs.folder import open_run
from crosscue.eval.runs.tags import write_tags
from crosscue.eval.scoring.truth import true_marks
from crosscue.replay import colours
from crosscue.replay.files.tree_text import strict_json
from support.refusals import refusal
from support.scene_run import SIZE, scene_run
from support.scoring import CUES, at, cue_table, run_folder, truth_folder

MAX_BYTES = 3_000_000


def _near(pixels: np.ndarray[tuple[int, ...], np.dtype[np.uint8]], colour: colours.Colour) -> int:
    apart = np.abs(pixels.astype(int) - np.array(colours.bgr(colour))).max(axis=-1)
    return int((apart < 40).sum())


def test_truth_and_detections_have_two_colours_with_one_meaning(tmp_path: Path) -> None:
    run = scene_run(tmp_path / "drive")
    truth = truth_folder(tmp_path / "truth")
    box = {"id": 1, "image_id": 1, "category_id": 3, "bbox": [80, 30, 50, 40], "area": 2000}
    tree = {
        "images": [{"id": 1, "t_ns": at(21), "file_name": "a", "width": 160, "height": 90}],
        "annotations": [box | {"iscrowd": 0}],
        "categories": [{"id": 3, "name": "car"}],
    }
    (truth.parent / "objects.json").write_text(strict_json(tree))
    save(read_truth(truth).model_copy(update={"objects": "objects.json"}), truth.parent)
    drawn: dict[bool, bytes] = {}
    for has_truth in (True, False):

        def keep(_: int, picture: bytes, __: bytes, has_truth: bool = has_truth) -> None:
            drawn[has_truth] = picture

        assert not draw_pictures(run, [at(21)], keep, truth=truth if has_truth else None)
    one, other = (
        np.asarray(cv2.imdecode(np.frombuffer(drawn[k], np.uint8), 1), np.uint8)
        for k in (True, False)
    )
    assert _near(one, colours.TRUTH) > _near(other, colours.TRUTH) + 50
    grey = np.full((SIZE[1], SIZE[0], 3), 90, np.uint8)
    _, png = cv2.imencode(".png", grey)
    marks = TrueMarks([("car", (20.0, 20.0, 60.0, 60.0))], {"stop_sign": 1})
    picture = Encoded("png", memoryview(png.tobytes()))
    canvas = draw_frame(picture, (), {}, lambda _: (), SIZE[0], marks)
    assert (canvas[20, 20:60] == colours.bgr(colours.TRUTH)).all(axis=-1).sum() > 30
    assert (draw_frame(picture, (), {}, lambda _: (), SIZE[0], NOTHING_TRUE) == 90).all()
    style = page_style()
    assert f"--truth: {colours.css(colours.TRUTH)};" in style
    assert f"--found: {colours.css(colours.FOUND)};" in style
    assert "blue what was found or estimated, green the truth" in COLOURS[0]
    meanings = [colours.TRUTH, colours.FOUND, colours.WRONG, *colours.FEATURES.values()]
    assert len(set(meanings)) == len(meanings)


def test_truth_on_a_picture_names_no_cue_of_a_map(tmp_path: Path) -> None:
    run, truth = scene_run(tmp_path / "run"), truth_folder(tmp_path / "truth")
    there = {"road_left": 1, "map_left": 1}
    cues = [
        CueTruth(start_ns=at(0), end_ns=at(40), cue=cue, present=True, count=count)
        for cue, count in there.items()
    ]
    save(read_truth(truth).model_copy(update={"cues": tuple(cues)}), truth.parent)
    assert true_marks(truth, run, [at(21)])[at(21)].counts == {"road_left": 1}


def _commands(page: Path) -> list[list[str]]:
    text = page.read_text(encoding="utf-8")
    found = re.findall(r"<code>(crosscue [^<]*)</code>", text)
    return [shlex.split(html.unescape(command))[1:] for command in found]


def test_commands_on_pages_run_as_printed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "a drive's $folder"
    run, truth = scene_run(folder / "one").path, truth_folder(folder / "truth")
    crosscue.score_run(run, truth)
    write_report_without_truth(open_run(run), folder / "unscored.html", 0.9)
    crosscue.browse(run, folder / "site")
    copy = folder / "unscored"
    shutil.copytree(run.parent, copy)
    shutil.rmtree(copy / "run" / "score")
    crosscue.browse(copy / "run", folder / "given", truth=truth)
    pages = [run / "score" / "report.html", folder / "unscored.html"]
    pages += [
        *sorted((folder / "site" / "f").iterdir()),
        *sorted((folder / "given" / "f").iterdir()),
    ]
    commands = {tuple(words): page for page in pages for words in _commands(page)}
    assert len(commands) >= 9
    for page in pages:
        assert page.stat().st_size <= MAX_BYTES
    for number, (words, page) in enumerate(commands.items()):
        output = ["-o", str(tmp_path / f"{number}.rrd")] if words[0] == "view" else []
        status = cli.run([*words, *output])
        assert status in (0, 3), (page, words, capsys.readouterr().err)


@pytest.fixture
def sides(tmp_path: Path) -> tuple[Path, Path]:
    """Write two scored runs of one drive; the second finds the stop sign for ten frames less."""
    before, after = scene_run(tmp_path / "a").path, scene_run(tmp_path / "b").path
    later = {**CUES, "stop_sign": {frame: int(frame >= 20) for frame in range(40)}}
    pq.write_table(cue_table(later), after / "cues.parquet", write_page_checksum=True)
    truth = truth_folder(tmp_path / "truth")
    for run in (before, after):
        crosscue.score_run(run, truth)
    return before, after


def test_frames_in_which_runs_differ_are_found(sides: tuple[Path, Path]) -> None:
    (one,) = differences_of(*(open_run(path) for path in sides))

    assert (one.text, one.frames, one.t_ns) == ("stop sign found only before", 10, at(15))
    assert list(differences_of(open_run(sides[0]), open_run(sides[0]))) == []


def test_compare_writes_a_page_with_pairs_of_pictures(
    sides: tuple[Path, Path], tmp_path: Path
) -> None:
    page = tmp_path / "compare.html"
    words = ["compare", *map(str, sides), "-o", str(page)]

    assert cli.run(words) in (0, 1, 3)
    text = page.read_text(encoding="utf-8")
    assert re.search(r'class="told">.*at too few places to decide', text)
    assert "stop sign found only before</b>, in 10 frames together" in text
    assert len(re.findall(r'src="data:image/jpeg;base64,[^"]{200,}"', text)) == 2
    for run in sides:
        assert f"<code>crosscue view {run} --at 1.500</code>" in text
    assert page.stat().st_size < 3_000_000
    assert "exists; give another name or --overwrite" in refusal(1, *words)
    assert cli.run([*words, "--overwrite"]) in (0, 1, 3)


needs_mlflow = pytest.mark.skipif(
    find_spec("mlflow") is None, reason="mlflow-skinny is not installed"
)


@pytest.mark.slow
@needs_mlflow
@pytest.mark.filterwarnings("default")
def test_scores_tags_and_report_are_stored_in_mlflow(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from mlflow.tracking import MlflowClient

    monkeypatch.setenv("MLFLOW_ALLOW_FILE_STORE", "true")
    store = (tmp_path / "store").as_uri()
    truth_folder(tmp_path)
    (tmp_path / "drive.mcap").write_text("a drive")
    run = run_folder(tmp_path / "run")
    write_tags(run.path, {"model": "new", "weather": "rain"})

    argv = ["score", str(run.path), "--without-figures", "-q", "--mlflow", store]
    assert cli.run([*argv, "--experiment", "nightly"]) == 0

    client = MlflowClient(tracking_uri=store)
    experiment = client.get_experiment_by_name("nightly")
    assert experiment is not None
    (found,) = client.search_runs([experiment.experiment_id])
    assert found.info.run_name == "run"
    assert found.info.status == "FINISHED"
    metrics = json.loads((run.path / "score" / "metrics.json").read_text())
    precision = metrics["cues"]["stop_sign"]["precision"]
    path = "cues.stop_sign.precision"
    assert found.data.metrics[path] == precision["value"]
    assert found.data.metrics[f"{path}.low"] <= precision["low"]
    assert (found.data.tags["model"], found.data.tags["weather"]) == ("new", "rain")
    assert len(found.data.tags["crosscue.drive"]) == 64
    names = [one.path for one in client.list_artifacts(found.info.run_id)]
    assert names == ["metrics.json", "report.html"]
    report = Path(urlsplit(str(found.info.artifact_uri)).path, "report.html")
    assert report.read_bytes() == (run.path / "score" / "report.html").read_bytes()


@needs_mlflow
@pytest.mark.filterwarnings("default")
@pytest.mark.parametrize(
    ("uri", "status", "message"),
    [("folder", 1, "unless MLFLOW_ALLOW_FILE_STORE=true is set"), ("ftp://nowhere", 1, "ftp")],
)
def test_unusable_mlflow_store_is_refused_before_scoring(
    tmp_path: Path, uri: str, status: int, message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("MLFLOW_ALLOW_FILE_STORE", raising=False)
    monkeypatch.chdir(tmp_path)

    assert message in refusal(status, "score", "no_such_run", "--mlflow", uri)
