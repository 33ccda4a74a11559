"""Report of a run whose truth is unknown."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from crosscue.eval.pipeline.run import PicturedRun, run_given
from crosscue.eval.report.page import REPORT, write_report_without_truth
from crosscue.eval.runs.folder import locked
from crosscue.replay.errors import OutputError, UsageError
from crosscue.results import HIDDEN, Result


@dataclass(frozen=True, slots=True, repr=False)
class UnscoredReport(Result):
    """The page of a run.

    Attributes:
        report: The file.
        is_whole: True if nothing was dropped in the run.
    """

    report: Path
    is_whole: bool = field(metadata=HIDDEN)

    def lines(self) -> Iterator[str]:
        """Yield the name of the file."""
        yield str(self.report)


def report(
    run: PicturedRun,
    *,
    output: Path | None = None,
    threshold: float = 0.9,
    overwrite: bool = False,
) -> UnscoredReport:
    """Write a page on what a run found, without a truth.

    The page shows what was found, where and how sure, with pictures of the moments that matter.
    With a truth, crosscue score writes the same page with what is right and wrong.

    Examples:
        crosscue report runs/drive                  writes runs/drive/report.html
        crosscue report runs/drive -o drive.html --threshold 0.8

    Args:
        run: Run folder.
        output: The page (default: report.html in the run, replaced if it exists).
        threshold: Probability above which a feature is believed.
        overwrite: Replace an existing file.

    Raises:
        UsageError: The threshold is not a probability.
        OutputError: The output file exists.
        RunError: The run cannot be read.
    """
    if not 0.0 < threshold < 1.0:
        raise UsageError(f"threshold: {threshold:g}, expected more than 0 and less than 1")
    if output is not None and output.exists() and not overwrite:
        raise OutputError(f"{output}: exists; give another name or --overwrite")
    of = run_given(run)
    path = of.folder.file(REPORT) if output is None else output
    with locked(of.folder):
        write_report_without_truth(of.folder, path, threshold)
    return UnscoredReport(path, of.manifest.account.is_whole)
