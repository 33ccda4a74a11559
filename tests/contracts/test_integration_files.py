"""The package: version, licences, and the files of its integrations."""

import json
import os
import re
import shlex
import subprocess
import sys
import tomllib
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path
from typing import Any, Final

import pytest
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet
from ruamel.yaml import YAML

from crosscue.datasets.real import recordings
from crosscue.datasets.simulated.drive import DriveSettings
from crosscue.datasets.simulated.log_files import write_drive as simulated
from crosscue.detectors.catalog import places
from crosscue.eval import cli
from crosscue.eval.drives.replay import cache_file
from crosscue.replay.remote.logs import default_store

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

    gate = tmp_path / "gate.toml"
    gate.write_text('version = 1\n[[gate]]\nmetric = "pose.distance_m"\nmax = -1\n')

    status, _ = _act(tmp_path, **drive, OUTPUT=tmp_path / "a", GATE=gate)
    assert status == 1
    status, text = _act(
        tmp_path, **drive, OUTPUT=tmp_path / "b", AGAINST=tmp_path / "a", TOLERANCE="1% cues.*=0.02"
    )
    assert status == 0
    assert "**0 worse, 0 better, 0 undecided**" in text
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


def _command_fault(line: str, capsys: pytest.CaptureFixture[str]) -> str:
    """Return why a line ``crosscue COMMAND ...`` is not accepted; empty if it is."""
    program, name, *words = shlex.split(line)
    if program != "crosscue" or name not in cli.COMMANDS:
        return f"no command: {line}"
    try:
        cli.parser_of(name)[1].parse_args(words)
    except SystemExit:
        return capsys.readouterr().err
    return ""


def _missing_paths(text: str) -> list[str]:
    """Return the files of the repository that a shell line names and that do not exist."""
    names = re.findall(r"(?<![\w./-])((?:\.ci|\.github)/[\w./-]+|[\w-]+\.(?:lock|toml|txt))", text)
    return [name for name in names if not (ROOT / name).exists()]


def test_checks_of_integration_files_can_fail(capsys: pytest.CaptureFixture[str]) -> None:
    assert "--colour" in _command_fault("crosscue demo --colour", capsys)
    assert _command_fault("crosscue drive", capsys) == "no command: crosscue drive"
    assert _missing_paths("pip install -c requirement.lock .") == ["requirement.lock"]
    assert _missing_paths(".ci/runs") == [".ci/runs"]


def test_dockerfile_copies_what_exists_and_starts_a_command(
    capsys: pytest.CaptureFixture[str],
) -> None:
    text = (ROOT / "Dockerfile").read_text()
    steps = re.findall(r"^([A-Z]+) (.+)$", re.sub(r"\\\n", " ", text), re.MULTILINE)
    of: dict[str, list[str]] = {}
    for name, rest in steps:
        of.setdefault(name, []).append(rest)
    assert steps[0][0] == "FROM"
    assert {*of} == {"FROM", "COPY", "RUN", "WORKDIR", "VOLUME", "ENTRYPOINT", "CMD"}

    (version,) = re.findall(r"^python:(\d+\.\d+)-slim$", of["FROM"][0])
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert SpecifierSet(project["requires-python"]).contains(version)
    assert of["COPY"] == [". /crosscue"]
    ignored = (ROOT / ".dockerignore").read_text().splitlines()
    packages = {one.resolve().name for one in (ROOT / "crosscue").iterdir() if one.is_dir()}
    assert {"replay", "detectors", "eval"} <= packages
    needed = {"requirements.lock", "pyproject.toml", "README.md", "LICENSE", "crosscue", *packages}
    assert not {*ignored} & needed
    assert {".git", ".venv", "docs", "tests", "benchmarks"} <= {*ignored}
    for path in re.findall(r"/crosscue/([\w./-]+)", of["RUN"][0]):
        assert (ROOT / path).is_file(), path
    assert of["VOLUME"] == of["WORKDIR"]
    words = [*json.loads(of["ENTRYPOINT"][0]), *json.loads(of["CMD"][0])]
    assert _command_fault(shlex.join(words), capsys) == ""
    (folder, given) = re.findall(r':(/\w+)" crosscue (.+)$', text, re.MULTILINE)[0]
    assert folder == of["WORKDIR"][0]
    assert _command_fault(f"crosscue {given}", capsys) == ""


def test_main_branch_can_take_a_worse_score_that_was_accepted() -> None:
    """A comparison that failed there would keep the scores that it compares with for ever."""
    workflow = YAML(typ="safe").load(ROOT / ".github/workflows/drive.yml")
    steps = workflow["jobs"]["drive"]["steps"]
    (act,) = [step for step in steps if step.get("uses") == "./"]
    assert act["with"]["against"].startswith("${{ github.event_name == 'pull_request' && ")


