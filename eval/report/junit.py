"""Gates and comparisons as JUnit XML, which CI systems show as tests."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from xml.etree import ElementTree as ET

from crosscue.eval.scoring.gates import GateResult
from crosscue.replay.base import write_text


def write_junit(path: Path, results: Sequence[GateResult], suite: str) -> None:
    """Write one test case for each gate.

    Args:
        path: Where to.
        results: In order.
        suite: Name of the test suite.

    Raises:
        OutputError: It cannot be written.
    """
    write_text(path, junit_text(results, suite))


def junit_text(results: Sequence[GateResult], suite: str) -> str:
    """The file's text; characters that XML cannot hold are shown, not kept."""
    return cases_text([(one.gate.text(), one.failure) for one in results], suite, "gate")


def cases_text(cases: Sequence[tuple[str, str]], suite: str, kind: str) -> str:
    """The same of cases of a kind, each with its name and why it fails, if it does."""
    failed = sum(bool(failure) for _, failure in cases)
    counts = {"tests": str(len(cases)), "failures": str(failed), "errors": "0", "skipped": "0"}
    root = ET.Element("testsuites", counts)
    parent = ET.SubElement(root, "testsuite", {"name": fit_for_xml(suite), **counts, "time": "0"})
    for name, why in cases:
        case = ET.SubElement(
            parent,
            "testcase",
            {"classname": f"crosscue.{kind}", "name": fit_for_xml(name), "time": "0"},
        )
        if why:
            failure = ET.SubElement(case, "failure", {"type": kind, "message": fit_for_xml(why)})
            failure.text = fit_for_xml(f"{name}: {why}")
    ET.indent(root)
    return '<?xml version="1.0" encoding="utf-8"?>\n' + ET.tostring(root, "unicode") + "\n"


def fit_for_xml(text: str) -> str:
    """``text`` with all but XML 1.0's characters written as escapes."""
    return "".join(
        c if _is_allowed(ord(c)) else c.encode("unicode_escape", "surrogatepass").decode("ascii")
        for c in text
    )


def _is_allowed(code: int) -> bool:
    # Tabs and line ends are legal, but within attributes they would come back as spaces.
    return (
        0x20 <= code <= 0x7E
        or 0xA0 <= code <= 0xD7FF
        or 0xE000 <= code <= 0xFFFD
        or (0x10000 <= code <= 0x10FFFF)
    )
