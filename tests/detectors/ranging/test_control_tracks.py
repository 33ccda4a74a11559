"""Stop signs and traffic lights by their tracks over frames, and lit lenses."""

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
import pytest

from crosscue.detectors.base import ACCEPTED, Detections
from crosscue.detectors.catalog import entries
from crosscue.detectors.cues.candidates import TOO_LITTLE_EVIDENCE
from crosscue.detectors.cues.frame import CuePass
from crosscue.detectors.cues.observed import FrameDetections
from crosscue.detectors.ranging.control_tracks import (
    BELOW_HORIZON,
    ControlTracks,
)
from crosscue.detectors.ranging.lens import Lens, lens_of
from crosscue.detectors.ranging.object_tracks import CarStep
from crosscue.replay.columns import Bytes
from crosscue.replay.vehicle.vehicle import Vehicle, parse
from support.data import shared

SIZE = (1280, 720)
STEP = CarStep(None, 0.0, 0.0, 0.1)
# Place (x, y), score, and what the pixels show.
Seen = tuple[float, float, float, str]
LIGHT, SIGN = "traffic light", "stop sign"
NANO = entries.entry("yolox-nano").scores[LIGHT].log_ratio or ()
CORNERS = np.array([[-1.0, -1.0, 1.0, 1.0]])


def car(text: str = "") -> Vehicle:
    return parse("version = 1\n" + text, "v.toml")


def frame(
    seen: Sequence[Seen], label: str = LIGHT, jitter: float = 0.0, *, is_nano: bool = True
) -> Detections:
    n = len(seen)
    boxes = np.array([[x - 6, y - 15, x + 6, y + 15] for x, y, *_ in seen]).reshape(-1, 4)
    shown = tuple(one[3] for one in seen)
    return Detections(
        0,
        SIZE,
        boxes + jitter,
        np.array([one[2] for one in seen]),
        (label,) * n,
        (b"",) * n,
        lenses=shown if label == LIGHT else (),
        looks=shown if label == SIGN else (),
        log_ratios={LIGHT: NANO} if is_nano else {},
    )


def decided(
    frames: Sequence[Sequence[Seen]],
    label: str = LIGHT,
    step: CarStep = STEP,
    vehicle: Vehicle | None = None,
) -> list[tuple[str, ...]]:
    """Decisions on the boxes of each frame; the boxes move a little, as no picture is repeated."""
    tracks = ControlTracks(vehicle or car())
    return [
        tracks([frame(seen, label, 0.01 * i)], step)[0].decisions for i, seen in enumerate(frames)
    ]


def test_another_network_is_not_judged_by_the_boxes_of_yolox_nano() -> None:
    """At 0.5, yolox-nano's large boxes are mostly no lights; a coarse network sees no others."""
    decisions = []
    for is_nano in (True, False):
        tracks = ControlTracks(car())
        for i in range(20):
            one = frame([(600.0, 140.0, 0.5, "unknown")], jitter=0.01 * i, is_nano=is_nano)
            near = replace(one, boxes_px=one.boxes_px + np.array([-18.0, -45.0, 18.0, 45.0]))
            (said,) = tracks([near], STEP)
        decisions.append(said.decisions)

    assert decisions == [(TOO_LITTLE_EVIDENCE,), (ACCEPTED,)]


def test_fifty_weak_consistent_frames_are_accepted() -> None:
    found = decided([[(600.0, 140.0, 0.35, "unknown")]] * 50)

    assert found[0] == (TOO_LITTLE_EVIDENCE,)
    assert found[-1] == (ACCEPTED,)


@pytest.mark.parametrize("score", [0.6, 0.9, 0.999])
def test_isolated_strong_boxes_are_not_accepted(score: float) -> None:
    rng = np.random.default_rng(3)
    frames: list[list[Seen]] = [
        [(float(rng.uniform(20, 1260)), float(rng.uniform(20, 600)), score, "red")]
        if i % 5 == 0
        else []
        for i in range(100)
    ]

    assert {one for said in decided(frames) for one in said} == {TOO_LITTLE_EVIDENCE}


def test_clear_light_is_accepted_in_the_third_frame() -> None:
    found = decided([[(600.0, 140.0, 0.8, "unknown")]] * 3)

    assert found == [(TOO_LITTLE_EVIDENCE,), (TOO_LITTLE_EVIDENCE,), (ACCEPTED,)]


def test_noise_at_the_lowest_scores_is_never_accepted() -> None:
    found = decided([[(600.0, 140.0, 0.15, "unknown")]] * 300)

    assert {one for said in found for one in said} == {TOO_LITTLE_EVIDENCE}


