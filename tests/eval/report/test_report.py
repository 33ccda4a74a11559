"""The report of a run."""

import base64
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st

from crosscue.eval import cli
from crosscue.eval.drives.score import mistakes_of
from crosscue.eval.recording import save_rrd
from crosscue.eval.report import page
from crosscue.eval.report.frame_pictures import draw_pictures
from crosscue.eval.report.opening import judged_sentences, opening_of
from crosscue.eval.report.page import write_report, write_report_without_truth
from crosscue.eval.report.scene_figures import draw_belief
from crosscue.eval.report.svg_plot import ticks
from crosscue.eval.runs.folder import RunFolder
from crosscue.eval.runs.moments import moment_ns
from crosscue.eval.runs.tables.log_time import gaps_of
from crosscue.eval.scoring.intervals import MIN_CLUSTERS
from crosscue.eval.scoring.runs import RunScored, judge_run, metrics_of, pooled_scores
from support.gap_drive import Clock, replayed, write_drive
from support.recordings import cells
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
        folder, scored, scores, {**metrics_of(scored, scores), **more}, mistakes_of(scored, 0.9)
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

    parts = ('class="told"', "rows known to be dropped", 'class="strip"', "Truth: ")
    order = [page.index(part) for part in (*parts, *HEADINGS)]
    assert order == sorted(order)
    assert "<b>50 of 50</b>" in page
    assert f"resamples places and needs {MIN_CLUSTERS} or more" in page
    assert "rows were dropped." in page
    assert "1 &lt;b&gt;not decoded&lt;/b&gt;" in page
    assert "Not scored:</b> pose (the truth has no track (pose: missing))" in page


def test_failure_is_shown_with_picture_and_command(tmp_path: Path) -> None:
    one = _scored(tmp_path / "drive")

    (wrong,) = [m for m in mistakes_of([one], 0.9) if m.kind == "false"]

    assert (wrong.what, wrong.t_ns, wrong.at_s) == ("cross_traffic_right", at(21), 2.1)
    assert "found in 19 frames, score up to 0.97" in wrong.text
    page = _report_text(tmp_path, one)
    assert "<b>false: cross traffic right</b>, another cue is there: found in 19 frames" in page
    assert f"<code>crosscue view {one.run.path} --at 2.100</code>" in page
    pictures = re.findall(
        r'alt="false: cross traffic right" src="data:image/jpeg;base64,([^"]+)', page
    )
    pixels = cv2.imdecode(np.frombuffer(base64.b64decode(pictures[0]), np.uint8), 1)
    assert pixels is not None
    assert pixels.shape == (SIZE[1], SIZE[0], 3)


def test_report_opens_with_a_sentence_and_pictures_of_moments(tmp_path: Path) -> None:
    one = _scored(tmp_path / "drive")

    opening = opening_of(one.run, 0.9, one, mistakes_of([one], 0.9))

    told = " ".join(opening.sentences)
    assert told.startswith("Intersection found 30.0 m ahead.")
    assert "Left and right believed and there." in told
    assert 4 <= len(opening.moments) <= 8
    assert [m.t_ns for m in opening.moments] == sorted(m.t_ns for m in opening.moments)
    assert all(m.picture for m in opening.moments)
    (wrong,) = [m for m in opening.moments if m.t_ns == at(21)]
    assert wrong.is_wrong
    assert "false: cross traffic right" in wrong.what
    seconds = f"{wrong.at_s:.3f}"
    assert moment_ns(one.run, seconds) == pytest.approx(wrong.t_ns, abs=5e6)
    page = _report_text(tmp_path, one)
    assert f"crosscue view {one.run.path} --at {seconds}</code>" in page


@pytest.mark.parametrize(
    ("last", "told"),
    [
        ({}, "Left and right are there and were not seen: no cue shows them."),
        (
            {"left": 0.4},
            "Left and right are there and were not seen: left, never probable enough, 0.40 at the "
            "end; right, never probable enough.",
        ),
    ],
)
def test_missed_roads_are_told_in_one_sentence(
    tmp_path: Path, last: dict[str, float], told: str
) -> None:
    one = _scored(tmp_path / "drive")
    assert one.judged.approaches is not None
    (result,) = one.judged.approaches.results
    missed = replace(
        result, features_m={"intersection": 30.0, "left": None, "right": None}, at_entering=last
    )
    cues = tuple(one.judged.cues) if last else ()
    approaches = replace(one.judged.approaches, results=(missed,))
    judged = replace(one.judged, cues=cues, approaches=approaches)

    sentences = judged_sentences(replace(one, judged=judged))

    assert sentences[0].endswith(told)
    assert sentences[0].count("not seen") == 1


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


def test_run_with_a_pose_only_has_a_report_of_its_pose(tmp_path: Path) -> None:
    tables = frozenset({"frames", "detections", "road", "cues", "belief", "range"})
    run = scene_run(tmp_path / "drive", without=tables)

    write_report_without_truth(run, tmp_path / "report.html", 0.9)

    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "<title>Map</title>" in page
    assert "2-sigma ellipse, full major axis (m)" in page
    assert "The estimated path is" in page
    assert "0 of 0" not in page
    assert "<b>-" not in page
    assert ">Intersections</h2>" not in page


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


