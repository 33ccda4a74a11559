"""Logging of scores to an MLflow tracking server or store.

MLflow is imported only here, with its telemetry turned off. For a server, its client
(``mlflow-skinny``) is enough; a database needs the full ``mlflow``. MLflow 3.17 no longer develops
stores in folders; they must be allowed with ``MLFLOW_ALLOW_FILE_STORE=true``.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from crosscue.replay.errors import OutputError, UsageError, one_line
from crosscue.replay.files.tree_text import valid_text

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
class Tracked:
    """Content of one run in MLflow.

    Attributes:
        name: Name of the run.
        metrics: Metrics by name; NaN is left out.
        tags: Tags by name.
        files: Files stored as artifacts.
    """

    name: str
    metrics: Mapping[str, float]
    tags: Mapping[str, str]
    files: Sequence[Path]


@dataclass(frozen=True, slots=True)
class Experiment:
    """An experiment of a reachable store.

    Attributes:
        uri: URI of the store.
        client: MLflow's client.
        identity: Id of the experiment.
    """

    uri: str
    client: Any
    identity: str

    def log(self, one: Tracked) -> str:
        """Write one run and return its id in MLflow.

        Raises:
            OutputError: The store refuses the run, or can no longer be reached.
        """
        from mlflow.entities import Metric, RunTag

        tags = [RunTag(mlflow_name(name), value[:MAX_VALUE]) for name, value in one.tags.items()]
        metrics = [
            Metric(mlflow_name(name), value, 0, 0)
            for name, value in one.metrics.items()
            if math.isfinite(value)
        ]
        with _reported(self.uri):
            run: str = self.client.create_run(
                self.identity, run_name=valid_text(one.name)
            ).info.run_id
            self.client.log_batch(run, tags=tags)
            for first in range(0, len(metrics), MAX_METRICS):
                self.client.log_batch(run, metrics=metrics[first : first + MAX_METRICS])
            for path in one.files:
                self.client.log_artifact(run, str(path))
            self.client.set_terminated(run)
        return run


def open_experiment(uri: str, experiment: str) -> Experiment:
    """Connect to a store, and find or create the experiment in it.

    Raises:
        UsageError: MLflow is not installed.
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
