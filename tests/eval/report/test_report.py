"""The report page: it has no active content, says first what happened, and shows mistakes."""

import base64
import json
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from markupsafe import Markup

from crosscue.eval import cli
from crosscue.eval.report.opening import opening_of
from crosscue.eval.report.page import reported_time, write_report
from crosscue.eval.report.scene_figures import (
    draw_belief,
    draw_distances,
    draw_range,
    draw_reliability,
)
from crosscue.eval.report.svg_plot import Panel, SvgChart, ticks
from crosscue.eval.report.worst_frames import worst_frames
from crosscue.eval.runs.candidates import CandidateRow
from crosscue.eval.runs.folder import RunFolder, write_manifest
from crosscue.eval.runs.manifest import SceneSummary
from crosscue.eval.runs.moments import moment_ns
from crosscue.eval.scoring.files import FOLDER
from crosscue.eval.scoring.runs import RunScored, judge_run, metrics_of, pooled_scores
from support.manifests import estimate_manifest
from support.scene_run import SIZE, scene_run
from support.scoring import approach, at, good_truth, span, truth, truth_folder

HEADINGS = [
    f">{name}</h2>" for name in ("Intersections", "Cues", "Belief", "Range", "Account", "How")
]
HOSTILE = '<script>alert(1)</script>"onload="x'


