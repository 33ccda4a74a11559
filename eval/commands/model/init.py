"""Write a model card for an ONNX or OpenVINO file, from what the file says of itself.

The layout of its outputs is recognised from names, shapes and metadata. What the file does not say
stands in the card as an assumption to check; where several layouts fit, they are listed.

example:
  crosscue model init my.onnx --picture street.jpg
  crosscue replay drive.mcap --vehicle car.toml --detectors my.toml
"""

from __future__ import annotations

import argparse
import re
from pathlib import Path

from crosscue.detectors.catalog.draft import Draft, draft
from crosscue.detectors.catalog.recognise import closed, guesses, plausible, read_interface
from crosscue.detectors.decoders.base import Guess, Interface
from crosscue.detectors.networks.model_detector import build
from crosscue.eval.commands.model.shared import look, pixels_of
from crosscue.eval.commands.shared.options import print_json
from crosscue.replay.base import MIB, UsageError, read_at_most, write_text


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare flags."""
    parser.add_argument("weights", type=Path, metavar="MODEL", help=".onnx, or OpenVINO .xml")
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        metavar="CARD.toml",
        help="the card, in the folder of the weights (default: their name, .toml)",
    )
    parser.add_argument("--overwrite", action="store_true", help="replace an existing card")
    parser.add_argument("--kind", metavar="KIND", help="layout of its outputs, where several fit")
    parser.add_argument(
        "--class-names",
        type=Path,
        metavar="FILE",
        help="class names, one a line, where it has none",
    )
    parser.add_argument(
        "--size", metavar="WxH", help="run at this size, such as 1280x736, where it allows any"
    )
    parser.add_argument(
        "--picture", type=Path, metavar="FILE", help="draw what it finds beside this picture"
    )
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def run(args: argparse.Namespace) -> int:
    """Write the card, then run the network with it."""
    output = args.output or args.weights.with_suffix(".toml")
    if output.exists() and not args.overwrite:
        raise UsageError(f"{output}: exists; give another name or --overwrite")
    if output.resolve().parent != args.weights.resolve().parent:
        raise UsageError(f"{output}: a card lies beside its weights, in {args.weights.parent}")
    size = _size(args.size)
    model = read_interface(args.weights)
    run_once = closed(args.weights, model, size)
    found_kinds = guesses(run_once)
    if args.kind is None and len(found_kinds) > 1:
        found_kinds = plausible(args.weights, run_once, found_kinds)
    guess = _chosen(args.weights, found_kinds, run_once, args.kind)
    written = draft(args.weights, model, guess, _names(args.class_names), size)
    if args.picture is not None:
        pixels_of(args.picture)
    _try(output, written)
    found = None
    if args.picture is not None:
        found = look(build(card=str(output)), args.picture, _drawing(args.picture))
    _report(args, output, written, None if found is None else len(found))
    return 0


def _chosen(path: Path, found: list[Guess], model: Interface, kind: str | None) -> Guess:
    """The only layout, or the one asked for.

    Raises:
        UsageError: None or several; with what the file declares.
    """
    if kind is not None:
        found = [guess for guess in found if guess.settings["kind"] == kind]
    if len(found) == 1:
        return found[0]
    if not found:
        outputs = ", ".join(f"{out.name} {_shape(out.shape)}" for out in model.outputs)
        asked = "" if kind is None else f" as {kind}"
        raise UsageError(
            f"{path}: outputs {outputs}: not known here{asked}; write a card by hand, "
            "or a detector (docs: Write a detector)"
        )
    listed = "; ".join(f"{g.settings['kind']} ({', '.join(g.reasons)})" for g in found)
    raise UsageError(f"{path}: may be {listed}; choose one with --kind")


def _shape(shape: tuple[int | str | None, ...]) -> str:
    return "x".join("?" if side is None else str(side) for side in shape)


def _names(path: Path | None) -> tuple[str, ...]:
    if path is None:
        return ()
    try:
        content = read_at_most(path, MIB)
        if content is None:
            raise UsageError(f"{path}: over 1 MiB; give class names, one a line")
        lines = content.decode("utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        why = error.strerror if isinstance(error, OSError) else "not UTF-8 text"
        raise UsageError(f"{path}: {why}; give class names, one a line") from None
    names = tuple(line.strip() for line in lines if line.strip())
    if not names:
        raise UsageError(f"{path}: no name in it; give class names, one a line")
    return names


def _size(text: str | None) -> tuple[int, int] | None:
    if text is None:
        return None
    found = re.fullmatch(r"(\d{1,4})x(\d{1,4})", text)
    if found is None:
        raise UsageError(f"--size {text}: expected WxH, such as 1280x736")
    return int(found[1]), int(found[2])


def _drawing(picture: Path) -> Path:
    return picture.with_suffix(".found.jpg")


def _try(output: Path, written: Draft) -> None:
    """Write the card once the network has run with it.

    Raises:
        VehicleError: It does not run; no card is left.
    """
    trial = output.with_name(f".{output.stem}.trial.toml")
    write_text(trial, written.text)
    try:
        build(card=str(trial))
        trial.replace(output)
    finally:
        trial.unlink(missing_ok=True)


def _report(args: argparse.Namespace, output: Path, written: Draft, boxes: int | None) -> None:
    if args.json:
        print_json(
            {
                "card": str(output),
                "kind": written.kind,
                "certain": list(written.certain),
                "assumed": list(written.assumed),
                "picture": None if args.picture is None else str(_drawing(args.picture)),
            }
        )
        return
    if args.quiet:
        return
    print(f"{output}: {written.kind}; the network runs with it")
    for line in written.certain:
        print(f"certain    {line}")
    for line in written.assumed:
        print(f"assumed    {line}")
    if args.picture is not None:
        what = "road" if boxes is None else f"{boxes} boxes"
        print(f"picture    {what}, drawn in {_drawing(args.picture)}: please check it")
