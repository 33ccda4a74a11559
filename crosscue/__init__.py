"""Replay a recorded drive, score every cue and the pose, and view it in Rerun.

``__all__`` lists the public interface, whose changes are recorded in the changelog. Each name is
imported when it is first used, so ``import crosscue`` is fast.

The six packages ``replay``, ``detectors``, ``fusion``, ``localization``, ``datasets`` and ``eval``
are at the top of the repository and are linked here, so that only ``crosscue`` is installed.
"""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Final

_LINKED: Final = ("replay", "detectors", "fusion", "localization", "datasets", "eval")


def _broken_links(folder: Path) -> list[str]:
    """Return the names of linked packages that are not folders here."""
    return [name for name in _LINKED if not (folder / name).is_dir()]


if _missing := _broken_links(Path(__file__).parent):
    raise ImportError(
        f"crosscue/{_missing[0]} is not a folder: this checkout has no symbolic links (a Windows "
        "checkout, or a zip download unpacked without them); expected links to the folders next to "
        "crosscue/; try 'git config core.symlinks true' and 'git checkout -- crosscue', or "
        "'pip install' a wheel"
    )

_EXPORTS: Final = {
    "open": "eval.interface.logs.log",
    "Log": "eval.interface.logs.log",
    "Topics": "eval.interface.logs.log",
    "LogTopic": "eval.interface.logs.log",
    "CameraFrame": "eval.interface.logs.log",
    "Signals": "eval.interface.logs.log",
    "DriveSummary": "eval.interface.logs.summary",
    "Run": "eval.interface.runs.run",
    "ScoredRun": "eval.interface.runs.score",
    "open_run": "eval.interface.runs.run",
    "replay_drive": "eval.interface.runs.make",
    "detect_drive": "eval.interface.runs.make",
    "estimate_run": "eval.interface.runs.make",
    "score_run": "eval.interface.runs.score",
    "compare_runs": "eval.interface.runs.compare",
    "compare_many": "eval.interface.runs.compare",
    "tag_runs": "eval.interface.runs.tags",
    "TaggedRuns": "eval.interface.runs.tags",
    "history": "eval.interface.runs.history",
    "History": "eval.catalog.history",
    "catalog": "eval.catalog.query.catalog",
    "Catalog": "eval.catalog.query.catalog",
    "save_recording": "eval.interface.runs.recording",
    "failures": "eval.interface.failures.failures",
    "Failures": "eval.interface.failures.failures",
    "read_failures": "eval.interface.failures.failures",
    "Failure": "eval.failures.record",
    "browse": "eval.interface.failures.browse",
    "export": "eval.interface.failures.labels",
    "ExportedLabels": "eval.interface.failures.labels",
    "import_labels": "eval.interface.failures.labels",
    "ImportedLabels": "eval.interface.failures.labels",
    "Site": "eval.interface.failures.browse",
    "load_vehicle": "eval.interface.runs.run",
    "demo": "eval.interface.demo",
    "Demo": "eval.interface.demo",
    "fetch_drive": "eval.interface.demo",
    "KnownDrive": "eval.interface.demo",
    "default_cache": "detectors.result_cache",
    "simulate_approach": "eval.interface.simulate",
    "simulate_drive": "eval.interface.simulate",
    "draw_sign": "eval.interface.simulate",
    "StudyResult": "eval.interface.studies.town",
    "run_study": "eval.interface.studies.town",
    "RangeStudy": "eval.studies.town.settings",
    "LandmarkStudy": "eval.studies.town.settings",
    "SignFit": "eval.fit.signs.threshold",
    "fit_signs": "eval.fit.signs.threshold",
    "Detector": "detectors.base",
    "BoxDetector": "detectors.box_detector",
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
    "CanDatabaseError": "replay.errors",
    "AnnotationError": "replay.errors",
    "VehicleError": "replay.errors",
    "MissingTopicError": "replay.errors",
    "RunError": "replay.errors",
    "UnreadableRunError": "replay.errors",
    "OutputError": "replay.errors",
    "StudyFileError": "replay.errors",
    "WorkerError": "replay.errors",
    "EmptyResultError": "replay.errors",
    "AccountError": "replay.errors",
    "LossWarning": "replay.errors",
    "convert": "eval.interface.logs.convert",
    "Converted": "eval.interface.logs.convert",
    "seal": "eval.interface.logs.seals",
    "check_seal": "eval.interface.logs.seals",
    "Sealed": "eval.interface.logs.seals",
    "Seals": "eval.interface.logs.seals",
    "SealCheck": "eval.interface.logs.seals",
    "SealChecks": "eval.interface.logs.seals",
    "decode": "eval.interface.runs.tables",
    "merge": "eval.interface.runs.tables",
    "MergedRuns": "eval.interface.runs.tables",
    "Decoded": "eval.catalog.decoded_logs",
    "write_truth": "eval.interface.truth",
    "truth_from_gnss": "eval.interface.truth",
    "truth_schema": "eval.interface.truth",
    "draft_vehicle": "eval.interface.vehicles",
    "check_vehicle": "eval.interface.vehicles",
    "VehicleCheck": "eval.interface.vehicles",
    "VehicleDraft": "eval.interface.vehicles",
    "run_schema": "eval.interface.runs.run",
    "Comparison": "eval.catalog.compare",
    "check_truth": "eval.fit.truth_check",
    "import_truth": "eval.fit.truth_check",
    "TruthFit": "eval.fit.truth_check",
    "ImportedTruth": "eval.fit.truth_check",
    "score_runs": "eval.interface.runs.scores",
    "ScoredRuns": "eval.interface.runs.scores",
    "open_mlflow": "eval.interface.runs.tracking",
    "MlflowSink": "eval.interface.runs.tracking",
    "score_detector": "eval.interface.runs.detector_scores",
    "DetectorScore": "eval.interface.runs.detector_scores",
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
    "fit_odometry": "eval.interface.fits.odometry",
    "FittedOdometry": "eval.interface.fits.odometry",
    "fit_detector": "eval.interface.fits.detector",
    "FittedDetector": "eval.interface.fits.detector",
    "fit_landmarks": "eval.interface.fits.landmarks",
    "FittedLandmarks": "eval.interface.fits.landmarks",
    "fit_messages": "eval.interface.fits.messages",
    "FittedMessages": "eval.interface.fits.messages",
    "fit_temporal": "eval.interface.fits.temporal",
    "FittedTemporal": "eval.interface.fits.temporal",
    "fit_ranges": "eval.interface.fits.ranges",
    "FittedRanges": "eval.interface.fits.ranges",
    "run_field_study": "eval.interface.studies.town",
    "FieldResult": "eval.interface.studies.town",
    "calibrate_study": "eval.interface.studies.town",
    "FieldStudy": "eval.studies.town.settings",
    "run_study_drive": "eval.interface.studies.drive",
    "StudyDrive": "eval.interface.studies.drive",
    "models": "eval.interface.models.catalog",
    "Models": "eval.interface.models.catalog",
    "model": "eval.interface.models.catalog",
    "Model": "eval.interface.models.catalog",
    "fetch_model": "eval.interface.models.catalog",
    "FetchedModel": "eval.interface.models.catalog",
    "draft_card": "eval.interface.models.cards",
    "CardDraft": "eval.interface.models.cards",
    "check_card": "eval.interface.models.cards",
    "CardCheck": "eval.interface.models.cards",
    "find_drives": "eval.interface.runs.batch",
    "DriveList": "eval.batch.drive_list",
    "replay_drives": "eval.interface.runs.batch",
    "batch_status": "eval.interface.runs.status",
    "BatchStatus": "eval.interface.runs.status",
    "ReplayedDrives": "eval.interface.runs.batch",
    "render_training_frames": "eval.interface.training.frames",
    "TrainingFrames": "eval.interface.training.frames",
    "train_road": "eval.interface.training.road",
    "measure_road": "eval.interface.training.road",
    "RoadTrainingSettings": "eval.interface.training.road",
    "TrainedRoad": "eval.interface.training.road",
    "train_mask_rcnn": "eval.interface.training.mask_rcnn",
    "measure_mask_rcnn": "eval.interface.training.mask_rcnn",
    "MaskRcnnTrainingSettings": "eval.interface.training.mask_rcnn",
    "TrainedMaskRcnn": "eval.interface.training.mask_rcnn",
    "MeasuredMaskRcnn": "eval.interface.training.mask_rcnn",
    "run_intersection_study": "eval.interface.studies.intersections",
    "IntersectionResult": "eval.interface.studies.intersections",
    "IntersectionStudy": "eval.studies.intersections.settings",
    "run_layout_study": "eval.interface.studies.layouts",
    "LayoutResult": "eval.interface.studies.layouts",
    "LayoutStudy": "eval.studies.layouts.settings",
}
"""Module of each public name."""

