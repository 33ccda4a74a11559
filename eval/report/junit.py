"""Gates and comparisons as JUnit XML, which CI systems show as tests."""

import re
from collections.abc import Sequence
from typing import Final
from xml.etree import ElementTree as ET

from crosscue.eval.scoring.gates import GateResult

# Tabs and line ends are legal, but in attributes they would be read back as spaces.
FORBIDDEN: Final = re.compile("[^ -~\xa0-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


def junit_text(results: Sequence[GateResult], suite: str) -> str:
    """Return the JUnit XML of gates; characters that XML forbids are escaped visibly."""
    return cases_text([(one.gate.text(), one.failure) for one in results], suite, "gate")


def cases_text(cases: Sequence[tuple[str, str]], suite: str, kind: str) -> str:
    """Return the JUnit XML of test cases: pairs of name and failure, which is empty if passed."""
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
    """Return ``text`` with characters that XML 1.0 forbids written as escapes."""
    return FORBIDDEN.sub(lambda found: found[0].encode("unicode_escape").decode("ascii"), text)
