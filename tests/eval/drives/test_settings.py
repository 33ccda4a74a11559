"""Settings of a replay: those that determine a run are compared when a batch is started again."""

from dataclasses import fields, replace
from pathlib import Path
from typing import Final

import pytest

from crosscue.eval.batch.drive_list import DriveInput
from crosscue.eval.drives.many import BatchSettings
from crosscue.replay.logs.log_part import LogPart

DRIVE: Final = DriveInput("a", ("a.mcap",))
# Other values of each setting that determines a run.
OTHER: Final[dict[str, tuple[object, ...]]] = {
    "vehicle": ("other.toml",),
    "detectors": (("signs",), ()),
    "draw": (3,),
    "gnss": ("fuse", "off"),
    "start": ("1,2,3",),
    "landmarks": ("marks.db",),
    "part": (LogPart(begin="1"), LogPart(end="1"), LogPart(topics=("/a",))),
}
# Settings that do not change a run, and why.
HOW: Final = {
    "cache": "a cached result is the result",
    "overwrite": "says what may be replaced",
    "resume": "an uninterrupted run is the same",
    "limits": "a log above a limit is refused",
    "workers": "drives are independent",
    "ray": "drives are independent",
    "cores_per_drive": "declared to the scheduler",
    "memory_per_drive_gib": "declared to the scheduler",
    "retry_failed": "selects drives",
}


def test_every_setting_is_compared_or_excluded_with_a_reason() -> None:
    compared = {one.name: one.compare for one in fields(BatchSettings)}

    assert {name for name, is_compared in compared.items() if is_compared} == OTHER.keys()
    assert {name for name, is_compared in compared.items() if not is_compared} == HOW.keys()
    # LogPart is compared as a whole.
    assert all(one.compare for one in fields(LogPart))
    assert len(OTHER["part"]) == len(fields(LogPart))


@pytest.mark.parametrize(
    ("name", "value"), [(name, value) for name, values in OTHER.items() for value in values]
)
def test_every_compared_setting_changes_the_fingerprint(
    name: str, value: object, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A forgotten setting would resume runs that were made with another value of it."""
    monkeypatch.chdir(tmp_path)
    Path("other.toml").write_text("version = 1\n[cars]\nrelevance = 'all'\n", encoding="utf-8")
    settings = BatchSettings()
    other = replace(settings, **{name: value})  # type: ignore[arg-type]

    assert other.fingerprint(DRIVE) != settings.fingerprint(DRIVE)
    assert replace(other).fingerprint(DRIVE) == other.fingerprint(DRIVE)