class _ParsedPage(HTMLParser):
    """Parser of elements, the resources that they load, and their handlers."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.loads: list[str] = []
        self.handlers: list[str] = []
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.loads += [value or "" for name, value in attrs if name in ("src", "href")]
        self.handlers += [name for name, _ in attrs if name.startswith("on")]


def _scored(folder: Path, name: str = "A", **more: Any) -> RunScored:
    """Score a run with a false crossing car from frame 21 on."""
    run = scene_run(folder, **more)
    reported = truth(
        [*good_truth().truth.cues, span("cross_traffic_right", 0, 40, present=False, count=0)],
        approaches=[approach(intersection=name)],
    )
    return judge_run(run, truth_folder(folder, reported))


def _report_text(folder: Path, *scored: RunScored, **more: Any) -> str:
    scores = pooled_scores(scored)
    path = write_report(
        folder, scored, scores, {**metrics_of(scored, scores), **more}, worst_frames(scored)
    )
    return path.read_text(encoding="utf-8")


def test_hostile_names_do_not_become_active_content(tmp_path: Path) -> None:
    page = _report_text(tmp_path, _scored(tmp_path / HOSTILE.replace("/", ""), HOSTILE))

    seen = _ParsedPage(page)
    assert not {"script", "iframe", "object", "embed", "link", "b onload"} & set(seen.tags)
    assert seen.handlers == []
    assert all(re.match(r"data:image/(jpeg|png);base64,|#", one) for one in seen.loads)
    assert "default-src 'none'" in page
    assert "<b>cut</b>" not in page
    assert "&lt;b&gt;cut&lt;/b&gt;" in page
    assert "/camera/[red]&lt;script&gt;" in page


def test_what_happened_is_first_and_losses_are_reported(tmp_path: Path) -> None:
    page = _report_text(tmp_path, _scored(tmp_path / "drive"))

    parts = ('class="told"', "rows known to be dropped", 'class="strip"')
    order = [page.index(part) for part in (*parts, *HEADINGS)]
    assert order == sorted(order)
    assert "<b>50 of 50</b>" in page
    assert "rows were dropped." in page
    assert "1 &lt;b&gt;not decoded&lt;/b&gt;" in page
    assert "Not scored:</b> pose (the truth has no track (pose: missing))" in page


def test_tables_report_metrics_and_published_values(tmp_path: Path) -> None:
    one = _scored(tmp_path / "drive")
    metrics = metrics_of([one], pooled_scores([one]))
    page = _report_text(tmp_path, one)

    precision = metrics["cues"]["cross_traffic_right"]["precision"]
    assert (precision["right"], precision["of"]) == (0, 19)
    rows = re.findall(r"<tr><td>cross traffic right</td>(.*?)</tr>", page)
    cells = re.findall(r"<td>(?:<b>)?(.*?)(?:</b>)?</td>", rows[0])
    assert cells[:4] == ["39", "19", "0", "0.000"]
    assert cells[6] == "0.86"
    assert "<b>15.0 m</b>" in page


def test_simulated_drives_are_labelled(tmp_path: Path) -> None:
    drive = _scored(tmp_path / "drive")
    assert "Simulated" not in _report_text(tmp_path, drive)

    reported = json.loads((tmp_path / "drive" / "truth.json").read_text())
    reported["source"] = "simulated by crosscue"
    (tmp_path / "drive" / "truth.json").write_text(json.dumps(reported))
    page = _report_text(tmp_path, judge_run(drive.run, tmp_path / "drive" / "truth.json"))

    assert "<b>Simulated</b>: this drive and the truth were computed" in page


def test_candidates_are_reported_in_table_and_notices(tmp_path: Path) -> None:
    scored = _scored(tmp_path / "a")
    lights = CandidateRow(
        unit="detections",
        setting="[cues] traffic_light_score",
        threshold=0.9,
        seen=87,
        used=0,
        skipped={"below score": 87},
        max_score=0.62,
    )
    scene = SceneSummary(
        frames=50,
        positive={},
        counts={},
        without_odometry=0,
        approaches=(),
        candidates={"traffic_light": lights},
        ranged={"traffic_light": lights},
        not_looked_for={"do_not_enter": "no detector can report their labels"},
    )
    manifest = estimate_manifest(scored.run)
    write_manifest(
        scored.run, manifest.model_copy(update={"scene": scene, "notices": ("warning",)})
    )

    page = _report_text(tmp_path, scored)

    assert "<li>warning</li>" in page
    assert "<li>traffic_light: 87 detections, none above 0.90 (highest 0.62)" in page
    assert "<li>not looked for, no detector can report their labels: do_not_enter</li>" in page
    row = "<td>87 detections</td><td>0</td><td>0.62</td><td>0.90</td>"
    assert f"<td>traffic light</td>{row}" in page
    assert f"<td>range: traffic light</td>{row}" in page


def test_worst_frame_is_shown_with_picture_and_time(tmp_path: Path) -> None:
    one = _scored(tmp_path / "drive")

    (worst,) = worst_frames([one])

    assert (worst.cue, worst.t_ns, worst.frames) == ("cross_traffic_right", at(21), 19)
    assert (worst.count, worst.true_count, worst.confidence) == (1, 0, 0.97)
    pixels = cv2.imdecode(np.frombuffer(base64.b64decode(worst.picture), np.uint8), 1)
    assert pixels is not None
    assert pixels.shape == (SIZE[1], SIZE[0], 3)
    page = _report_text(tmp_path, one)
    assert f"<code>crosscue view {one.run.path} --at {at(21)}ns</code>" in page


def test_report_opens_with_a_sentence_and_pictures_of_moments(tmp_path: Path) -> None:
    one = _scored(tmp_path / "drive")

    opening = opening_of(one.run, 0.9, one, worst_frames([one]))

    told = " ".join(opening.sentences)
    assert told.startswith("Intersection found 30.0 m ahead.")
    assert "Left and right believed and there." in told
    assert 4 <= len(opening.moments) <= 8
    assert [m.t_ns for m in opening.moments] == sorted(m.t_ns for m in opening.moments)
    assert all(m.picture for m in opening.moments)
    (wrong,) = [m for m in opening.moments if m.t_ns == at(21)]
    assert wrong.is_wrong
    assert "wrong: cross traffic right" in wrong.what
    seconds = f"{wrong.at_s:.2f}"
    assert moment_ns(one.run, seconds) == pytest.approx(wrong.t_ns, abs=5e6)
    page = _report_text(tmp_path, one)
    assert f"crosscue view {one.run.path} --at {seconds}</code>" in page


def test_run_without_a_truth_has_a_report(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = _scored(tmp_path / "drive").run

    assert cli.run(["report", str(run.path)]) == 3
    path = run.file("report.html")
    assert capsys.readouterr().out.split() == [str(path)]
    page = path.read_text(encoding="utf-8")
    assert '<p class="told">Intersection believed' in page
    assert "crosscue view" in page
    assert not {"script", "link"} & set(_ParsedPage(page).tags)
    assert cli.run(["report", str(run.path), "--threshold", "1.5"]) == 2


def test_missing_log_is_an_error_unless_images_are_left_out(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = _scored(tmp_path / "drive").run
    truth = tmp_path / "drive" / "truth.json"
    (tmp_path / "moved").mkdir()
    (tmp_path / "drive" / "drive.mcap").rename(tmp_path / "moved" / "drive.mcap")
    argv = ["score", str(run.path), "--truth", str(truth)]

    assert cli.run(argv) == 4
    printed = capsys.readouterr().err
    assert printed.count("\n") == 1
    assert "drive.mcap is gone; name its folder with --logs DIR" in printed
    assert "--without-images" in printed
    assert not run.file("score").exists()

    assert cli.run([*argv, "--logs", str(tmp_path / "moved")]) == 3
    assert "Its picture" not in (run.file("score") / "report.html").read_text()
    assert cli.run([*argv, "--without-images"]) == 3
    assert "Its picture is not available." in (run.file("score") / "report.html").read_text()


def test_equal_scores_yield_equal_reports(tmp_path: Path) -> None:
    one = _scored(tmp_path / "drive")

    first = _report_text(tmp_path / "a", one)
    again = judge_run(RunFolder(one.run.path), tmp_path / "drive" / "truth.json")

    assert _report_text(tmp_path / "b", again) == first


def test_attribution_of_a_cue_is_reported(tmp_path: Path) -> None:
    nothing = {"value": 0.0, "low": None, "high": None}
    worth = {
        "stop_sign": {
            "detected_m": nothing | {"value": 12.34},
            "full_m": nothing | {"value": None},
            "detected_only_with": 3,
            "full_only_with": 2,
            "full_only_without": 1,
            "belief": {"left": {"log_score": nothing | {"value": -0.5}}},
        }
    }
    one = _scored(tmp_path / "drive")

    page = _report_text(tmp_path, one, attribution=worth)

    row = re.findall(r"<tr><td>stop sign</td><td>([+].*?)</tr>", page)[0]
    cells = re.split(r"</?td>+", row)
    assert [cell for cell in cells if cell] == [
        "+12.3",
        "3",
        "-",
        "2",
        "1",
        "-",
        "-0.500",
        "-",
        "-",
    ]
    assert "crosscue score --attribution" not in page
    assert "crosscue score --attribution" in _report_text(tmp_path, one)


def test_several_drives_share_one_page(tmp_path: Path) -> None:
    drives = [_scored(tmp_path / name, name) for name in ("one", "two", "three")]
    failed = {"runs/<four>": "runs/<four>: no manifest.json"}
    scores = pooled_scores(drives)
    metrics = metrics_of(drives, scores)
    metrics["coverage"]["failed"] = failed

    page = write_report(tmp_path, drives, scores, metrics, worst_frames(drives)).read_text()

    assert "<h1>3 drives</h1>" in page
    assert "<b>150 of 150</b>" in page
    assert "runs/&lt;four&gt;: no manifest.json" in page
    assert page.count("Probability against distance") == 3


def test_run_without_belief_has_a_page(tmp_path: Path) -> None:
    gone = frozenset({"belief", "range"})
    page = _report_text(tmp_path, _scored(tmp_path / "drive", without=gone))

    assert "<h2>Cues</h2>" in page
    assert "<h2>Belief</h2>" not in page
    assert "belief (the run has no belief)" in page


def test_score_writes_the_page_and_prints_its_path(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    runs = [str(_scored(tmp_path / name, name).run.path) for name in ("one", "two")]

    assert cli.run(["score", runs[0]]) == 3
    reported = capsys.readouterr().out
    assert f"written to {Path(runs[0]) / FOLDER / 'report.html'}" in reported
    assert cli.run(["score", *runs, "-o", str(tmp_path / "all"), "-q"]) == 3
    assert "<h1>2 drives</h1>" in (tmp_path / "all" / "report.html").read_text()


def test_charts_have_text_descriptions(tmp_path: Path) -> None:
    one = _scored(tmp_path / "drive")
    scores = pooled_scores([one])
    assert scores.approaches is not None
    assert one.judged.approaches is not None
    (curve,) = one.judged.approaches.curves
    charts = [
        draw_distances(scores.approaches.results),
        draw_belief(curve, one.judged.cues),
        draw_range(one.judged.ranges, scores.range),
        draw_reliability(scores.belief),
    ]
    for chart in charts:
        assert isinstance(chart, Markup)
        assert re.match(r'<svg viewBox="[\d .]+" role="img"', chart)
        assert re.search(r"<title>.+?</title><desc>.+?</desc>", chart)
    assert "intersection exceeds 0.9 from 30 m on; left exceeds 0.9 from 20 m on" in charts[1]
    assert "bias 0.50 m, rms error 0.50 m" in charts[2]


def test_belief_without_true_distances_is_drawn_over_time(tmp_path: Path) -> None:
    one = _scored(tmp_path / "drive")
    assert one.judged.approaches is not None
    (curve,) = one.judged.approaches.curves
    unknown = replace(curve, distance_m=np.full_like(curve.distance_m, np.nan))

    chart = draw_belief(unknown, one.judged.cues)

    assert "time to the last frame (s)" in chart
    assert "true distance" not in chart
    assert re.search(r"intersection exceeds 0.9 from \d+ s on", chart)
    assert chart.count("<polyline") + chart.count("<path") >= len(curve.features)


def test_range_chart_includes_the_claimed_interval(tmp_path: Path) -> None:
    one = _scored(tmp_path / "drive")
    scores = pooled_scores([one])
    unsure = [replace(part, var_m2=np.full_like(part.var_m2, 100.0)) for part in one.judged.ranges]

    chart = draw_range(unsure, scores.range)

    assert re.search(r">-20<", chart)
    assert not re.search(r">-20<", draw_range(one.judged.ranges, scores.range))


def test_range_chart_shows_its_worst_bins(tmp_path: Path) -> None:
    one = _scored(tmp_path / "drive")
    scores = dict(pooled_scores([one]).range)
    bins = dict(scores["start"].by_distance)
    worst = max(bins)
    bins |= {worst: replace(bins[worst], nees=73.5), "over 120": replace(bins[worst], nees=41.0)}
    scores["start"] = replace(scores["start"], by_distance=bins)

    chart = draw_range(one.judged.ranges, scores)

    assert f"{worst} m: 73.50" in chart
    assert "over 120 m: 41.00" in chart
    heights = [float(y) for y in re.findall(r'cy="([0-9.]+)"', chart)]
    assert sorted(heights)[0] < sorted(heights)[1] < sorted(heights)[2]


@settings(max_examples=60, deadline=None)
@given(st.floats(-1e6, 1e6), st.floats(1e-3, 1e6), st.integers(2, 9))
def test_ticks_are_few_round_and_inside_the_range(low: float, width: float, max_count: int) -> None:
    found = ticks(low, low + width, max_count)

    assert max_count // 2 <= len(found) <= max_count + 1
    assert all(low - 1e-6 * width <= one <= low + width * (1 + 1e-6) for one in found)
    steps = np.diff(found)
    np.testing.assert_allclose(steps, np.full(len(steps), steps[:1].sum()), rtol=1e-3)
    assert (steps > 0.0).all()
    leading = steps / 10.0 ** np.floor(np.log10(steps) + 1e-4)
    assert (np.abs(leading[:, None] - [1.0, 2.0, 2.5, 5.0]).min(axis=1) < 1e-3).all()


def test_curve_breaks_at_missing_values() -> None:
    drawing = SvgChart(100, 100, "title", "description")
    panel = Panel(0, 0, 100, 100, (0.0, 4.0), (0.0, 1.0))

    drawing.curve(panel, np.arange(5.0), np.array([0.0, 1.0, np.nan, 1.0, 0.0]), "line")

    assert drawing.svg().count("<polyline") == 2


def test_times_are_formatted_like_the_viewer() -> None:
    assert reported_time(1_700_000_014_250_999_999) == "2023-11-14 22:13:34.250 UTC"
    assert reported_time(2_500_000_000) == "2.500 s"
