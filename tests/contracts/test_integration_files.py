"""The action for pull requests, and the lock file, do what they say."""

import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any, Final

from packaging.requirements import Requirement
from ruamel.yaml import YAML

from crosscue.datasets.simulated.drive import DriveSettings
from crosscue.datasets.simulated.log_files import write_drive as simulated

ROOT: Final = Path(__file__).parents[2]
SCRIPT: Final = ROOT / ".github" / "replay_score_compare.sh"


def _action() -> dict[str, Any]:
    found: dict[str, Any] = YAML(typ="safe").load(ROOT / "action.yml")
    return found


def test_inputs_of_the_action_reach_its_script_as_variables_only() -> None:
    action = _action()
    inputs, used = set(action["inputs"]), set()
    for step in action["runs"]["steps"]:
        assert "inputs." not in step["run"]
        found = [re.findall(r"inputs\.(\w+)", value) for value in step.get("env", {}).values()]
        used |= {name for names in found for name in names}
        used |= set(re.findall(r"inputs\.(\w+)", str(step.get("if", ""))))
    assert used == inputs
    (step,) = [one for one in action["runs"]["steps"] if SCRIPT.name in one["run"]]
    assert set(re.findall(r"\$\{?([A-Z]+)\b", SCRIPT.read_text())) == set(step["env"])


def _act(place: Path, **variables: object) -> tuple[int, str]:
    """Run the script; return its exit status and the summary of the job."""
    summary = place / "summary.txt"
    environment = {
        **os.environ,
        **{name: str(value) for name, value in variables.items()},
        "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}",
        "GITHUB_STEP_SUMMARY": str(summary),
    }
    done = subprocess.run(["bash", SCRIPT], env=environment, capture_output=True, check=False)
    print(done.stderr.decode())
    return done.returncode, summary.read_text()


def test_action_scores_compares_and_fails_by_gate(tmp_path: Path) -> None:
    made = simulated(tmp_path / "drive", DriveSettings(seed=3, blocks=1, block_m=60.0))
    drive = {"DRIVES": made.log, "VEHICLE": made.vehicle, "TRUTH": made.truth}

    status, _ = _act(tmp_path, **drive, OUTPUT=tmp_path / "a")
    assert status == 0
    status, text = _act(
        tmp_path, **drive, OUTPUT=tmp_path / "b", AGAINST=tmp_path / "a", TOLERANCE="1% cues.*=0.02"
    )
    assert status == 0
    assert "**0 worse, 0 better, 0 undecided**" in text
    gate = tmp_path / "gate.toml"
    gate.write_text('version = 1\n[[gate]]\nmetric = "pose.distance_m"\nmax = -1\n')
    status, text = _act(tmp_path, **drive, OUTPUT=tmp_path / "c", GATE=gate)
    assert status == 1
    status, text = _act(tmp_path, DRIVES=tmp_path / "none", OUTPUT=tmp_path / "d")
    assert status == 4
    assert "the replay failed with exit status 4" in text


def test_lock_file_has_each_dependency_within_its_bounds() -> None:
    wanted = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["dependencies"]
    text = (ROOT / "requirements.lock").read_text()
    locked = dict(re.findall(r"^([\w.-]+)==([\w.]+)", text, re.MULTILINE))
    for line in wanted:
        one = Requirement(line)
        assert one.specifier.contains(locked[one.name.replace(".", "-")]), line
    assert "://" not in text
