"""Fit the threshold of landmark matches to labelled pictures."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from crosscue.eval.fit.landmarks.database import frames_of, read_poses
from crosscue.eval.fit.landmarks.pairs import pairs_of_drive, pairs_of_table, with_min_score
from crosscue.eval.interface.fits.vehicle_output import check_output, write_fit
from crosscue.eval.logs.log import Log, UnopenedLog, opened
from crosscue.eval.pipeline.landmarks import matcher_for, open_for
from crosscue.localization.landmarks.fit import fit_landmarks as fit_threshold
from crosscue.replay.base import SchemaError, UsageError
from crosscue.replay.vehicle.vehicle import Vehicle, vehicle_given

if TYPE_CHECKING:
    from crosscue.localization.landmarks.fit import LandmarkFit, Rate, ScoredPairs


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class FittedLandmarks:
    """A fitted match threshold and its rates.

    Attributes:
        fitted: The threshold, and the rates on both halves of the pictures.
        matcher: Matcher that the threshold is for.
        path: Vehicle file that was written; None without one.
    """

    fitted: LandmarkFit
    matcher: str
    path: Path | None

    def as_dict(self) -> dict[str, object]:
        """Return the JSON output of ``crosscue fit landmarks``."""
        return {
            **asdict(self.fitted),
            "is_shown": self.fitted.is_shown,
            "matcher": self.matcher,
        }

    def __repr__(self) -> str:
        fitted = self.fitted
        lines = [
            f"threshold   min_score = {fitted.min_score:g} for a false-match rate of "
            f"{fitted.wanted_rate:g}",
            "",
            "                       fitted                        held out",
        ]
        for name, fit, held in (
            ("false matches", fitted.fitted_false, fitted.held_out_false),
            ("places found", fitted.fitted_found, fitted.held_out_found),
        ):
            lines.append(f"{name:14} {_rate(fit):>29} {_rate(held):>31}")
        if not fitted.is_shown:
            lines += [
                "",
                f"the {fitted.held_out_false.of} held-out pairs cannot show a rate of "
                f"{fitted.wanted_rate:g}: it may be up to {fitted.held_out_false.high:.2g}",
            ]
        if self.path is not None:
            lines.append(f"written to {self.path}")
        return "\n".join(lines)


def _rate(rate: Rate) -> str:
    return f"{rate.hits} of {rate.of} ({rate.low:.2g} to {rate.high:.2g})"


def fit_landmarks(
    pairs: Path | str | None = None,
    log: Log | UnopenedLog | Path | str | None = None,
    database: Path | str | None = None,
    poses: Path | str | None = None,
    vehicle: Vehicle | Path | str | None = None,
    output: Path | str | None = None,
    *,
    false_match_rate: float = 0.001,
    every_m: float = 5.0,
    same_within_m: float = 5.0,
    different_beyond_m: float = 50.0,
    max_landmarks: int = 50,
    matcher: str | None = None,
    overwrite: bool = False,
) -> FittedLandmarks:
    """Choose the match threshold for a required false-match rate, from labelled pictures.

    The threshold is chosen on half of the query pictures, and the rates are measured on the other
    half. Pairs are read from a table, or are made from a drive with known poses and a database from
    another drive.

    Args:
        pairs: CSV file ``query,known,same``, instead of ``log``, ``database`` and ``poses``.
        log: The drive, or its path.
        database: Landmark database made from another drive.
        poses: Poses of the drive: a run, or a truth file.
        vehicle: Vehicle file with the camera and the matcher; None for the defaults.
        output: Vehicle file to write, with the threshold; may be ``vehicle`` itself.
        false_match_rate: Max fraction of pairs from different places that may match.
        every_m: Distance between the frames used.
        same_within_m: Max distance of a landmark of the same place.
        different_beyond_m: Min distance of a landmark of another place.
        max_landmarks: Max number of landmarks per frame.
        matcher: ``orb``, or ``module:factory``; default: the vehicle file's.
        overwrite: Replace another existing file.

    Raises:
        UsageError: Neither pairs nor a drive are passed, or values contradict each other.
        SchemaError: There are too few pairs.
        OutputError: The output exists, or cannot be written.
    """
    check_output(vehicle, output, overwrite=overwrite)
    if max_landmarks < 1:
        raise UsageError(f"--max-landmarks {max_landmarks}: expected 1 or more")
    if same_within_m >= different_beyond_m:
        raise UsageError(
            f"--same-within {same_within_m:g}: expected less than --different-beyond "
            f"{different_beyond_m:g}"
        )
    settings = vehicle_given(vehicle)
    comparing = matcher_for(settings, matcher)

    def of_drive(log: Log | UnopenedLog | Path | str, database: Path, poses: Path) -> ScoredPairs:
        known = read_poses(poses, settings)
        with (
            open_for(database, comparing) as marks,
            opened(log) as drive,
            frames_of(drive, settings) as (frames, ledgers),
        ):
            return pairs_of_drive(
                frames,
                known,
                marks,
                comparing,
                every_m,
                same_within_m,
                different_beyond_m,
                max_landmarks,
                ledgers,
            )

    if pairs is not None and log is None and database is None and poses is None:
        scored = pairs_of_table(Path(pairs), comparing)
    elif pairs is None and log is not None and database is not None and poses is not None:
        scored = of_drive(log, Path(database), Path(poses))
    else:
        raise UsageError("fit landmarks: expected --pairs, or LOG... with --database and --poses")
    try:
        fitted = fit_threshold(scored, false_match_rate)
    except ValueError as error:
        raise SchemaError(f"fit landmarks: {error}; use more labelled pictures") from None
    path = write_fit(vehicle, output, lambda text: with_min_score(text, fitted.min_score))
    return FittedLandmarks(fitted, comparing.kind, path)
