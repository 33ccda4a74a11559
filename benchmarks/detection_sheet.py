"""Draw docs/simulated_detections.jpg: detections in some drives of a study, in one picture.

    crosscue study intersections --runs 10 -o study
    python benchmarks/detection_sheet.py study -o docs/simulated_detections.jpg

Each intersection has a row; runs 1, 4, 6 and 9 are clear light, glare, rain and rain at dusk.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Final

from crosscue.datasets.scenes.layout import SCORED
from crosscue.eval.runs.folder import open_run
from crosscue.eval.scoring.runs import judge_run
from crosscue.eval.studies.intersections.figures import write_sheet

RUNS: Final = (1, 4, 6, 9)
# Quality of the JPEG, low so that its page loads quickly.
QUALITY: Final = 60


def main() -> None:
    """Draw the sheet."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("study", type=Path, help="what crosscue study intersections wrote")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="JPEG")
    parser.add_argument("--runs", type=int, nargs="+", default=list(RUNS), metavar="N")
    args = parser.parse_args()
    names = [f"{layout}-{run:02d}" for layout in SCORED for run in args.runs]
    drives = [
        judge_run(open_run(args.study / "runs" / name), args.study / "drives" / name / "truth.json")
        for name in names
    ]
    write_sheet(drives, args.output, columns=len(args.runs), quality=QUALITY)
    print(f"{args.output}: {len(drives)} drives, {args.output.stat().st_size // 1000} kB")


if __name__ == "__main__":
    main()
