"""Simulate one drive of a study, and replay it from its log."""

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
    """A simulated drive, its log and its replay; the repr includes the replay's errors.

    Attributes:
        made: The simulated drive, its files, its replay and its score.
        picture: Drawing of the drive.
        recording: Rerun recording of the replay, with the true track.
    """

    made: Replayed
    picture: Path
    recording: Path

    @property
    def is_whole(self) -> bool:
        """True if nothing of the log was dropped."""
        return self.made.is_whole

    def as_dict(self) -> dict[str, object]:
        """Return the JSON output of ``crosscue study drive``."""
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
            f"\nreplay of its log, compared with the truth\n{pose_summary(self.made.score)}\n"
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
    """Simulate one drive of a study, write its log, and replay, score, draw and record it.

    A study's ``drives.parquet`` contains the seed of each drive.

    Args:
        folder: Output folder for log, truth, picture and run.
        seed: Seed of all random numbers.
        compass_2sigma_deg: 2-sigma error of the compass; None for no compass.
        strategy: ``straight to goal``, ``landmark to landmark`` or ``hybrid``.
        landmarks_per_km2: Density of landmarks.
        detection_rate: Probability that a landmark in view is recognised.
        overwrite: Replace an earlier drive.

    Raises:
        UsageError: A value is out of range.
        OutputError: The folder already contains a drive, or cannot be written.
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
