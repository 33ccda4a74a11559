"""Gate results as JUnit XML, which CI systems show as tests."""

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
    failed = sum(bool(one.failure) for one in results)
    counts = {"tests": str(len(results)), "failures": str(failed), "errors": "0", "skipped": "0"}
    root = ET.Element("testsuites", counts)
    parent = ET.SubElement(root, "testsuite", {"name": fit_for_xml(suite), **counts, "time": "0"})
    for one in results:
        case = ET.SubElement(
            parent,
            "testcase",
            {"classname": "crosscue.gate", "name": fit_for_xml(one.gate.text()), "time": "0"},
        )
        if one.failure:
            failure = ET.SubElement(
                case, "failure", {"type": "gate", "message": fit_for_xml(one.failure)}
            )
            failure.text = fit_for_xml(f"{one.gate.text()}: {one.failure}")
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
