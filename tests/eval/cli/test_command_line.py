"""Parsers, help and calls come from a signature and docstring; errors name the argument."""

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, ClassVar, Final, Literal

import pytest

import crosscue
from crosscue.eval.command_line import Call, fill, with_options
from crosscue.eval.terminal import print_found
from crosscue.replay.errors import UsageError
from crosscue.results import Result, json_key
from crosscue.verb import HIDDEN, Option, compared, keywords
from support.refusals import refusal


@dataclass(frozen=True, slots=True, repr=False)
class Filled(Result):
    """Arguments that the verb was called with."""

    boxes: tuple[Path, ...] = field(metadata=json_key("box_files"))
    width_m: float
    colour: str
    label: str
    is_open: bool
    seen: tuple[str, ...]

    formats: ClassVar = {"csv": "print the result as CSV"}

    def csv(self) -> str:
        """Return the result as CSV."""
        return f"{self.colour},{self.width_m}"


@dataclass(frozen=True, slots=True)
class Shape:
    """Shape of a box.

    Attributes:
        width_m: Width of a box, in percent of nothing; 100 % of it.
        colour: Colour of a box.
        workers: Number of workers.
    """

    width_m: float = 2.5
    colour: Literal["red", "blue"] = "red"
    workers: int = field(default=1, compare=False)

    def __post_init__(self) -> None:
        """Refuse no workers."""
        if self.workers < 1:
            raise UsageError(f"workers: {self.workers}, expected 1 or more")


def labelled(label: Annotated[str, Option("--from", metavar="L")] = "x") -> str:
    """Make a label.

    Args:
        label: Label of all boxes.
    """
    return f"<{label}>"


@keywords(Shape)
def pack(boxes: Sequence[Path], shape: Shape) -> Filled:
    """Pack boxes into a bag.

    Args:
        boxes: Files of boxes.
        shape: Shape of a box.
    """
    return Filled(tuple(boxes), shape.width_m, shape.colour, "", False, ())


def pack_all(
    boxes: Sequence[Path],
    shape: Shape,
    label: Annotated[str, Option(made_by=labelled)] = "",
    *,
    has_lid: bool = True,
    is_open: bool = False,
    seen: Sequence[str] = (),
    inner: Annotated[int, HIDDEN] = 3,
) -> Filled:
    """Pack boxes into a bag.

    The bag is ``closed``.

    Examples:
        crosscue pack a.box

    Args:
        boxes: Files of boxes.
        shape: Shape of a box.
        label: The label.
        has_lid: Do not close the bag.
        is_open: Leave the bag open.
        seen: Names of boxes.
        inner: Not on the command line.
    """
    if shape.width_m <= 0.0:
        raise UsageError(f"width_m: {shape.width_m}, expected more than 0")
    if is_open and not has_lid:
        raise UsageError("is_open, has_lid: expected one of them")
    return Filled(tuple(boxes), shape.width_m, shape.colour, label, is_open, tuple(seen))


def parsed(words: str) -> tuple[Call, argparse.ArgumentParser, argparse.Namespace]:
    """Parse a command line of ``pack_all``."""
    parser = argparse.ArgumentParser(formatter_class=argparse.RawDescriptionHelpFormatter)
    call = fill(parser, pack_all)
    return call, parser, parser.parse_args(words.split())


def test_options_become_arguments_with_defaults() -> None:
    call, _, args = parsed("a.box b.box --from y --width-m 4 --colour blue --seen x y")

    assert call(args) == Filled(
        (Path("a.box"), Path("b.box")), 4.0, "blue", "<y>", False, ("x", "y")
    )
    assert call(parsed("a.box")[2]) == Filled((Path("a.box"),), 2.5, "red", "<x>", False, ())


def test_help_comes_from_the_docstrings() -> None:
    _, parser, _ = parsed("a.box")
    text = parser.format_help()

    assert (
        "Pack boxes into a bag.\n\nThe bag is closed.\n\nexamples:\n  crosscue pack a.box" in text
    )
    assert "width of a box, in percent of nothing; 100 % of it" in text
    assert "(default: 2.5)" in text
    assert "number of workers (default: 1)" in text
    assert "--width-m M" in text
    assert "--colour {red,blue}" in text
    assert "--from L" in text
    assert "--without-lid" in text
    assert "inner" not in text


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("a --width-m -1", "--width-m -1.0: expected more than 0"),
        ("a --is-open --without-lid", "--is-open, --without-lid: expected one of them"),
    ],
)
def test_errors_about_arguments_name_options(words: str, message: str) -> None:
    call, parser, args = parsed(words)

    with pytest.raises(UsageError) as error:
        call(args)

    assert with_options(str(error.value), parser) == message