def test_decisions_do_not_depend_on_the_order_of_boxes_and_detectors() -> None:
    rng = np.random.default_rng(5)
    places = [(100.0 + 90.0 * k, 140.0) for k in range(8)]
    one, other, apart = (ControlTracks(car()) for _ in range(3))
    for i in range(30):
        seen: list[Seen] = [
            (x + rng.normal(), y, float(rng.uniform(0.1, 0.7)), "unknown") for x, y in places
        ]
        order = rng.permutation(len(seen))
        (said,) = one([frame(seen)], STEP)
        (turned,) = other([frame([seen[k] for k in order])], STEP)
        halves = apart([frame(seen[4:]), frame(seen[:4])], STEP)
        assert [said.decisions[k] for k in order] == list(turned.decisions), i
        assert said.decisions == halves[1].decisions + halves[0].decisions, i


def test_decision_uses_nothing_of_later_frames() -> None:
    rng = np.random.default_rng(7)
    frames: list[list[Seen]] = [
        [(600.0, 140.0, float(rng.uniform(0.1, 0.6)), "unknown")] for _ in range(40)
    ]

    whole = decided(frames)
    for n in (1, 7, 25):
        assert decided(frames[:n]) == whole[:n]


def test_repeated_picture_adds_no_evidence() -> None:
    one = ControlTracks(car())
    seen = frame([(600.0, 140.0, 0.8, "red")])

    found = [one([seen], STEP)[0].decisions for _ in range(100)]

    assert set(found) == {(TOO_LITTLE_EVIDENCE,)}


def test_pause_of_the_log_neither_adds_evidence_nor_takes_a_decision_back() -> None:
    weak, strong = [(600.0, 140.0, 0.3, "unknown")], [(600.0, 140.0, 0.9, "unknown")]
    for before, after in ((weak, TOO_LITTLE_EVIDENCE), (strong, ACCEPTED)):
        one = ControlTracks(car())
        for i in range(4):
            one([frame(before, jitter=0.01 * i)], STEP)
        (said,) = one([frame(before, jitter=1.0)], STEP._replace(seconds=600.0))
        assert said.decisions == (after,)


@pytest.mark.parametrize("rate_hz", [10, 20, 50])
def test_evidence_of_a_second_is_the_same_at_any_frame_rate(rate_hz: int) -> None:
    seconds = 1.0 / rate_hz
    frames = [[(600.0, 140.0, 0.37, "unknown")]] * (6 * rate_hz)
    found = decided(frames, step=STEP._replace(seconds=seconds))

    first_s = seconds * next(i for i, one in enumerate(found) if one == (ACCEPTED,))
    assert first_s == pytest.approx(0.6, abs=0.15)


def test_light_that_is_missed_in_every_other_frame_is_still_found() -> None:
    light: Seen = (600.0, 140.0, 0.6, "unknown")
    found = decided([[light] if i % 2 else [] for i in range(60)])

    assert found[-1] == (ACCEPTED,)


def test_acceptance_is_taken_back_when_the_evidence_turns() -> None:
    strong: list[Seen] = [(600.0, 140.0, 0.8, "unknown")]
    weak: list[Seen] = [(600.0, 140.0, 0.1, "unknown")]
    found = decided([strong] * 5 + [weak] * 30 + [strong] * 10)

    assert found[4] == found[8] == found[-1] == (ACCEPTED,)
    assert found[30] == (TOO_LITTLE_EVIDENCE,)


def test_light_is_followed_through_rare_pictures_without_odometry() -> None:
    """At 1 Hz a light grows by a fifth and moves by two of its heights between two pictures."""
    one = ControlTracks(car())
    said: list[object] = []
    for i in range(6):
        (found,) = [frame([(600.0 + 60.0 * i, 300.0 - 20.0 * i, 0.8, "unknown")])]
        grown = found.boxes_px + 15.0 * 0.2 * i * np.array([-0.4, -1.0, 0.4, 1.0])
        (now,) = one([replace(found, boxes_px=grown)], STEP._replace(seconds=1.0))
        said += now.decisions

    assert said == [TOO_LITTLE_EVIDENCE] * 2 + [ACCEPTED] * 4


def test_dark_housing_needs_more_frames_than_a_lit_one() -> None:
    first = {}
    for lens in ("red", "unknown", "dark"):
        found = decided([[(600.0, 140.0, 0.4, lens), (900.0, 140.0, 0.9, "red")]] * 40)
        first[lens] = [one for one, _ in found].index(ACCEPTED)

    assert first["red"] < first["unknown"] < first["dark"]


