"""One simulated drive of a study, through its log."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

from crosscue.replay.base import UsageError

if TYPE_CHECKING:
    from crosscue.eval.studies.town.replayed import Replayed
    from crosscue.localization.town.settings import Drive

FLAGS: Final = {
    "compass_2sigma_deg": "compass",
    "detection_rate": "detection-rate",
    "landmarks_per_km2": "landmark-density",
    "strategy": "strategy",
}


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class StudyDrive:
    """A simulated drive, its log, and the replay of that; printed with the replay's errors.

    Attributes:
        made: The drive as simulated, its files, its replay and score.
        picture: The drive drawn.
        recording: The replay as a Rerun recording, the true track with it.
    """

    made: Replayed
    picture: Path
    recording: Path

    @property
    def is_whole(self) -> bool:
        """Nothing of the log was dropped."""
        return self.made.is_whole

    def as_dict(self) -> dict[str, object]:
        """What ``crosscue study drive --json`` prints."""
        return {
            "result": self.made.traced.result._asdict(),
            "log": str(self.made.files.log),
            "truth": str(self.made.files.truth),
            "picture": str(self.picture),
            "run": str(self.made.run.path),
            "recording": str(self.recording),
        }

    def __repr__(self) -> str:
        from crosscue.eval.report.summary import pose_summary

        result = self.made.traced.result
        return (
            f"simulated  {result.travelled_m:.0f} m in {result.seconds:.0f} s, "
            f"{result.decisions} decisions, {result.detected} landmarks used\n"
            f"\nthe replay of its log against the truth\n{pose_summary(self.made.score)}\n"
            f"\npicture    {self.picture}\nlog        {self.made.files.log}"
            f"\nrecording  {self.recording}"
        )


def run_study_drive(
    folder: Path | str,
    seed: int = 7,
    *,
    compass_2sigma_deg: float | None = 30.0,
    strategy: str = "straight to goal",
    landmarks_per_km2: float = 0.0,
    detection_rate: float = 0.6,
    overwrite: bool = False,
) -> StudyDrive:
    """Simulate one drive of a study, write its log, replay, score, draw and record it.

    The seed of any drive of a study is in its ``drives.parquet``.

    Args:
        folder: Gets log, truth, picture and run.
        seed: Everything random comes from it.
        compass_2sigma_deg: Error of the compass; None for no compass.
        strategy: ``straight to goal``, ``landmark to landmark`` or ``hybrid``.
        landmarks_per_km2: Density of landmarks.
        detection_rate: Probability that a landmark in view is recognised.
        overwrite: Replace an earlier drive.

    Raises:
        UsageError: A value out of range.
        OutputError: The folder holds a drive already, or cannot be written.
    """
    from crosscue.eval.recording import save
    from crosscue.eval.scoring.pose.score import truth_track
    from crosscue.eval.studies.town import drive_figure
    from crosscue.eval.studies.town.replayed import through_log

    place = Path(folder)
    if not 0 <= seed < 1 << 64:
        raise UsageError(f"--seed {seed}: expected 0 or more, below 2^64")
    settings = _settings(compass_2sigma_deg, strategy, landmarks_per_km2, detection_rate)
    made = through_log(place, settings, seed, overwrite=overwrite)
    picture = drive_figure.draw(settings, made.traced, seed, place)
    recording = made.run.file("drive.rrd")
    save(made.run, recording, truth_track(made.files.truth, made.run))
    return StudyDrive(made, picture, recording)


def _settings(
    compass_2sigma_deg: float | None, strategy: str, landmarks_per_km2: float, detection_rate: float
) -> Drive:
    from pydantic import ValidationError

    from crosscue.localization.town.settings import Drive, Navigation, Sensors

    try:
        return Drive(
            sensors=Sensors(compass_2sigma_deg=compass_2sigma_deg, detection_rate=detection_rate),
            navigation=Navigation.model_validate({"strategy": strategy}),
            landmarks_per_km2=landmarks_per_km2,
        )
    except ValidationError as error:
        first = error.errors()[0]
        flag = FLAGS[str(first["loc"][-1])]
        raise UsageError(f"--{flag} {first['input']}: {first['msg'].lower()}") from None
