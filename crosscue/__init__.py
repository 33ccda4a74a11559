"""Replay a recorded drive, score every cue and the pose, and see it in Rerun.

What ``__all__`` lists is the public interface: stable, and in the changelog when it changes. Each
name is imported when it is first used, so ``import crosscue`` costs nothing.

The six packages ``replay``, ``detectors``, ``fusion``, ``localization``, ``datasets`` and ``eval``
lie at the top of the repository and are linked here, so that only ``crosscue`` is ever installed.
"""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Final

_LINKED: Final = ("replay", "detectors", "fusion", "localization", "datasets", "eval")


def _broken_links(folder: Path) -> list[str]:
    """Names of linked packages that are no folders here."""
    return [name for name in _LINKED if not (folder / name).is_dir()]


if _missing := _broken_links(Path(__file__).parent):
    raise ImportError(
        f"crosscue/{_missing[0]} is not a folder: this checkout has no symbolic links (a Windows "
        "checkout, or a zip download unpacked without them); expected links to the folders beside "
        "crosscue/; try 'git config core.symlinks true' and 'git checkout -- crosscue', or "
        "'pip install' a wheel"
    )

_EXPORTS: Final = {
    "open": "eval.interface.logs",
    "Log": "eval.interface.logs",
    "Topics": "eval.interface.logs",
    "LogTopic": "eval.interface.logs",
    "CameraFrame": "eval.interface.logs",
    "Signals": "eval.interface.logs",
    "DriveSummary": "eval.interface.summary",
    "Run": "eval.interface.runs",
    "ScoredRun": "eval.interface.runs",
    "open_run": "eval.interface.runs",
    "replay_drive": "eval.interface.runs",
    "detect_drive": "eval.interface.runs",
    "estimate_run": "eval.interface.runs",
    "score_run": "eval.interface.runs",
    "compare_runs": "eval.interface.runs",
    "save_recording": "eval.interface.runs",
    "load_vehicle": "eval.interface.runs",
    "demo": "eval.interface.demo",
    "Demo": "eval.interface.demo",
    "fetch_drive": "eval.interface.demo",
    "KnownDrive": "eval.interface.demo",
    "default_cache": "detectors.result_cache",
    "simulate_approach": "eval.interface.simulate",
    "simulate_drive": "eval.interface.simulate",
    "draw_sign": "eval.interface.simulate",
    "StudyResult": "eval.interface.studies",
    "run_study": "eval.interface.studies",
    "RangeStudy": "eval.studies.town.settings",
    "LandmarkStudy": "eval.studies.town.settings",
    "SignFit": "eval.fit.sign_threshold",
    "fit_signs": "eval.fit.sign_threshold",
    "Detector": "detectors.base",
    "Detections": "detectors.base",
    "Frame": "detectors.base",
    "View": "detectors.base",
    "nothing_found": "detectors.base",
    "Settings": "detectors.settings",
    "settings_of": "detectors.settings",
    "identity_of": "detectors.settings",
    "Vehicle": "replay.vehicle.vehicle",
    "plugins": "eval.interface.plugins",
    "CueSpec": "replay.vehicle.cue_spec",
    "Format": "replay.formats",
    "DataSet": "replay.formats",
    "PluginWarning": "replay.plugins",
    "CrosscueError": "replay.errors",
    "UsageError": "replay.errors",
    "LogError": "replay.errors",
    "LogFormatError": "replay.errors",
    "LogTooLargeError": "replay.errors",
    "UnknownFormatError": "replay.errors",
    "SchemaError": "replay.errors",
    "VehicleError": "replay.errors",
    "MissingTopicError": "replay.errors",
    "RunError": "replay.errors",
    "OutputError": "replay.errors",
    "EmptyResultError": "replay.errors",
    "AccountError": "replay.errors",
    "LossWarning": "replay.losses",
    "convert": "eval.interface.convert",
    "Converted": "eval.interface.convert",
    "seal": "eval.interface.seals",
    "check_seal": "eval.interface.seals",
    "Sealed": "eval.interface.seals",
    "Seals": "eval.interface.seals",
    "SealCheck": "eval.interface.seals",
    "SealChecks": "eval.interface.seals",
    "decode": "eval.interface.tables",
    "merge": "eval.interface.tables",
    "MergedRuns": "eval.interface.tables",
    "Decoded": "eval.catalog.decoded_logs",
    "write_truth": "eval.interface.truth",
    "truth_schema": "eval.interface.truth",
    "draft_vehicle": "eval.interface.vehicles",
    "VehicleDraft": "eval.interface.vehicles",
    "run_schema": "eval.interface.runs",
    "Comparison": "eval.catalog.compare",
    "check_truth": "eval.fit.truth_check",
    "import_truth": "eval.fit.truth_check",
    "TruthFit": "eval.fit.truth_check",
    "ImportedTruth": "eval.fit.truth_check",
    "score_runs": "eval.interface.scores",
    "ScoredRuns": "eval.interface.scores",
    "simulate_approaches": "eval.interface.simulate",
    "SimulatedDrives": "eval.interface.simulate",
    "draw_contact_sheet": "eval.interface.simulate",
    "SceneFiles": "datasets.scenes.drive",
    "add_landmarks": "eval.interface.landmarks",
    "add_landmark_images": "eval.interface.landmarks",
    "AddedLandmarks": "eval.interface.landmarks",
    "list_landmarks": "eval.interface.landmarks",
    "LandmarkList": "eval.interface.landmarks",
    "match_landmarks": "eval.interface.landmarks",
    "LandmarkMatches": "eval.interface.landmarks",
    "fit_compass": "eval.interface.fits.compass",
    "FittedCompass": "eval.interface.fits.compass",
    "fit_landmarks": "eval.interface.fits.landmarks",
    "FittedLandmarks": "eval.interface.fits.landmarks",
    "fit_messages": "eval.interface.fits.messages",
    "FittedMessages": "eval.interface.fits.messages",
    "fit_ranges": "eval.interface.fits.ranges",
    "FittedRanges": "eval.interface.fits.ranges",
    "run_field_study": "eval.interface.studies",
    "FieldResult": "eval.interface.studies",
    "calibrate_study": "eval.interface.studies",
    "FieldStudy": "eval.studies.town.settings",
    "run_study_drive": "eval.interface.study_drive",
    "StudyDrive": "eval.interface.study_drive",
    "models": "eval.interface.models",
    "Models": "eval.interface.models",
    "model": "eval.interface.models",
    "Model": "eval.interface.models",
    "fetch_model": "eval.interface.models",
    "FetchedModel": "eval.interface.models",
    "draft_card": "eval.interface.cards",
    "CardDraft": "eval.interface.cards",
    "check_card": "eval.interface.cards",
    "CardCheck": "eval.interface.cards",
    "find_drives": "eval.interface.batch",
    "DriveList": "eval.batch.drive_list",
    "replay_drives": "eval.interface.batch",
    "ReplayedDrives": "eval.interface.batch",
    "render_training_frames": "eval.interface.training",
    "TrainingFrames": "eval.interface.training",
    "run_intersection_study": "eval.interface.intersections",
    "IntersectionResult": "eval.interface.intersections",
    "IntersectionStudy": "eval.studies.intersections.study",
}
"""From a public name to its module."""

