"""Every page is the one page: small, with the same colours everywhere, and commands that run."""

import html
import re
import shlex
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

import crosscue
from crosscue.datasets.truth.truth import CueTruth, read_truth, save
from crosscue.detectors.images import Encoded
from crosscue.detectors.overlay import NOTHING_TRUE, TrueMarks, draw_frame
from crosscue.eval import cli
from crosscue.eval.recording.notes import COLOURS
from crosscue.eval.report.frame_pictures import draw_pictures
from crosscue.eval.report.html import page_style
from crosscue.eval.report.page import write_report_without_truth
from crosscue.eval.runs.folder import open_run
from crosscue.eval.scoring.truth import true_marks
from crosscue.replay import colours
from crosscue.replay.files.tree_text import strict_json
from support.scene_run import SIZE, scene_run
from support.scoring import at, truth_folder

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
