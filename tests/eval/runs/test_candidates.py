"""Sentences on detections that were used neither for a cue nor for a range."""

from crosscue.eval.runs.candidates import CandidateRow, candidate_lines


def _row(seen: int, skipped: dict[str, int], **more: object) -> CandidateRow:
    content = {
        "unit": "detections",
        "setting": "[cues] traffic_light_score",
        "threshold": 0.9,
        "seen": seen,
        "used": seen - sum(skipped.values()),
        "skipped": skipped,
        "max_score": 0.62 if seen else None,
        **more,
    }
    return CandidateRow.model_validate(content)


def test_unreached_threshold_is_reported_with_highest_score() -> None:
    (line,) = candidate_lines({"traffic_light": _row(87, {"below score": 87})}, {})

    assert line == (
        "traffic_light: 87 detections, none above 0.90 (highest 0.62); "
        "see crosscue fit detector, or lower [cues] traffic_light_score"
    )


def test_road_cue_is_reported_only_if_it_was_never_used() -> None:
    road = {"unit": "frames", "setting": "[cues] road_fraction", "threshold": 0.2}
    never = _row(8, {"too little road": 8}, **{**road, "max_score": 0.13})
    lines = candidate_lines(
        {"road_left": never, "road_right": _row(8, {"too little road": 3}, **road)}, {}
    )

    assert lines == [
        "road_left: 8 frames with road, none above 0.20 (highest 0.13); lower [cues] road_fraction"
    ]