__all__ = [*_EXPORTS]

if TYPE_CHECKING:
    from crosscue.datasets.scenes.drive import SceneFiles as SceneFiles
    from crosscue.detectors.base import Detections as Detections
    from crosscue.detectors.base import Detector as Detector
    from crosscue.detectors.base import Frame as Frame
    from crosscue.detectors.base import View as View
    from crosscue.detectors.base import nothing_found as nothing_found
    from crosscue.detectors.result_cache import default_cache as default_cache
    from crosscue.detectors.settings import Settings as Settings
    from crosscue.detectors.settings import identity_of as identity_of
    from crosscue.detectors.settings import settings_of as settings_of
    from crosscue.eval.batch.drive_list import DriveList as DriveList
    from crosscue.eval.catalog.compare import Comparison as Comparison
    from crosscue.eval.catalog.decoded_logs import Decoded as Decoded
    from crosscue.eval.fit.sign_threshold import SignFit as SignFit
    from crosscue.eval.fit.sign_threshold import fit_signs as fit_signs
    from crosscue.eval.fit.truth_check import ImportedTruth as ImportedTruth
    from crosscue.eval.fit.truth_check import TruthFit as TruthFit
    from crosscue.eval.fit.truth_check import check_truth as check_truth
    from crosscue.eval.fit.truth_check import import_truth as import_truth
    from crosscue.eval.interface.batch import ReplayedDrives as ReplayedDrives
    from crosscue.eval.interface.batch import find_drives as find_drives
    from crosscue.eval.interface.batch import replay_drives as replay_drives
    from crosscue.eval.interface.cards import CardCheck as CardCheck
    from crosscue.eval.interface.cards import CardDraft as CardDraft
    from crosscue.eval.interface.cards import check_card as check_card
    from crosscue.eval.interface.cards import draft_card as draft_card
    from crosscue.eval.interface.convert import Converted as Converted
    from crosscue.eval.interface.convert import convert as convert
    from crosscue.eval.interface.demo import Demo as Demo
    from crosscue.eval.interface.demo import KnownDrive as KnownDrive
    from crosscue.eval.interface.demo import demo as demo
    from crosscue.eval.interface.demo import fetch_drive as fetch_drive
    from crosscue.eval.interface.fits.compass import FittedCompass as FittedCompass
    from crosscue.eval.interface.fits.compass import fit_compass as fit_compass
    from crosscue.eval.interface.fits.landmarks import FittedLandmarks as FittedLandmarks
    from crosscue.eval.interface.fits.landmarks import fit_landmarks as fit_landmarks
    from crosscue.eval.interface.fits.messages import FittedMessages as FittedMessages
    from crosscue.eval.interface.fits.messages import fit_messages as fit_messages
    from crosscue.eval.interface.fits.ranges import FittedRanges as FittedRanges
    from crosscue.eval.interface.fits.ranges import fit_ranges as fit_ranges
    from crosscue.eval.interface.intersections import IntersectionResult as IntersectionResult
    from crosscue.eval.interface.intersections import (
        run_intersection_study as run_intersection_study,
    )
    from crosscue.eval.interface.landmarks import AddedLandmarks as AddedLandmarks
    from crosscue.eval.interface.landmarks import LandmarkList as LandmarkList
    from crosscue.eval.interface.landmarks import LandmarkMatches as LandmarkMatches
    from crosscue.eval.interface.landmarks import add_landmark_images as add_landmark_images
    from crosscue.eval.interface.landmarks import add_landmarks as add_landmarks
    from crosscue.eval.interface.landmarks import list_landmarks as list_landmarks
    from crosscue.eval.interface.landmarks import match_landmarks as match_landmarks
    from crosscue.eval.interface.logs import CameraFrame as CameraFrame
    from crosscue.eval.interface.logs import Log as Log
    from crosscue.eval.interface.logs import LogTopic as LogTopic
    from crosscue.eval.interface.logs import Signals as Signals
    from crosscue.eval.interface.logs import Topics as Topics
    from crosscue.eval.interface.logs import open as open  # noqa: A004
    from crosscue.eval.interface.models import FetchedModel as FetchedModel
    from crosscue.eval.interface.models import Model as Model
    from crosscue.eval.interface.models import Models as Models
    from crosscue.eval.interface.models import fetch_model as fetch_model
    from crosscue.eval.interface.models import model as model
    from crosscue.eval.interface.models import models as models
    from crosscue.eval.interface.plugins import plugins as plugins
    from crosscue.eval.interface.runs import Run as Run
    from crosscue.eval.interface.runs import ScoredRun as ScoredRun
    from crosscue.eval.interface.runs import compare_runs as compare_runs
    from crosscue.eval.interface.runs import detect_drive as detect_drive
    from crosscue.eval.interface.runs import estimate_run as estimate_run
    from crosscue.eval.interface.runs import load_vehicle as load_vehicle
    from crosscue.eval.interface.runs import open_run as open_run
    from crosscue.eval.interface.runs import replay_drive as replay_drive
    from crosscue.eval.interface.runs import run_schema as run_schema
    from crosscue.eval.interface.runs import save_recording as save_recording
    from crosscue.eval.interface.runs import score_run as score_run
    from crosscue.eval.interface.scores import ScoredRuns as ScoredRuns
    from crosscue.eval.interface.scores import score_runs as score_runs
    from crosscue.eval.interface.seals import SealCheck as SealCheck
    from crosscue.eval.interface.seals import SealChecks as SealChecks
    from crosscue.eval.interface.seals import Sealed as Sealed
    from crosscue.eval.interface.seals import Seals as Seals
    from crosscue.eval.interface.seals import check_seal as check_seal
    from crosscue.eval.interface.seals import seal as seal
    from crosscue.eval.interface.simulate import SimulatedDrives as SimulatedDrives
    from crosscue.eval.interface.simulate import draw_contact_sheet as draw_contact_sheet
    from crosscue.eval.interface.simulate import draw_sign as draw_sign
    from crosscue.eval.interface.simulate import simulate_approach as simulate_approach
    from crosscue.eval.interface.simulate import simulate_approaches as simulate_approaches
    from crosscue.eval.interface.simulate import simulate_drive as simulate_drive
    from crosscue.eval.interface.studies import FieldResult as FieldResult
    from crosscue.eval.interface.studies import StudyResult as StudyResult
    from crosscue.eval.interface.studies import calibrate_study as calibrate_study
    from crosscue.eval.interface.studies import run_field_study as run_field_study
    from crosscue.eval.interface.studies import run_study as run_study
    from crosscue.eval.interface.study_drive import StudyDrive as StudyDrive
    from crosscue.eval.interface.study_drive import run_study_drive as run_study_drive
    from crosscue.eval.interface.summary import DriveSummary as DriveSummary
    from crosscue.eval.interface.tables import MergedRuns as MergedRuns
    from crosscue.eval.interface.tables import decode as decode
    from crosscue.eval.interface.tables import merge as merge
    from crosscue.eval.interface.training import TrainingFrames as TrainingFrames
    from crosscue.eval.interface.training import render_training_frames as render_training_frames
    from crosscue.eval.interface.truth import truth_schema as truth_schema
    from crosscue.eval.interface.truth import write_truth as write_truth
    from crosscue.eval.interface.vehicles import VehicleDraft as VehicleDraft
    from crosscue.eval.interface.vehicles import draft_vehicle as draft_vehicle
    from crosscue.eval.studies.intersections.study import IntersectionStudy as IntersectionStudy
    from crosscue.eval.studies.town.settings import FieldStudy as FieldStudy
    from crosscue.eval.studies.town.settings import LandmarkStudy as LandmarkStudy
    from crosscue.eval.studies.town.settings import RangeStudy as RangeStudy
    from crosscue.replay.errors import AccountError as AccountError
    from crosscue.replay.errors import CrosscueError as CrosscueError
    from crosscue.replay.errors import EmptyResultError as EmptyResultError
    from crosscue.replay.errors import LogError as LogError
    from crosscue.replay.errors import LogFormatError as LogFormatError
    from crosscue.replay.errors import LogTooLargeError as LogTooLargeError
    from crosscue.replay.errors import MissingTopicError as MissingTopicError
    from crosscue.replay.errors import OutputError as OutputError
    from crosscue.replay.errors import RunError as RunError
    from crosscue.replay.errors import SchemaError as SchemaError
    from crosscue.replay.errors import UnknownFormatError as UnknownFormatError
    from crosscue.replay.errors import UsageError as UsageError
    from crosscue.replay.errors import VehicleError as VehicleError
    from crosscue.replay.formats import DataSet as DataSet
    from crosscue.replay.formats import Format as Format
    from crosscue.replay.losses import LossWarning as LossWarning
    from crosscue.replay.plugins import PluginWarning as PluginWarning
    from crosscue.replay.vehicle.cue_spec import CueSpec as CueSpec
    from crosscue.replay.vehicle.vehicle import Vehicle as Vehicle
else:

    def __getattr__(name: str) -> object:
        """Import a public name when it is first asked for."""
        if name not in _EXPORTS:
            raise AttributeError(f"module 'crosscue' has no attribute {name!r}")
        found = getattr(import_module(f"crosscue.{_EXPORTS[name]}"), name)
        globals()[name] = found
        return found

    def __dir__() -> list[str]:
        return sorted({*globals(), *__all__})