def test_tile_without_a_distance_says_never(tmp_path: Path) -> None:
    one = _scored(tmp_path / "drive")
    found = metrics_of([one], pooled_scores([one]))["approaches"]
    none = found | {"full": found["full"] | {"right": 0}}

    assert "<b>never</b>" in _report_text(tmp_path, one, approaches=none)


def _needed_px(table: str) -> float:
    """Least width of a table in a browser: that of its longest lines, and of its padding."""
    rows = [
        [
            max(len(part) for part in re.split(r"<small>| " if "text" in kind else "<small>", cell))
            for kind, cell in re.findall(r"<t[dh]([^>]*)>(.*?)</t[dh]>", row)
        ]
        for row in table.replace("&emsp;", "  ").replace("</small>", "").split("<tr")[1:]
    ]
    widths: list[int] = [max(column) for column in zip(*rows, strict=True)]
    return sum(7.7 * width + 17.6 for width in widths)


def test_tables_beside_figures_fit_their_columns(tmp_path: Path) -> None:
    """At 1400 px, the column of a pair is 585 px wide; what does not fit is cut off."""
    scored = [_scored(tmp_path / name, name) for name in "ABCDE"]

    for some in (scored[:1], scored):
        pairs = _report_text(tmp_path / f"{len(some)}", *some).split('<div class="pair">')[1:]
        tables = [one.partition("<table>")[2].partition("</table>")[0] for one in pairs]
        assert len(tables) == 2
        assert [table for table in tables if _needed_px(table) > 585] == []


def test_pictures_of_a_report_leave_out_unlikely_detections(tmp_path: Path) -> None:
    run = _scored(tmp_path / "drive").run
    path = run.file("detections.parquet")
    table = pq.read_table(path)
    drawn: dict[bool, dict[int, bytes]] = {}
    weak = pa.array([0.2] * len(table), table.schema.field("score").type)
    place = table.schema.get_field_index("score")
    pq.write_table(table.set_column(place, table.schema.field("score"), weak), path)
    for has_candidates in (True, False):
        kept: dict[int, bytes] = drawn.setdefault(has_candidates, {})

        def keep(t_ns: int, picture: bytes, _: bytes, kept: dict[int, bytes] = kept) -> None:
            kept[t_ns] = picture

        draw_pictures(run, [at(21)], keep, has_candidates=has_candidates)

    assert drawn[True].keys() == drawn[False].keys() == {at(21)}
    assert drawn[True] != drawn[False]


PAUSE = Clock(pause_s=(5.0, 7.1))


@pytest.fixture(scope="module")
def paused(tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    folder = tmp_path_factory.mktemp("paused")
    return replayed(folder, write_drive(folder, PAUSE))


def test_lines_of_a_recording_break_at_gaps(paused: RunFolder, tmp_path: Path) -> None:
    path = tmp_path / "run.rrd"
    save_rrd(paused, path)

    (gap,) = gaps_of(paused.drive_manifest().timeline)
    lines = [
        "/plots/belief/intersection",
        "/plots/range/start",
        "/plots/speed/speed_mps",
        "/plots/heading/heading_deg",
        "/plots/ellipse/major_axis_m",
    ]
    for entity in lines:
        rows = cells(path, entity, "scalars")
        assert len(rows) > 50, entity
        before = [value for t_ns, value in rows if t_ns < gap.middle_ns]
        assert np.isnan(before[-1][0]), entity
    states = cells(path, "/cues/stop_sign", "state")
    assert [bool(value) for t_ns, value in states if t_ns < gap.middle_ns][-1] is False
    assert len(cells(path, "/plan/estimate", "strips", is_static=True)[0][1]) == 2


def test_moments_of_a_drive_whose_clock_was_set_have_pictures_and_open(tmp_path: Path) -> None:
    run = replayed(tmp_path, write_drive(tmp_path, Clock(set_at_s=3.0, by_s=-3600.0)))

    opening = opening_of(run, 0.9)

    assert opening.moments
    assert all(one.picture for one in opening.moments), opening.missing
    frames = set(run.table("frames")["t_ns"].to_pylist())
    for one in opening.moments:
        assert one.t_ns in frames
        assert moment_ns(run, f"{one.at_s:.3f}") == pytest.approx(one.t_ns, abs=1e6)


@pytest.mark.parametrize("step_deg", [0.0, 0.5])
def test_report_names_a_step_of_the_pitch_and_lists_ten_seconds_each(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step_deg: float
) -> None:
    monkeypatch.setattr(page, "span_ns", lambda run: (0, 40_000_000_000))
    t_s = np.arange(0.0, 40.0, 0.1)
    noise = 5e-4 * np.random.default_rng(1).normal(size=len(t_s))
    columns = {
        "t_ns": np.round(t_s * 1e9).astype(np.int64),
        "pitch_rad": 0.02 + np.radians(step_deg) * (t_s > 20.0) + noise,
        "is_standing": np.zeros(len(t_s), np.bool_),
    }
    pq.write_table(pa.table(columns), tmp_path / "visual_odometry.parquet")

    windows, steps = page._pitch(RunFolder(tmp_path))

    assert [one.partition(":")[0] for one in windows] == [
        "0 to 10 s",
        "10 to 20 s",
        "20 to 30 s",
        "30 to 40 s",
    ]
    assert "+1.15 +-" in windows[0]
    assert [one.rpartition(" at ")[2] for one in steps] == (["20 s"] if step_deg else [])