@pytest.mark.parametrize(
    "path", [*(ROOT / ".github/workflows").glob("*.yml")], ids=lambda p: p.name
)
def test_workflow_runs_commands_and_files_that_exist(
    path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = path.read_text()
    tree = YAML(typ="safe").load(text)
    action = _action()
    for job in tree["jobs"].values():
        steps = job["steps"]
        assert {*re.findall(r"steps\.(\w+)\.", text)} <= {one.get("id") for one in steps}
        for step in steps:
            # A version is pinned.
            assert re.fullmatch(r"\./|[\w/-]+@v\d+(\.\d+)*", step.get("uses", "./")), step
            for line in step.get("run", "").splitlines():
                assert _missing_paths(line) == []
                if line.startswith("crosscue"):
                    assert _command_fault(line, capsys) == ""
            if step.get("uses") == "./":
                required = {k for k, one in action["inputs"].items() if one.get("required")}
                assert required <= {*step["with"]} <= {*action["inputs"]}
                drive = Path(step["with"]["drives"])
                made = " ".join(one.get("run", "") for one in steps)
                assert (
                    f"simulate {drive.name[0]} --run {int(drive.name[2:])} -o {drive.parent}"
                    in made
                )
    for step in action["runs"]["steps"]:
        assert _missing_paths(step["run"].replace("${{ github.action_path }}/", "")) == []


def test_shell_scripts_of_the_repository_parse() -> None:
    for script in (SCRIPT, ROOT / ".ci/run", ROOT / ".ci/lowest"):
        assert script.stat().st_mode & 0o100 or script is SCRIPT, script
        assert subprocess.run(["bash", "-n", script], check=False).returncode == 0


PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
VERSION = PROJECT["version"]
PACKAGES = ("replay", "detectors", "fusion", "localization", "datasets", "eval", "docs")


def newest_heading() -> str:
    found = re.search(r"^## (.+)$", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert found
    return found[1]


def test_changelog_and_citation_have_version_of_package() -> None:
    cited = re.search(r"^version: (.+)$", (ROOT / "CITATION.cff").read_text(), re.MULTILINE)

    assert newest_heading().split()[0] == VERSION
    assert cited
    assert cited[1] == VERSION


def test_release_tag_has_version_of_package_and_dated_changelog() -> None:
    command = ["git", "-C", str(ROOT), "tag", "--points-at", "HEAD", "v*"]
    tags = subprocess.run(command, capture_output=True, text=True, check=False).stdout.split()

    assert tags in ([], [f"v{VERSION}"])
    if tags:
        assert re.fullmatch(r"\S+ \(\d{4}-\d\d-\d\d\)", newest_heading())


def test_hints_name_packages_that_pip_finds() -> None:
    extras = PROJECT["optional-dependencies"]
    wanted = [*PROJECT["dependencies"], *(one for name in extras for one in extras[name])]
    known = {re.split(r"[<>=;\[]", one)[0] for one in wanted}
    files = [
        path
        for folder in PACKAGES
        for path in (ROOT / folder).rglob("*")
        if path.suffix in (".py", ".md") and "_build" not in path.parts
    ]
    text = "\n".join(path.read_text(encoding="utf-8") for path in files)
    hints = set(re.findall(r"pip install ([a-z][\w-]*)", text))

    # crosscue itself is on no index, so "pip install 'crosscue[onnx]'" finds nothing.
    assert "crosscue[" not in text
    assert {"openvino", "ray", "mlflow-skinny"} <= hints
    # A database as MLflow's store needs the whole of it; see the page on scores.
    assert hints - known == {"mlflow"}


PAGE: Final = ROOT / "docs" / "reference" / "licences.md"
RESTRICTED: Final = re.compile(r"GPL|NVIDIA|Proprietary", re.IGNORECASE)
NAME: Final = re.compile(r"[A-Za-z0-9._-]+")


def _required(name: str, found: dict[str, str]) -> dict[str, str]:
    """Add the licence of each installed package that a package requires, by name."""
    try:
        package = distribution(name)
    except PackageNotFoundError:
        return found
    metadata = package.metadata
    fields = ("License-Expression", "License", "Classifier")
    texts = (text for field in fields for text in metadata.get_all(field, []))
    # A whole licence in the field begins with its title.
    found[name] = " ".join(text[:80] for text in texts if "Intended" not in text)
    for requirement in package.requires or ():
        match = NAME.match(requirement)
        assert match is not None
        if "extra ==" not in requirement and match[0].lower() not in found:
            _required(match[0].lower(), found)
    return found


def test_page_and_readme_name_dependencies_that_are_not_permissive() -> None:
    page = PAGE.read_text(encoding="utf-8")
    restricted = {
        name for name, text in _required("crosscue", {}).items() if RESTRICTED.search(text)
    }

    assert "python-can" in restricted
    families = {"`nvidia-" if one.startswith("nvidia-") else one for one in restricted}
    families = {"`cuda-" if one.startswith("cuda-") else one for one in families}
    assert {one for one in families if one not in page} == set()
    readme = (ROOT / "README.md").read_text(encoding="utf-8").partition("## Licence")[2]
    assert "python-can" in readme
    assert "CUDA" in readme


def test_no_cache_of_a_test_is_the_users() -> None:
    detections = cache_file()
    assert detections is not None
    folders = (
        detections,
        places.model_folder(),
        default_store().folder,
        recordings.recording_folder(recordings.recording("pandaset_002")),
    )

    assert [one for one in folders if Path.home() / ".cache" in one.parents] == []
