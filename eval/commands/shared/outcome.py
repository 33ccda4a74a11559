"""What replaying or estimating a drive printed: for a person, and for other programs."""

from __future__ import annotations

from dataclasses import asdict

from crosscue.eval.pipeline.outcome import ApproachSummary, Outcome, SceneOutcome
from crosscue.eval.runs.account import account_lines, details_of
from crosscue.eval.runs.candidates import candidate_lines, candidate_rows, not_looked_lines
from crosscue.replay.base import Ledger
from crosscue.replay.safe_text import terminal_width, visible, wrapped


def summary(outcome: Outcome) -> str:
    """What happened, for a person, in 80 columns."""
    lines = [f"run      {outcome.run.path}"]
    for log in outcome.account.reading:
        lines.append(f"log      {log.log}")
        lines.append(f"         integrity: {log.integrity}")
        lines += [f"  note   {sentence}" for sentence in log.notices]
    lines += [*account_lines(outcome.account), *details_of(_ledgers(outcome))]
    if outcome.rows:
        lines += [
            f"pose     {outcome.rows:,} rows over {outcome.travelled_m:.0f} m in "
            f"{outcome.drive_seconds:.0f} s;",
            f"         2-sigma ellipse {outcome.major_axis_m:.1f} m long at the end",
        ]
    else:
        lines.append("pose     none")
    if outcome.detected is not None:
        lines += _detected(outcome)
    if outcome.scene is not None:
        lines += scene_lines(outcome.scene)
    if outcome.landmark_counts:
        lines.append(f"marks    {_landmarks(outcome.landmark_counts)}")
    lines += [f"  note   {sentence}" for sentence in outcome.notices]
    speed = outcome.drive_seconds / max(outcome.seconds, 1e-9)
    digits = 0 if speed >= 10 else 1
    lines.append(f"took     {outcome.seconds:.2f} s, {speed:.{digits}f} times real time")
    width = min(terminal_width(), 80)
    return "\n".join(
        wrapped(visible(line[9:]), width, lead=line[:9]) if len(line) > width else visible(line)
        for line in lines
    )


def _ledgers(outcome: Outcome) -> list[Ledger]:
    detected = () if outcome.detected is None else (outcome.detected.ledger,)
    return [*detected, *outcome.ledgers]


def _detected(outcome: Outcome) -> list[str]:
    assert outcome.detected is not None
    counts = outcome.detected.counts
    lines = [f"frames   {counts.frames:,} looked at"]
    for name, ran in counts.ran.items():
        lines.append(f"         {name}: ran on {ran:,}, {counts.from_cache[name]:,} from the cache")
    return lines


def scene_lines(scene: SceneOutcome) -> list[str]:
    """Cues and approaches, for a person."""
    seen = [f"{cue} {count:,}" for cue, count in scene.positive.items()]
    lines = [f"cues     {', '.join(seen) or 'none'} (frames each, of {scene.frames:,})"]
    rows = candidate_rows(scene.candidates), candidate_rows(scene.ranged)
    lines += [f"  skip   {sentence}" for sentence in candidate_lines(*rows)]
    lines += [f"  skip   {sentence}" for sentence in not_looked_lines(scene.not_looked_for)]
    lines += [f"  note   {n:,} x {what}" for what, n in scene.counts.items() if n]
    for one in scene.approaches:
        lines.append(f"approach {_approach(one)}")
    return lines


def _approach(one: ApproachSummary) -> str:
    said = ", ".join(f"{feature} {p:.2f}" for feature, p in one.probabilities.items())
    where = "not detected"
    if one.detected_m is not None:
        where = f"detected {one.detected_m:.1f} m before its {one.reference}"
    return f"{one.number}: {where}; at the end {said}"


def _landmarks(counts: dict[str, int]) -> str:
    looked = counts["frames"] - counts["thinned"] - counts["late"]
    return (
        f"{counts['accepted']} landmarks weighed in, {counts['gated']} refused by the gate; "
        f"{counts['matched']} of {looked} frames looked at matched one"
    )


def as_json(outcome: Outcome) -> dict[str, object]:
    """The result for other programs."""
    return {
        "run": str(outcome.run.path),
        "account": outcome.account.as_json(),
        "pose": {
            "rows": outcome.rows,
            "travelled_m": outcome.travelled_m,
            "major_axis_m": outcome.major_axis_m,
        },
        "landmarks": outcome.landmark_counts,
        "detected": None
        if outcome.detected is None
        else {
            "frames": outcome.detected.counts.frames,
            "ran": outcome.detected.counts.ran,
            "from_cache": outcome.detected.counts.from_cache,
            "objects": outcome.detected.objects,
        },
        "scene": None if outcome.scene is None else asdict(outcome.scene),
        "notices": list(outcome.notices),
        "seconds": outcome.seconds,
    }