def test_dark_light_needs_no_lit_one_beside_it() -> None:
    # In shade and from afar, lenses are dark in most pictures: of a queue, in all.
    assert decided([[(600.0, 140.0, 0.9, "dark")]] * 40)[-1] == (ACCEPTED,)


def test_at_one_score_small_and_long_boxes_are_more_evidence_whichever_way_they_lie() -> None:
    tracks, half = ControlTracks(car()), 0.5 * CORNERS
    places = np.array([[200.0, 100.0], [400.0, 100.0], [600.0, 100.0], [900.0, 150.0]])
    sizes = np.array([[12.0, 30.0], [30.0, 12.0], [30.0, 30.0], [80.0, 200.0]])
    boxes_px = np.hstack([places, places]) + half * np.hstack([sizes, sizes])
    for i in range(60):
        one = frame([(x, y, 0.45, "unknown") for x, y in places.tolist()])
        (said,) = tracks([replace(one, boxes_px=boxes_px + 0.01 * i)], STEP)

    assert said.decisions == (ACCEPTED, ACCEPTED, TOO_LITTLE_EVIDENCE, TOO_LITTLE_EVIDENCE)


def test_flare_far_below_the_horizon_is_no_light() -> None:
    looks_up = car("[camera]\nfocal_px = 1280.0\npitch_rad = -0.1\n")
    below, above = [(600.0, 640.0, 0.9, "green")], [(600.0, 590.0, 0.9, "green")]

    assert set(decided([below] * 40)) == {(BELOW_HORIZON,)}
    assert decided([above] * 40)[-1] == (ACCEPTED,)
    assert decided([below] * 40, vehicle=looks_up)[-1] == (ACCEPTED,)


@pytest.mark.parametrize(
    ("look", "why"),
    [
        ("bar", "looks like another sign: a white bar"),
        ("orange", "looks like another sign: orange"),
        ("yellow", "looks like another sign: yellow"),
        ("pale", "looks like another sign: not red"),
        ("plain", "looks like another sign: no white letters"),
    ],
)
def test_sign_that_looks_like_another_one_is_rejected_with_the_reason(look: str, why: str) -> None:
    found = decided([[(600.0, 140.0, 0.95, look)]] * 100, SIGN)
    mostly = [(600.0, 140.0, 0.95, look if i % 3 else "unknown") for i in range(100)]

    assert set(found) == {(why,)}
    assert decided([[one] for one in mostly], SIGN)[-1] == (why,)
    assert decided([[(600.0, 140.0, 0.95, "stop")]] * 4, SIGN)[-1] == (ACCEPTED,)
    assert decided([[(600.0, 140.0, 0.95, "unknown")]] * 4, SIGN)[-1] == (ACCEPTED,)


def test_light_on_a_yellow_sign_is_rejected_and_one_look_is_not_enough() -> None:
    def said(looks: list[str]) -> list[str]:
        tracks, decisions = ControlTracks(car()), list[str]()
        for i, look in enumerate(looks):
            (one,) = [frame([(600.0, 140.0, 0.7, "red")], jitter=0.01 * i)]
            decisions += tracks([replace(one, looks=(look,))], STEP)[0].decisions
        return decisions

    assert set(said(["yellow"] * 30)) == {"looks like another sign: yellow"}
    assert said(["", "", "yellow"] * 10)[-1] == ACCEPTED


def test_near_look_at_a_sign_counts_more_than_far_ones() -> None:
    """At night, letters of 8 px run together to a bar; nearer, they are letters."""
    tracks, said = ControlTracks(car()), list[str]()
    for i in range(16):
        side_px = 24.0 * 1.06**i
        one = frame([(600.0, 140.0, 0.9, "bar" if i < 9 else "stop")], SIGN)
        boxes_px = np.array([[600.0, 140.0, 600.0, 140.0]]) + 0.5 * side_px * CORNERS
        said += tracks([replace(one, boxes_px=boxes_px)], STEP)[0].decisions

    assert said[8] == "looks like another sign: a white bar"
    assert said[-1] == ACCEPTED


