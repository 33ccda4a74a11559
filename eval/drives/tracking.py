"""Log scores to MLflow."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from crosscue.eval.report.mlflow_sink import Experiment, Tracked, open_experiment
from crosscue.eval.runs.tags import read_tags
from crosscue.eval.scoring.metric_values import metric_values


class Scores(Protocol):
    """Result of ``score_runs``."""

    @property
    def runs(self) -> Sequence[Any]:
        """The scored runs."""
        ...

    @property
    def metrics(self) -> Mapping[str, Any]:
        """Metrics of all runs together."""
        ...

    @property
    def report(self) -> Path | None:
        """Page of all runs together."""
        ...

    @property
    def is_many(self) -> bool:
        """True if several runs were to be scored."""
        ...


@dataclass(frozen=True, slots=True)
class MlflowSink:
    """An MLflow experiment to log scores to, returned by ``open_mlflow``."""

    experiment: Experiment

    def log(self, found: Scores) -> tuple[str, ...]:
        """Log each scored run as a run of the experiment, and one more for all together.

        Scores become metrics. The run's tags, its drive's identity and crosscue's version become
        tags. The report and ``metrics.json`` become artifacts. Logging again adds runs.

        Raises:
            OutputError: The store refuses the data, or can no longer be reached.
        """
        runs = []
        for scored in found.runs:
            one = scored.one
            manifest = one.run.drive_manifest()
            tags = {
                "crosscue.run": str(one.run.path),
                "crosscue.drive": "+".join(sorted(log.identity.digest for log in manifest.logs)),
                **{f"crosscue.version.{name}": it for name, it in manifest.versions.items()},
                **read_tags(one.run.path),
            }
            runs.append(self._log(one.run.path.name, scored.metrics, tags, scored.report))
        if found.is_many:
            name = "all" if found.report is None else found.report.parent.name
            tags = {"crosscue.runs": str(len(found.runs))}
            runs.append(self._log(name, found.metrics, tags, found.report))
        return tuple(runs)

    def _log(
        self,
        name: str,
        metrics: Mapping[str, Any],
        tags: Mapping[str, str],
        report: Path | None,
    ) -> str:
        judged = {part: tree for part, tree in metrics.items() if part not in LEFT_OUT}
        values = {
            path: end
            for path, one in metric_values(judged, parts=False).items()
            for path, end in (
                (path, one.value),
                (f"{path}.low", one.low),
                (f"{path}.high", one.high),
            )
        }
        files = [] if report is None else [report, report.with_name("metrics.json")]
        return self.experiment.log(
            Tracked(name, values, tags, [path for path in files if path.exists()])
        )


# Parts of ``metrics.json`` that are not scores.
LEFT_OUT = ("truth", "settings", "format", "account")


def open_mlflow(uri: str, experiment: str = "crosscue") -> MlflowSink:
    """Connect to an MLflow server or store, to log scores to it.

    Args:
        uri: Address of the tracking server or store, such as ``http://localhost:5000``.
        experiment: Name of the experiment; created if it does not exist.

    Raises:
        UsageError: MLflow is not installed, or lacks a part that the store needs.
        OutputError: The store cannot be reached or used.
    """
    return MlflowSink(open_experiment(uri, experiment))
