"""Log scores to MLflow.

MLflow is imported only here, with its telemetry turned off. For a server, its client
(``mlflow-skinny``) is enough; a database needs the full ``mlflow``. MLflow 3.17 no longer develops
stores in folders; they must be allowed with ``MLFLOW_ALLOW_FILE_STORE=true``.
"""

import math
import os
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from crosscue.eval.runs.tags import read_tags
from crosscue.eval.scoring.metric_values import metric_values
from crosscue.replay.errors import OutputError, UsageError, one_line
from crosscue.replay.files.tree_text import valid_text

from .score import ScoredRun

# Parts of ``metrics.json`` that are not scores.
LEFT_OUT: Final = ("truth", "settings", "format", "account")
# Max number of metrics in one request.
MAX_METRICS: Final = 1000
# Max characters of a tag's value.
MAX_VALUE: Final = 5000
# Characters not allowed in names in MLflow.
_STRANGE: Final = re.compile(r"[^\w .:/-]")
SWITCHED: Final = {
    "MLFLOW_DISABLE_TELEMETRY": "true",
    # The default of seven retries with growing pauses would block a command for minutes.
    "MLFLOW_HTTP_REQUEST_MAX_RETRIES": "2",
    "MLFLOW_HTTP_REQUEST_TIMEOUT": "20",
}


@dataclass(frozen=True, slots=True)
class Experiment:
    """An MLflow experiment to log scores to, returned by ``open_mlflow``.

    Attributes:
        uri: URI of the store.
        client: MLflow's client.
        identity: Id of the experiment.
    """

    uri: str
    client: Any
    identity: str

    def log_run(self, scored: ScoredRun) -> None:
        """Log a scored run; logging it again adds a run.

        Scores become metrics. The run's tags, its drive's identity and crosscue's version become
        tags. The report and ``metrics.json`` become artifacts.

        Raises:
            OutputError: The store refuses the data, or can no longer be reached.
        """
        run = scored.one.run
        manifest = run.drive_manifest()
        tags = {
            "crosscue.run": str(run.path),
            "crosscue.drive": "+".join(sorted(log.identity.digest for log in manifest.logs)),
            **{f"crosscue.version.{name}": it for name, it in manifest.versions.items()},
            **read_tags(run.path),
        }
        self.log(run.path.name, scored.metrics, tags, scored.report)

    def log(
        self, name: str, metrics: Mapping[str, Any], tags: Mapping[str, str], report: Path | None
    ) -> None:
        """Log metrics, tags, and a report with the metrics next to it.

        Raises:
            OutputError: The store refuses the data, or can no longer be reached.
        """
        from mlflow.entities import Metric, RunTag

        judged = {part: tree for part, tree in metrics.items() if part not in LEFT_OUT}
        values = {
            f"{path}{end}": value
            for path, one in metric_values(judged, parts=False).items()
            for end, value in (("", one.value), (".low", one.low), (".high", one.high))
        }
        rows = [
            Metric(mlflow_name(path), value, 0, 0)
            for path, value in values.items()
            if math.isfinite(value)
        ]
        named = [RunTag(mlflow_name(tag), value[:MAX_VALUE]) for tag, value in tags.items()]
        files = [] if report is None else [report, report.with_name("metrics.json")]
        with _reported(self.uri):
            run = self.client.create_run(self.identity, run_name=valid_text(name)).info.run_id
            self.client.log_batch(run, tags=named)
            for first in range(0, len(rows), MAX_METRICS):
                self.client.log_batch(run, metrics=rows[first : first + MAX_METRICS])
            for path in files:
                if path.exists():
                    self.client.log_artifact(run, str(path))
            self.client.set_terminated(run)


def open_mlflow(uri: str, experiment: str = "crosscue") -> Experiment:
    """Connect to an MLflow server or store, and find or create the experiment in it.

    Args:
        uri: Address of the tracking server or store, such as ``http://localhost:5000``.
        experiment: Name of the experiment.

    Raises:
        UsageError: MLflow is not installed, or lacks a part that the store needs.
        OutputError: The store cannot be reached or used.
    """
    for name, value in SWITCHED.items():
        os.environ.setdefault(name, value)
    try:
        from mlflow.tracking import MlflowClient
    except ImportError:
        raise UsageError("--mlflow: MLflow is not installed; pip install mlflow-skinny") from None
    with _reported(uri):
        client = MlflowClient(tracking_uri=uri)
        found = client.get_experiment_by_name(experiment)
        identity = client.create_experiment(experiment) if found is None else found.experiment_id
    return Experiment(uri, client, str(identity))


@contextmanager
def _reported(uri: str) -> Iterator[None]:
    from mlflow.exceptions import MlflowException

    try:
        yield
    except ImportError as error:
        raise UsageError(
            f"--mlflow {uri}: this store needs the full MLflow ({one_line(error)}); "
            "pip install mlflow"
        ) from None
    except (MlflowException, OSError, ValueError) as error:
        text = one_line(error)
        if "MLFLOW_ALLOW_FILE_STORE" in text:
            text = "MLflow no longer opens folders unless MLFLOW_ALLOW_FILE_STORE=true is set"
        raise OutputError(
            f"--mlflow {uri}: {text[:300]}; the scores are in their folders; try a server's URL"
        ) from None


def mlflow_name(name: str) -> str:
    """Return a name without the characters that MLflow forbids."""
    return _STRANGE.sub("_", name)