def test_cue_counts_accepted_tracks_and_the_rest_is_accounted_for() -> None:
    vehicle = car()
    cues = CuePass(vehicle)
    counts = []
    for i in range(20):
        seen = frame(
            [(600.0, 140.0, 0.4, "unknown"), (900.0, 200.0, 0.12, "dark")], jitter=0.01 * i
        )
        counts.append(cues(FrameDetections(i * 10**8, (seen,))).counts["traffic_light"])

    assert counts[0] == 0
    assert counts[-1] == 1
    found = cues.candidates["traffic_light"]
    assert (found.seen, found.used) == (40, sum(counts))
    assert found.skipped == {TOO_LITTLE_EVIDENCE: 40 - sum(counts)}


@pytest.mark.parametrize(
    ("text", "kind"),
    [
        ("", "tracks"),
        ("[cues]\ntraffic_light_score = 0.6\n", "frames"),
        ("[cues]\nstop_sign_score = 0.6\n", "frames"),
        ("[cues]\nkind = 'tracks'\nstop_sign_score = 0.6\n", "tracks"),
        ("name = 'crosscue simulated car'\n", "frames"),
    ],
)
def test_published_rule_decides_every_frame_by_itself(text: str, kind: str) -> None:
    vehicle = car(text)
    seen = frame([(600.0, 140.0, 0.95, "unknown")])

    assert vehicle.cues.kind == kind
    (said,) = ControlTracks(vehicle)([seen], STEP)
    assert (said is seen) == (kind == "frames")


def test_other_labels_are_left_to_their_score() -> None:
    both = frame([(600.0, 140.0, 0.95, "unknown"), (200.0, 400.0, 0.95, "")])
    both = replace(both, labels=(LIGHT, "car"))

    (said,) = ControlTracks(car())([both], STEP)

    assert said.decisions == (TOO_LITTLE_EVIDENCE, "")
    assert said.are_sure(None).tolist() == [False, True]


BGR = {"red": (40, 30, 230), "yellow": (20, 180, 240), "green": (200, 230, 60)}
WALL = (150, 180, 205)
BOX = np.array([20.0, 10.0, 44.0, 62.0])


def housing(lit: str | None, at: int = 0) -> Bytes:
    """Draw a dark housing of three lenses in front of a pale wall."""
    picture = np.full((80, 64, 3), WALL, np.uint8)
    picture[10:62, 20:44] = (45, 40, 38)
    for i in range(3):
        colour = BGR[lit] if lit is not None and i == at else (60, 50, 55)
        cv2.circle(picture, (32, 18 + 18 * i), 7, colour, -1)
    return picture


@pytest.mark.parametrize(("colour", "at"), [("red", 0), ("yellow", 1), ("green", 2)])
def test_lit_lens_is_found_at_each_position(colour: str, at: int) -> None:
    assert lens_of(housing(colour, at), BOX) == colour


@pytest.mark.parametrize(
    ("hue", "lens"),
    [(5, "red"), (170, "red"), (20, "yellow"), (75, "green"), (40, "dark"), (130, "dark")],
)
def test_colour_of_a_lens_is_that_of_its_hue(hue: int, lens: Lens) -> None:
    picture = housing(None)
    lit = np.full((1, 1, 3), (hue, 200, 220), np.uint8)
    colour = cv2.cvtColor(lit, cv2.COLOR_HSV2BGR)[0, 0].tolist()
    cv2.circle(picture, (32, 36), 7, colour, -1)

    assert lens_of(picture, BOX) == lens


@pytest.mark.parametrize(
    ("frame", "box", "lens"),
    [
        (0, (722, 292, 744, 339), "dark"),
        (0, (932, 365, 948, 397), "green"),
        (60, (660, 234, 686, 289), "dark"),
        (60, (766, 329, 782, 363), "red"),
        (79, (264, 282, 283, 330), "dark"),
        (79, (572, 182, 608, 256), "dark"),
        (79, (732, 320, 755, 366), "red"),
        (79, (919, 330, 941, 375), "green"),
    ],
)
def test_lenses_of_a_real_intersection_match_manual_labels(
    frame: int, box: tuple[int, int, int, int], lens: Lens
) -> None:
    folder = shared("sequences/pandaset_002") / "camera/front_camera"
    picture = np.asarray(cv2.imread(str(folder / f"{frame:02d}.jpg")), np.uint8)

    assert lens_of(picture, np.array(box, np.float64)) == lens


def test_small_grey_or_outside_box_has_an_unknown_lens() -> None:
    picture = housing("red")

    assert lens_of(picture, BOX * 0.2) == "unknown"
    assert lens_of(picture[:, :, 0].copy(), BOX) == "unknown"
    assert lens_of(picture[:, :, :1].repeat(3, axis=2), BOX) == "unknown"
    assert lens_of(picture, BOX + 200.0) == "unknown"