def test_function_takes_fields_of_its_record_as_keywords() -> None:
    found = pack([Path("a")], colour="blue")

    assert (found.colour, found.width_m) == ("blue", 2.5)
    assert "    colour: Colour of a box." in (pack.__doc__ or "")
    assert "    shape:" not in (pack.__doc__ or "")
    with pytest.raises(TypeError, match="size"):
        pack([], size=3)  # type: ignore[call-arg]


def test_only_settings_that_determine_a_result_are_compared() -> None:
    assert compared(Shape(workers=3)) == {"width_m": 2.5, "colour": "red"}


@pytest.mark.parametrize(
    ("words", "printed"),
    [("a --csv", "red,2.5\n"), ("a --csv -q", ""), ("a", "box files  a\nwidth m    2.5\n")],
)
def test_result_is_printed_in_the_chosen_format(
    words: str, printed: str, capsys: pytest.CaptureFixture[str]
) -> None:
    call, parser, _ = parsed("a")
    parser.add_argument("-q", dest="quiet", action="store_true")
    parser.set_defaults(verbose=False)
    args = parser.parse_args(words.split())

    assert print_found(call(args), args) == 0

    assert capsys.readouterr().out.startswith(printed)


def test_undescribed_parameter_is_refused() -> None:
    def verb(*, size: int = 1) -> Filled:
        """Do it."""
        raise AssertionError

    with pytest.raises(TypeError, match="no description of size"):
        fill(argparse.ArgumentParser(), verb)


@dataclass(frozen=True, slots=True, repr=False)
class _Long(Result):
    count: int
    max_lines: ClassVar[int] = 25

    def lines(self) -> Iterator[str]:
        yield from map(str, range(self.count))

    def closing(self) -> Iterator[str]:
        yield "report R"


@pytest.mark.parametrize("count", [0, 1, 23, 24, 25, 26, 200])
def test_brief_text_is_the_first_lines_and_the_files_to_open(count: int) -> None:
    found = _Long(count)
    brief, whole = found.brief().splitlines(), repr(found).splitlines()

    assert len(whole) == count + 1
    assert len(brief) <= 25
    assert brief[-1] == whole[-1] == "report R"
    if brief != whole:
        shown = brief[:-2]
        assert shown == whole[: len(shown)]
        assert brief[-2] == f"... and {count - len(shown)} lines more: add -v"


def test_error_names_the_argument_of_a_function_and_the_option_of_its_command() -> None:
    with pytest.raises(crosscue.UsageError, match=r"^bin_m: -1, expected more than 0"):
        crosscue.fit_ranges("stop_sign", "gone.csv", bin_m=-1.0)

    line = "fit ranges gone.csv --cue stop_sign --bin-m -1"
    assert "--bin-m -1: expected more than 0" in refusal(2, *line.split())


# Command lines with a wrong value, and what the error says; no file that they name exists.
LINES: Final[dict[str, str]] = {
    "fit ranges --cue stop_sign": "--truth: expected drives",
    "fit ranges --cue stop_sign --truth a b --runs run": "--runs: got 1 for 2",
    "fit signs gone --label stop --test-every 0": "--test-every 0: expected 1 or more",
    "fit landmarks --pairs gone --false-match-rate 1": "--false-match-rate 1: expected 0 or more",
    "fit detector gone --labels labels --hold-out 1": "--hold-out 1.0: expected above 0",
    "fit detector gone --labels labels --test other": (
        "--test-labels: got 0 for 1; expected one for each run"
    ),
    "fit temporal a b --truth truth.json": "--truth: 2 runs, 1 truth files",
    "failures run --top 0": "--top 0: expected 1 or more",
    "failures run --threshold 0.4": "--threshold 0.4: expected 0.5 to 1",
    "failures run --workers 0": "--workers 0: expected 1 or more",
    "failures run -o x.csv": "expected a name that ends in",
    "status a a": "each named once",
    "tag weather=rain": "no run named",
    "view run -o drive.mp4": "expected a name that ends in .rrd",
    "landmarks list db --limit=-1": "--limit -1: expected 0 or more",
    "landmarks match db x.png --best=0": "--best 0: expected 1 or more",
    "landmarks list db --near=1,2": "expected x,y,radius in metres",
    "landmarks list db --near=a,b,c": "expected x,y,radius in metres",
    "landmarks add db": "expected LOG... with --poses",
    "landmarks add db --every=far": "--every",
    "study intersections -o out --layouts A,Z": "expected some of A to H, each once",
    "study intersections -o out --runs 0": "expected 1 or more",
    "study intersections -o out --width 100": "expected a multiple of 16",
    "info x.mcap --max-chunk -1": "expected MiB",
}


@pytest.mark.parametrize("line", LINES)
def test_wrong_value_is_refused_in_one_line_before_anything_is_read(
    line: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)

    assert LINES[line] in refusal(2, *line.split())
    assert not list(tmp_path.iterdir())
