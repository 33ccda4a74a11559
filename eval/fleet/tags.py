"""Set, remove and list tags of runs, by which they can be queried."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar

from crosscue.eval.catalog.find_runs import runs_of
from crosscue.eval.runs import tags as stored
from crosscue.eval.runs.folder import RunFolder, locked
from crosscue.replay.errors import UsageError
from crosscue.results import Result
from crosscue.verb import Option


@dataclass(frozen=True, slots=True, repr=False)
class TaggedRuns(Result):
    """Runs and their tags.

    Attributes:
        tags: Tags by run folder.
    """

    tags: Mapping[Path, Mapping[str, str]]

    json_is: ClassVar = "tags"

    def lines(self) -> Iterator[str]:
        """Yield one line for each run."""
        for path, tags in self.tags.items():
            text = " ".join(f"{key}={value}" for key, value in tags.items())
            yield f"{path}  {text or 'no tags'}"


def tag(
    runs: Sequence[str], *, remove: Annotated[Sequence[str], Option(metavar="KEY")] = ()
) -> TaggedRuns:
    """Set tags of runs, remove them, or list them.

    A tag is a key and a value, such as weather=rain. It is stored in the run's tags.json, can be
    queried with crosscue query, and is kept when the run is repeated. Without KEY=VALUE and
    --remove, tags are listed.

    Examples:
        crosscue tag runs/drive-1f0e runs/drive-93aa weather=rain route=north
        crosscue tag runs --remove route
        crosscue tag runs

    Args:
        runs: Run folders, or folders of them; then KEY=VALUE for each tag to set.
        remove: Tags to remove.
    """
    tags = [word for word in runs if "=" in word and not Path(word).exists()]
    folders = [word for word in runs if word not in tags]
    if not folders:
        raise UsageError("tag: no run named; give run folders before KEY=VALUE")
    return tag_runs(folders, tags, remove)


def tag_runs(
    runs: Sequence[Path | str],
    tags: Mapping[str, str] | Sequence[str] = (),
    remove: Sequence[str] = (),
) -> TaggedRuns:
    """Set and remove tags of runs; without either, read them.

    Tags are stored in ``tags.json`` of each run and are kept when the run is repeated. Nothing else
    in the run depends on them.

    Args:
        runs: Run folders, folders of them, patterns, or ``@lists``.
        tags: Values to set by key, or texts such as ``weather=rain``.
        remove: Keys of tags to remove, where a run has them.

    Raises:
        UsageError: A key or value is not valid, or a key is set twice or both set and removed.
        RunError: There is no run, or a run cannot be read or is being written.
        OutputError: A run cannot be written.
    """
    new = stored.assignments(tags, remove)
    folders = [RunFolder(path) for path in runs_of([str(run) for run in runs])]
    for run in folders:
        # All runs are checked before the first is changed.
        run.drive_manifest()
        stored.read_tags(run.path)
    return TaggedRuns({run.path: _tagged(run, new, remove) for run in folders})


def _tagged(run: RunFolder, new: Mapping[str, str], remove: Sequence[str]) -> dict[str, str]:
    if not new and not remove:
        return stored.read_tags(run.path)
    with locked(run):
        before = stored.read_tags(run.path)
        after = {key: value for key, value in before.items() if key not in remove}
        after = dict(sorted({**after, **new}.items()))
        if after != before:
            stored.write_tags(run.path, after)
    return after