__all__ = [*_EXPORTS]

if TYPE_CHECKING:
    from crosscue.datasets.scenes.drive import SceneFiles as SceneFiles
    from crosscue.detectors.base import Detections as Detections
    from crosscue.detectors.base import Detector as Detector
    from crosscue.detectors.base import Frame as Frame
    from crosscue.detectors.base import View as View
    from crosscue.detectors.base import nothing_found as nothing_found
    from crosscue.detectors.box_detector import BoxDetector as BoxDetector
    from crosscue.detectors.result_cache import default_cache as default_cache
    from crosscue.detectors.settings import Settings as Settings
    from crosscue.detectors.settings import identity_of as identity_of
    from crosscue.detectors.settings import settings_of as settings_of
    from crosscue.eval.batch.drive_list import DriveList as DriveList
    from crosscue.eval.catalog.compare import Comparison as Comparison
    from crosscue.eval.catalog.decoded_logs import Decoded as Decoded
    from crosscue.eval.catalog.history import History as History
    from crosscue.eval.catalog.query.catalog import Catalog as Catalog
    from crosscue.eval.catalog.query.catalog import catalog as catalog
    from crosscue.eval.failures.record import Failure as Failure
    from crosscue.eval.fit.signs.threshold import SignFit as SignFit
    from crosscue.eval.fit.signs.threshold import fit_signs as fit_signs
    from crosscue.eval.fit.truth_check import ImportedTruth as ImportedTruth
    from crosscue.eval.fit.truth_check import TruthFit as TruthFit
    from crosscue.eval.fit.truth_check import check_truth as check_truth
    from crosscue.eval.fit.truth_check import import_truth as import_truth
    from crosscue.eval.interface.demo import Demo as Demo
    from crosscue.eval.interface.demo import KnownDrive as KnownDrive
    from crosscue.eval.interface.demo import demo as demo
    from crosscue.eval.interface.demo import fetch_drive as fetch_drive
    from crosscue.eval.interface.failures.browse import Site as Site
    from crosscue.eval.interface.failures.browse import browse as browse
    from crosscue.eval.interface.failures.failures import Failures as Failures
    from crosscue.eval.interface.failures.failures import failures as failures
    from crosscue.eval.interface.failures.failures import read_failures as read_failures
    from crosscue.eval.interface.failures.labels import ExportedLabels as ExportedLabels
    from crosscue.eval.interface.failures.labels import ImportedLabels as ImportedLabels
    from crosscue.eval.interface.failures.labels import export as export
    from crosscue.eval.interface.failures.labels import import_labels as import_labels
    from crosscue.eval.interface.fits.compass import FittedCompass as FittedCompass
    from crosscue.eval.interface.fits.compass import fit_compass as fit_compass
    from crosscue.eval.interface.fits.detector import FittedDetector as FittedDetector
    from crosscue.eval.interface.fits.detector import fit_detector as fit_detector
    from crosscue.eval.interface.fits.landmarks import FittedLandmarks as FittedLandmarks
    from crosscue.eval.interface.fits.landmarks import fit_landmarks as fit_landmarks
    from crosscue.eval.interface.fits.messages import FittedMessages as FittedMessages
    from crosscue.eval.interface.fits.messages import fit_messages as fit_messages
    from crosscue.eval.interface.fits.odometry import FittedOdometry as FittedOdometry
    from crosscue.eval.interface.fits.odometry import fit_odometry as fit_odometry
    from crosscue.eval.interface.fits.ranges import FittedRanges as FittedRanges
    from crosscue.eval.interface.fits.ranges import fit_ranges as fit_ranges
    from crosscue.eval.interface.fits.temporal import FittedTemporal as FittedTemporal
    from crosscue.eval.interface.fits.temporal import fit_temporal as fit_temporal
    from crosscue.eval.interface.landmarks import AddedLandmarks as AddedLandmarks
    from crosscue.eval.interface.landmarks import LandmarkList as LandmarkList
    from crosscue.eval.interface.landmarks import LandmarkMatches as LandmarkMatches
    from crosscue.eval.interface.landmarks import add_landmark_images as add_landmark_images
    from crosscue.eval.interface.landmarks import add_landmarks as add_landmarks
    from crosscue.eval.interface.landmarks import list_landmarks as list_landmarks
    from crosscue.eval.interface.landmarks import match_landmarks as match_landmarks
    from crosscue.eval.interface.logs.convert import Converted as Converted
    from crosscue.eval.interface.logs.convert import convert as convert
    from crosscue.eval.interface.logs.log import CameraFrame as CameraFrame
    from crosscue.eval.interface.logs.log import Log as Log
    from crosscue.eval.interface.logs.log import LogTopic as LogTopic
    from crosscue.eval.interface.logs.log import Signals as Signals
    from crosscue.eval.interface.logs.log import Topics as Topics
    from crosscue.eval.interface.logs.log import open as open  # noqa: A004
    from crosscue.eval.interface.logs.seals import SealCheck as SealCheck
    from crosscue.eval.interface.logs.seals import SealChecks as SealChecks
    from crosscue.eval.interface.logs.seals import Sealed as Sealed
    from crosscue.eval.interface.logs.seals import Seals as Seals
    from crosscue.eval.interface.logs.seals import check_seal as check_seal
    from crosscue.eval.interface.logs.seals import seal as seal
    from crosscue.eval.interface.logs.summary import DriveSummary as DriveSummary
    from crosscue.eval.interface.models.cards import CardCheck as CardCheck
    from crosscue.eval.interface.models.cards import CardDraft as CardDraft
    from crosscue.eval.interface.models.cards import check_card as check_card
    from crosscue.eval.interface.models.cards import draft_card as draft_card
    from crosscue.eval.interface.models.catalog import FetchedModel as FetchedModel
    from crosscue.eval.interface.models.catalog import Model as Model
    from crosscue.eval.interface.models.catalog import Models as Models
    from crosscue.eval.interface.models.catalog import fetch_model as fetch_model
    from crosscue.eval.interface.models.catalog import model as model
    from crosscue.eval.interface.models.catalog import models as models
    from crosscue.eval.interface.plugins import plugins as plugins
    from crosscue.eval.interface.runs.batch import ReplayedDrives as ReplayedDrives
    from crosscue.eval.interface.runs.batch import find_drives as find_drives
    from crosscue.eval.interface.runs.batch import replay_drives as replay_drives
    from crosscue.eval.interface.runs.compare import compare_many as compare_many
    from crosscue.eval.interface.runs.compare import compare_runs as compare_runs
    from crosscue.eval.interface.runs.detector_scores import DetectorScore as DetectorScore
    from crosscue.eval.interface.runs.detector_scores import score_detector as score_detector
    from crosscue.eval.interface.runs.history import history as history
    from crosscue.eval.interface.runs.make import detect_drive as detect_drive
    from crosscue.eval.interface.runs.make import estimate_run as estimate_run
    from crosscue.eval.interface.runs.make import replay_drive as replay_drive
    from crosscue.eval.interface.runs.recording import save_recording as save_recording
    from crosscue.eval.interface.runs.run import Run as Run
    from crosscue.eval.interface.runs.run import load_vehicle as load_vehicle
    from crosscue.eval.interface.runs.run import open_run as open_run
    from crosscue.eval.interface.runs.run import run_schema as run_schema
    from crosscue.eval.interface.runs.score import ScoredRun as ScoredRun
    from crosscue.eval.interface.runs.score import score_run as score_run
    from crosscue.eval.interface.runs.scores import ScoredRuns as ScoredRuns
    from crosscue.eval.interface.runs.scores import score_runs as score_runs
    from crosscue.eval.interface.runs.status import BatchStatus as BatchStatus
    from crosscue.eval.interface.runs.status import batch_status as batch_status
    from crosscue.eval.interface.runs.tables import MergedRuns as MergedRuns
    from crosscue.eval.interface.runs.tables import decode as decode
    from crosscue.eval.interface.runs.tables import merge as merge
    from crosscue.eval.interface.runs.tags import TaggedRuns as TaggedRuns
    from crosscue.eval.interface.runs.tags import tag_runs as tag_runs
    from crosscue.eval.interface.runs.tracking import MlflowSink as MlflowSink
    from crosscue.eval.interface.runs.tracking import open_mlflow as open_mlflow
    from crosscue.eval.interface.simulate import SimulatedDrives as SimulatedDrives
    from crosscue.eval.interface.simulate import draw_contact_sheet as draw_contact_sheet
    from crosscue.eval.interface.simulate import draw_sign as draw_sign
    from crosscue.eval.interface.simulate import simulate_approach as simulate_approach
    from crosscue.eval.interface.simulate import simulate_approaches as simulate_approaches
    from crosscue.eval.interface.simulate import simulate_drive as simulate_drive
    from crosscue.eval.interface.studies.drive import StudyDrive as StudyDrive
    from crosscue.eval.interface.studies.drive import run_study_drive as run_study_drive
    from crosscue.eval.interface.studies.intersections import (
        IntersectionResult as IntersectionResult,
    )
    from crosscue.eval.interface.studies.intersections import (
        run_intersection_study as run_intersection_study,
    )
    from crosscue.eval.interface.studies.layouts import LayoutResult as LayoutResult
    from crosscue.eval.interface.studies.layouts import run_layout_study as run_layout_study
    from crosscue.eval.interface.studies.town import FieldResult as FieldResult
    from crosscue.eval.interface.studies.town import StudyResult as StudyResult
    from crosscue.eval.interface.studies.town import calibrate_study as calibrate_study
    from crosscue.eval.interface.studies.town import run_field_study as run_field_study
    from crosscue.eval.interface.studies.town import run_study as run_study
    from crosscue.eval.interface.training.frames import TrainingFrames as TrainingFrames
    from crosscue.eval.interface.training.frames import (
        render_training_frames as render_training_frames,
    )
    from crosscue.eval.interface.training.mask_rcnn import (
        MaskRcnnTrainingSettings as MaskRcnnTrainingSettings,
    )
    from crosscue.eval.interface.training.mask_rcnn import MeasuredMaskRcnn as MeasuredMaskRcnn
    from crosscue.eval.interface.training.mask_rcnn import TrainedMaskRcnn as TrainedMaskRcnn
    from crosscue.eval.interface.training.mask_rcnn import measure_mask_rcnn as measure_mask_rcnn
    from crosscue.eval.interface.training.mask_rcnn import train_mask_rcnn as train_mask_rcnn
    from crosscue.eval.interface.training.road import RoadTrainingSettings as RoadTrainingSettings
    from crosscue.eval.interface.training.road import TrainedRoad as TrainedRoad
    from crosscue.eval.interface.training.road import measure_road as measure_road
    from crosscue.eval.interface.training.road import train_road as train_road
    from crosscue.eval.interface.truth import truth_from_gnss as truth_from_gnss
    from crosscue.eval.interface.truth import truth_schema as truth_schema
    from crosscue.eval.interface.truth import write_truth as write_truth
    from crosscue.eval.interface.vehicles import VehicleCheck as VehicleCheck
    from crosscue.eval.interface.vehicles import VehicleDraft as VehicleDraft
    from crosscue.eval.interface.vehicles import check_vehicle as check_vehicle
    from crosscue.eval.interface.vehicles import draft_vehicle as draft_vehicle
    from crosscue.eval.studies.intersections.settings import IntersectionStudy as IntersectionStudy
    from crosscue.eval.studies.layouts.settings import LayoutStudy as LayoutStudy
    from crosscue.eval.studies.town.settings import FieldStudy as FieldStudy
    from crosscue.eval.studies.town.settings import LandmarkStudy as LandmarkStudy
    from crosscue.eval.studies.town.settings import RangeStudy as RangeStudy
    from crosscue.replay.errors import AccountError as AccountError
    from crosscue.replay.errors import AnnotationError as AnnotationError
    from crosscue.replay.errors import CanDatabaseError as CanDatabaseError
    from crosscue.replay.errors import CrosscueError as CrosscueError
    from crosscue.replay.errors import EmptyResultError as EmptyResultError
    from crosscue.replay.errors import LogError as LogError
    from crosscue.replay.errors import LogFormatError as LogFormatError
    from crosscue.replay.errors import LogTooLargeError as LogTooLargeError
    from crosscue.replay.errors import LossWarning as LossWarning
    from crosscue.replay.errors import MissingTopicError as MissingTopicError
    from crosscue.replay.errors import OutputError as OutputError
    from crosscue.replay.errors import RunError as RunError
    from crosscue.replay.errors import SchemaError as SchemaError
    from crosscue.replay.errors import StudyFileError as StudyFileError
    from crosscue.replay.errors import UnknownFormatError as UnknownFormatError
    from crosscue.replay.errors import UnreadableRunError as UnreadableRunError
    from crosscue.replay.errors import UsageError as UsageError
    from crosscue.replay.errors import VehicleError as VehicleError
    from crosscue.replay.errors import WorkerError as WorkerError
    from crosscue.replay.formats import DataSet as DataSet
    from crosscue.replay.formats import Format as Format
    from crosscue.replay.plugins import PluginWarning as PluginWarning
    from crosscue.replay.vehicle.cue_spec import CueSpec as CueSpec
    from crosscue.replay.vehicle.vehicle import Vehicle as Vehicle

    __version__: str
else:

    def __getattr__(name: str) -> object:
        """Import a public name when it is first used."""
        if name == "__version__":
            found = import_module("crosscue.replay.versions").installed("crosscue")
        elif name in _EXPORTS:
            found = getattr(import_module(f"crosscue.{_EXPORTS[name]}"), name)
        else:
            raise AttributeError(f"module 'crosscue' has no attribute {name!r}")
        globals()[name] = found
        return found

    def __dir__() -> list[str]:
        return sorted({*globals(), *__all__})
