"""Every fit writes a page: the result, charts of data and fit, what was dropped, what to paste.

The table has one line for each command ``fit``.
"""

import html
import re
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Final

import cv2
import numpy as np
import pytest

import crosscue
from crosscue.datasets.simulated.drive import DriveSettings
from crosscue.datasets.simulated.log_files import write_drive
from crosscue.eval import cli
from crosscue.replay.vehicle.vehicle import parse
from support.commands import output_of
from support.fusion_runs import write_drives
from support.landmark_files import write_walls
from support.refusals import refusal
from support.sign_scenes import scene, write_lights

# Arguments, words of each chart's caption, and the section to paste.
FITS: Final[dict[str, tuple[str, tuple[str, ...], str]]] = {
    "fit compass": ("DRIVE --vehicle CAR", ("Horizontal field",), "compass"),
    "fit odometry": (
        "DRIVE --vehicle CAR --truth TRUTH --keep",
        ("Way by odometry alone", "Distance from the known positions"),
        "odometry",
    ),
    "fit ranges": ("heights.csv --cue stop_sign", ("Pairs and curves", "by distance"), "ranges"),
    "fit signs": (
        "signs.csv --label LEFT --threshold 0.06",
        ("Precision and recall",),
        "detectors",
    ),
    "fit detector": (
        "lights/run --labels lights/labels --precision 0.6 --calibration none",
        ("traffic light: precision and recall",),
        "scores",
    ),
    "fit messages": ("RUNS --truth TRUTHS", ("for each cue and feature",), "fusion"),
    "fit temporal": ("RUNS --truth TRUTHS", ("Log score on held-out places",), "fusion"),
    "fit landmarks": (
        "--pairs pairs.csv --false-match-rate 0.4",
        ("Fraction of pairs that match",),
        "landmarks",
    ),
}
LEFT: Final = "one way left"


@pytest.fixture(scope="module")
def named(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, list[str]]]:
    """A folder with the inputs of every fit, and the words of the table that stand for paths."""
    folder = tmp_path_factory.mktemp("fits")
    drive = write_drive(folder / "drive", DriveSettings(seed=3, blocks=2, block_m=60.0))
    runs, truths = write_drives(folder / "beliefs", [True, False, False, True, False, None] * 2)
    _write_tables(folder)
    write_lights(folder / "lights", 160)
    return folder, {
        "DRIVE": [str(drive.log)],
        "CAR": [str(drive.vehicle)],
        "TRUTH": [str(drive.truth)],
        "RUNS": list(map(str, runs)),
        "TRUTHS": list(map(str, truths)),
        "LEFT": [LEFT],
    }


def _write_tables(folder: Path) -> None:
    """Write heights with ranges, pictures of signs, and pairs of pictures."""
    rng = np.random.default_rng(4)
    heights = [f"{200 / m},{m + rng.normal()}" for m in range(5, 60)]
    (folder / "heights.csv").write_text("\n".join(["height_px,range_m", *heights]))
    signs = ["picture,label,x0,y0,x1,y1"]
    for k in range(4):
        shown = scene("one way left", k)
        cv2.imwrite(str(folder / f"sign{k}.png"), shown.grey)
        signs.append(f"sign{k}.png,{LEFT},{','.join(map(str, shown.box.tolist()))}")
    (folder / "signs.csv").write_text("\n".join(signs))
    write_walls(folder)


def test_every_fit_is_in_the_table() -> None:
    assert FITS.keys() == {name for name in cli.COMMANDS if name.startswith("fit ")}


@pytest.mark.parametrize("name", FITS)
def test_page_of_fit_shows_data_fit_losses_and_section(
    name: str,
    named: tuple[Path, dict[str, list[str]]],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    folder, words_of = named
    monkeypatch.chdir(folder)
    line, captions, section = FITS[name]
    given = [one for word in line.split() for one in words_of.get(word, [word])]
    page = tmp_path / "fit.html"

    printed = output_of(*name.split(), *given, "--page", page)
    text = page.read_text()
    (report,) = re.findall('<pre class="lines">(.*?)</pre>', text, re.DOTALL)
    assert printed.startswith(html.unescape(report).rstrip())
    assert "Nothing was dropped" in text
    figures = re.findall("<svg.*?</svg><figcaption>(.*?)</figcaption>", text, re.DOTALL)
    charts = re.findall("<svg.*?</svg>", text, re.DOTALL)
    assert all(any(words in one for one in figures) for words in captions)
    assert all("<polyline" in one or "<circle" in one for one in charts)
    (pasted,) = re.findall(r"<h2>For the [^<]*</h2>\s*<pre>(.*?)</pre>", text, re.DOTALL)
    assert html.unescape(pasted).strip() in printed
    assert section in tomllib.loads(html.unescape(pasted))
    if name != "fit detector":
        parse(f"version = 1\n{html.unescape(pasted)}", "the page")
    assert page.stat().st_size < 3_000_000

    # An existing page is refused before any work.
    assert "exists; give another name or --overwrite" in refusal(
        1, *name.split(), *given, "--page", page
    )
    assert page.read_text() == text


def test_page_names_what_was_dropped(
    named: tuple[Path, dict[str, list[str]]],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    _, words_of = named
    log = tmp_path / "cut.mcap"
    content = Path(words_of["DRIVE"][0]).read_bytes()
    log.write_bytes(content[: len(content) * 9 // 10])
    page = tmp_path / "fit.html"
    line = ["fit", "compass", str(log), "--vehicle", *words_of["CAR"], "--page", str(page)]

    assert cli.run(line) == 3

    losses = [
        one.removeprefix("crosscue: dropped: ")
        for one in capsys.readouterr().err.splitlines()
        if one.startswith("crosscue: dropped: ")
    ]
    text = html.unescape(page.read_text())
    assert losses
    assert all(f"<li>{one}</li>" in text for one in losses)
    assert "Nothing was dropped" not in text


def test_page_of_fit_to_runs_with_drops_does_not_say_that_nothing_was_dropped(
    named: tuple[Path, dict[str, list[str]]], tmp_path: Path
) -> None:
    folder, _ = named
    found = crosscue.fit_detector(
        folder / "lights/run", folder / "lights/labels", precision=0.6, calibration="none"
    )
    replace(found, is_whole=False).write_page(tmp_path / "fit.html")

    text = (tmp_path / "fit.html").read_text()
    assert "dropped when the runs were made" in text
    assert "Nothing was dropped" not in text


def test_result_is_printed_where_its_page_cannot_be_written(
    named: tuple[Path, dict[str, list[str]]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, _ = named
    (tmp_path / "file").write_text("")
    page = tmp_path / "file" / "fit.html"
    line = ["fit", "ranges", str(folder / "heights.csv"), "--cue", "stop_sign"]

    assert cli.run([*line, "--page", str(page)]) == 1

    printed = capsys.readouterr()
    assert "[ranges.stop_sign]" in printed.out
    assert str(page) in printed.err
    assert printed.err.count("\n") == 1
