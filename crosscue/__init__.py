"""Replay a recorded drive, score every cue and the pose, and view it in Rerun.

The stub ``__init__.pyi`` lists the public interface, whose changes are recorded in the changelog.
Each name is imported when it is first used, so ``import crosscue`` is fast.

The six packages ``replay``, ``detectors``, ``fusion``, ``localization``, ``datasets`` and ``eval``
are at the top of the repository and are linked here, so that only ``crosscue`` is installed.
"""

from __future__ import annotations

import re
from importlib import import_module
from pathlib import Path
from typing import Final

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


def _public() -> dict[str, str]:
    """Return the module of each public name, from the stub next to this file."""
    stub = Path(__file__).with_suffix(".pyi").read_text(encoding="utf-8")
    found = re.findall(r"^from (\S+) import \(?\s*(\w+)", stub, re.MULTILINE)
    return {name: module for module, name in found}


_MODULES: Final = _public()
__all__ = [*_MODULES]
# Present homes of former names of this module.
_FORMER: Final = """
crosscue.check: check_card check_seal check_truth check_vehicle
crosscue.datasets.simulate: Approaches
crosscue.datasets.truth.truth: truth_schema
crosscue.detectors.base: nothing_found
crosscue.detectors.catalog.cards: CardDraft
crosscue.detectors.catalog.known_models: FetchedModel Model Models
crosscue.detectors.result_cache: default_cache
crosscue.detectors.settings: Settings identity_of settings_of
crosscue.detectors.signs.templates: draw_sign
crosscue.errors: AccountError AnnotationError CanDatabaseError EmptyResultError
  LogFormatError LogTooLargeError MissingTopicError OutputError PluginWarning RunError SchemaError
  StudyFileError UnknownFormatError UnreadableRunError VehicleError WorkerError
crosscue.eval.batch.journal: BatchStatus
crosscue.eval.batch.drive_list: DriveList
crosscue.eval.batch.merge: MergedRuns
crosscue.eval.catalog.compare: Comparison
crosscue.eval.catalog.decoded_logs: Decoded
crosscue.eval.catalog.history: History
crosscue.eval.catalog.query.catalog: Catalog
crosscue.eval.check: Checks
crosscue.eval.drives.demo: Demo KnownDrive fetch_drive
crosscue.eval.drives.detector_score: DetectorScore
crosscue.eval.drives.many: ReplayedDrives find_drives
crosscue.eval.drives.score: ScoredRun
crosscue.eval.drives.score_runs: ScoredRuns
crosscue.eval.drives.tracking: MlflowSink open_mlflow
crosscue.eval.failures.browse: Site
crosscue.eval.failures.imported_truth: ImportedLabels ImportedTruth
crosscue.eval.failures.labels: ExportedLabels
crosscue.eval.failures.record: Failure
crosscue.eval.failures.search: Failures
crosscue.eval.fleet.tags: TaggedRuns
crosscue.eval.logs.convert: Converted
crosscue.eval.logs.log: CameraFrame LogTopic Signals Topics UnopenedLog
crosscue.eval.logs.seals: SealCheck Sealed Seals
crosscue.eval.logs.summary: DriveSummary
crosscue.eval.pipeline.run: run_schema
crosscue.eval.studies.intersections.settings: IntersectionStudy
crosscue.eval.studies.layouts.settings: LayoutStudy
crosscue.eval.studies.town.settings: FieldStudy LandmarkStudy RangeStudy
crosscue.eval.training.mask_rcnn: MaskRcnnTrainingSettings Measuring
crosscue.eval.training.road: RoadTrainingSettings
crosscue.import_truth: import_labels
"""


def _former_names() -> dict[str, str]:
    """Return the present home of each former name."""
    entries = re.findall(r"^(\S+):((?:\s+\w+\b(?!\.|:))+)", _FORMER, re.MULTILINE)
    return {name: home for home, names in entries for name in names.split()}


def __getattr__(name: str) -> object:
    """Import a public name when it is first used."""
    if name == "__version__":
        found = import_module("crosscue.replay.versions").installed("crosscue")
    elif name in _MODULES:
        is_module = _MODULES[name] == "crosscue"
        module = import_module(f"crosscue.{name}" if is_module else _MODULES[name])
        found = module if is_module else getattr(module, name)
    else:
        home = _former_names().get(name)
        hint = "" if home is None else f"; see {home}"
        raise AttributeError(f"module 'crosscue' has no attribute {name!r}{hint}")
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
