"""Draft model cards from model files, and check cards by running their networks."""

import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field, replace
from pathlib import Path
from typing import Annotated, ClassVar, Final

from crosscue.detectors.base import Detections, Detector, Frame
from crosscue.detectors.catalog.architectures import WEIGHTS_SUFFIXES
from crosscue.detectors.catalog.class_names import COCO_80, COCO_90, class_names_given
from crosscue.detectors.catalog.draft import Draft, draft_card_text
from crosscue.detectors.catalog.places import card_named
from crosscue.detectors.catalog.recognise import (
    SEMANTIC,
    closed,
    guesses,
    plausible,
    read_interface,
)
from crosscue.detectors.decoders.base import Guess, Interface, decoder_name
from crosscue.detectors.decoders.detr import with_no_object
from crosscue.detectors.decoders.table import DECODERS
from crosscue.detectors.images import decode, read_file
from crosscue.detectors.networks.model_detector import build
from crosscue.detectors.networks.trial import fault_seen, fit_doubt, input_doubt
from crosscue.detectors.overlay import encode_overlay
from crosscue.replay.columns import Bytes
from crosscue.replay.errors import LogError, UsageError, VehicleError
from crosscue.replay.files.whole_file import write_bytes, write_text
from crosscue.results import HIDDEN, Result, json_key
from crosscue.verb import Option, keywords

# Supported tasks in the metadata of Ultralytics' exports.
_TASKS: Final = ("detect", "segment", SEMANTIC)
_MAX_TASK_CHARACTERS: Final = 40


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class CardDraft(Result):
    """A drafted model card, with its assumptions to check; its text is that of ``model init``.

    Attributes:
        path: The card.
        draft: Text of the card, kind of output, and certain and assumed properties.
        picture: Copy of the picture with detections; None without a picture.
        boxes: Number of detections; None without a picture, and for a road network.
    """

    path: Path = field(metadata=json_key("card"))
    draft: Draft = field(metadata=HIDDEN)
    picture: Path | None = None
    boxes: int | None = field(default=None, metadata=HIDDEN)

    also: ClassVar = {
        "kind": "draft.kind",
        "certain": "draft.certain",
        "assumed": "draft.assumed",
    }

    def lines(self) -> Iterator[str]:
        """Yield the kind of output, what is certain and assumed, and where boxes are drawn."""
        yield f"{self.path}: {self.draft.kind}; the network runs with it"
        yield from (f"certain    {line}" for line in self.draft.certain)
        yield from (f"assumed    {line}" for line in self.draft.assumed)
        if self.picture is not None:
            what = "road" if self.boxes is None else f"{self.boxes} boxes"
            yield f"picture    {what}, drawn in {self.picture}: please check them"


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class CardCheck(Result):
    """A card that fits its network; found by ``crosscue check``.

    Attributes:
        path: The card.
        identity: Identity of the detector, unique to its card, weights and version.
        picture: Copy of the picture with detections; None without a picture.
        found: Number of detections by label; None without a picture, and for a road network.
        doubt: What the network finds if the picture is prepared otherwise, where it finds nothing
            with the card; else None.
    """

    path: Path = field(metadata=json_key("card"))
    identity: str
    picture: Path | None = None
    found: Mapping[str, int] | None = None
    doubt: str | None = None

    @property
    def exit_status(self) -> int:
        """3 where the card may prepare pictures wrongly, else 0."""
        return 0 if self.doubt is None else 3

    def lines(self) -> Iterator[str]:
        """Yield that the card fits, and what was found in the picture."""
        yield f"{self.path}: fits its network"
        if self.picture is not None:
            counts = self.found
            named = [] if counts is None else [f"{n} {name}" for name, n in counts.items()]
            text = "road" if counts is None else ", ".join(named) or "nothing"
            yield f"found      {text}; drawn in {self.picture}"
        if self.doubt is not None:
            yield f"doubt      {self.doubt}"


@dataclass(frozen=True, slots=True)
class CardSettings:
    """What a model file does not say, and where its card is written.

    Attributes:
        output: Card to write, in the folder of the weights (default: their name with .toml).
        kind: Network, or layout of its outputs, if several fit.
        class_names: Class names in the order of the outputs, for a file without them: one per line,
            or the data.yaml of YOLO.
        classes: The same names in one argument: road,curb,mark.
        first_class: Number of the first class, where a network returns numbers: 0 or 1.
        size_px: Input size, such as 1280x736, for a network that accepts any.
        picture: Draw detections in a copy of this picture, CARD.PICTURE.found.jpg next to the card.
        overwrite: Replace an existing card.
    """

    output: Annotated[Path | str | None, Option(metavar="CARD.toml")] = None
    _: KW_ONLY
    kind: Annotated[str | None, Option(metavar="KIND")] = None
    class_names: Annotated[Path, Option(metavar="FILE")] | Sequence[str] | str | None = None
    classes: Annotated[str | None, Option(metavar="NAME,NAME")] = None
    first_class: int | None = None
    size_px: Annotated[str, Option("--size", metavar="WxH")] | tuple[int, int] | None = None
    picture: Path | str | None = None
    overwrite: bool = False


@keywords(CardSettings)
def draft_card(
    weights: Annotated[Path | str, Option(metavar="MODEL")], settings: CardSettings
) -> CardDraft:
    """Write a model card for an ONNX, OpenVINO or TFLite file, or weights.

    The network, or the layout of its outputs, is recognised from names, shapes and metadata, and
    the network runs with the card before it is written. Properties that the file does not record
    are listed in the card as assumptions to check. If several kinds fit, the error lists all of
    them, for --kind. Weights are a state_dict of a torchvision network (.pth, .pt) or safetensors:
    tensors, without code.

    Examples:
        crosscue model init my.onnx --picture street.jpg
        crosscue model init weights.pth --class-names names.txt
        crosscue replay drive.mcap --vehicle car.toml --detectors my.toml -o run

    Args:
        weights: .onnx, OpenVINO .xml, .tflite, .pth, .pt or .safetensors.
        settings: What the file does not say.

    Raises:
        UsageError: The card exists, the file is damaged or of another kind, no layout or several
            layouts fit, or class names are missing.
        VehicleError: The network does not run with the card, its boxes in noise, in grey or in the
            picture cannot be right, or a weights file contains more than tensors; no card is
            written.
        LogError: The picture cannot be read or decoded.
    """
    output, class_names = settings.output, settings.class_names
    path = Path(weights)
    place = path.with_suffix(".toml") if output is None else Path(output)
    if place.exists() and not settings.overwrite:
        raise UsageError(f"{place}: exists; give another name or --overwrite")
    if place.parent.resolve() != path.parent.resolve():
        raise UsageError(f"{place}: expected a card in the folder of its weights, {path.parent}")
    if settings.classes is not None:
        if class_names is not None:
            raise UsageError("--classes and --class-names: give one of the two")
        class_names = [name.strip() for name in settings.classes.split(",")]
    names = () if class_names is None else class_names_given(class_names)
    size = _size(settings.size_px) if isinstance(settings.size_px, str) else settings.size_px
    if path.suffix.lower() in WEIGHTS_SUFFIXES:
        from crosscue.detectors.catalog.recognise_weights import recognise_weights

        model, guess = recognise_weights(path, settings.kind, size)
    else:
        model = read_interface(path)
        guess = _guess(path, closed(path, model, size), settings.kind, len(names))
    if settings.first_class is not None:
        guess = _with_first_class(guess, settings.first_class)
    written = draft_card_text(path, model, guess, names, size)
    if settings.picture is None:
        _try(place, written)
        return CardDraft(place, written)
    seen = Path(settings.picture)
    # Errors in the picture are reported before a card is written.
    pixels = _pixels_of(seen)[0]
    _try(place, written, pixels)
    detector = build(card=str(place))
    doubts = [input_doubt(detector, pixels)]
    # Ultralytics' metadata say how its networks are trained; other files do not.
    doubts += [] if model.metadata else [fit_doubt(detector, pixels)]
    for doubt in filter(None, doubts):
        written = written.with_assumption(doubt)
        write_text(place, written.text)
    found = _look(detector, seen, drawing := _drawing(place, seen))
    return CardDraft(place, written, drawing, None if found is None else len(found))


def check_card(
    model: Path | str, picture: Path | str | None = None, output: Path | str | None = None
) -> CardCheck:
    """Run a network with its card, and draw its detections in a picture.

    Args:
        model: Model card, or name in the catalog.
        picture: Run it on this JPEG, PNG or WebP file.
        output: Picture with detections to write (default: CARD.PICTURE.found.jpg, next to the card,
            or in the current folder for a model of the catalog).

    Raises:
        UsageError: The catalog has no such model.
        VehicleError: Card, weights and back end do not fit each other, or the boxes found in noise,
            in grey or in the picture cannot be right.
        LogError: The picture cannot be read or decoded.
        OutputError: The drawing cannot be written.
    """
    is_file = Path(model).is_file()
    card = Path(model) if is_file else card_named(str(model))
    detector = build(card=str(card))
    pixels = None if picture is None else _pixels_of(Path(picture))[0]
    fault = fault_seen(detector, pixels)
    if fault is not None:
        raise VehicleError(f"{card}: {fault}; correct its [input] and [output], or kind")
    if picture is None:
        return CardCheck(card, detector.identity)
    seen = Path(picture)
    place = card if is_file else Path(card.name)
    drawing = _drawing(place, seen) if output is None else Path(output)
    found = _look(detector, seen, drawing)
    counts = None if found is None else dict(Counter(found.labels))
    doubt = None if pixels is None else input_doubt(detector, pixels)
    return CardCheck(card, detector.identity, drawing, counts, doubt)


def _guess(path: Path, model: Interface, kind: str | None, names: int) -> Guess:
    """Return the requested layout of the outputs, or the only one that fits.

    Args:
        path: The model file.
        model: The interface that it declares.
        kind: The requested layout; None for the one that fits.
        names: Number of class names that the user gave, 0 without names.

    Raises:
        UsageError: No layout or several fit; the message contains the file's declarations.
    """
    task = model.metadata.get("task", "detect")[:_MAX_TASK_CHARACTERS]
    if task not in _TASKS:
        raise UsageError(
            f"{path}: task in its metadata: expected one of {', '.join(_TASKS)}, found "
            f"{task!r}; export a network that detects boxes"
        )
    given = model.inputs[0].shape if model.inputs else ()
    if len(given) == 4 and isinstance(batch := given[0], int) and batch > 1:
        raise UsageError(f"{path}: runs on {batch} pictures at once; export it for one, or any")
    if len(given) == 4 and all(isinstance(side, int) and side != 3 for side in given[1::2]):
        raise UsageError(f"{path}: input {_shape(given)}: expected a picture of three colours")
    found = guesses(model)
    if kind is not None:
        found = [guess for guess in found if guess.settings["kind"] == kind]
    if len(found) > 1:
        found = plausible(path, model, found)
        # COCO's numbers of classes, unless the user says otherwise.
        counts = (names,) if names else (len(COCO_80), len(COCO_90))
        found = [one for one in found if one.class_count in counts] or found
    if len({one.settings["kind"] for one in found}) == 1:
        # The usual way to store boxes first.
        guess = found[0]
        is_more = guess.settings["kind"] == "detr" and guess.class_count == names + 1
        return with_no_object(guess) if names and is_more and not guess.is_decided else guess
    if not found:
        outputs = ", ".join(f"{out.name} {_shape(out.shape)}" for out in model.outputs)
        asked = "" if kind is None else f" as {kind}"
        raise UsageError(
            f"{path}: outputs {outputs}: not supported{asked}; write a card by hand, "
            "or a detector (docs: Write a detector)"
        )
    listed = "; ".join(f"{g.settings['kind']} ({', '.join(g.reasons)})" for g in found)
    raise UsageError(f"{path}: several kinds fit: {listed}; choose one with --kind")


def _with_first_class(guess: Guess, first_class: int) -> Guess:
    able = {decoder_name(one): "first_class" in one.model_fields for one in DECODERS}
    if not able.get(kind := str(guess.settings["kind"])):
        kinds = ", ".join(name for name, is_able in able.items() if is_able)
        raise UsageError(f"first_class: {first_class}, expected only for {kinds}; not {kind}")
    settings = {**guess.settings, "first_class": first_class}
    # What was assumed is now known.
    assumed = [why for why in guess.assumptions if "--first-class" not in why]
    return replace(guess, settings=settings, assumptions=tuple(assumed))


def _shape(shape: tuple[int | str | None, ...]) -> str:
    return "x".join("?" if side is None else str(side) for side in shape)


def _size(text: str) -> tuple[int, int]:
    found = re.fullmatch(r"(\d{1,4})x(\d{1,4})", text)
    if found is None:
        raise UsageError(f"size_px: {text}, expected WxH, such as 1280x736")
    return int(found[1]), int(found[2])


def _drawing(card: Path, picture: Path) -> Path:
    """Return where to draw: not next to the picture, whose folder may be a log of images."""
    return card.with_name(f"{card.stem}.{picture.stem}.found.jpg")


def _try(place: Path, written: Draft, picture: Bytes | None = None) -> None:
    """Write the card if the network runs with it and finds no nonsense.

    Raises:
        VehicleError: The network does not run, or its boxes cannot be right; no card is written.
    """
    trial = place.with_name(f".{place.stem}.trial.toml")
    write_text(trial, written.text)
    try:
        fault = fault_seen(build(card=str(trial)), picture)
        if fault is None:
            trial.replace(place)
            return
    except VehicleError as error:
        said = str(error).removeprefix(f"{trial}: ").removesuffix("; correct the card")
        raise VehicleError(
            f"{place}: not written, the network does not run with it: {said}; choose another "
            "--kind or --size, or export the network again"
        ) from None
    finally:
        trial.unlink(missing_ok=True)
    raise VehicleError(
        f"{place}: not written: {fault}, so {written.kind} is not its layout; choose another "
        "--kind, write a card by hand, or a detector (docs: Write a detector)"
    )


def _pixels_of(picture: Path) -> tuple[Bytes, tuple[int, int]]:
    """Return a picture file's pixels, (H, W, 3), blue green red, and its width and height.

    Raises:
        LogError: The picture cannot be read or decoded.
    """
    try:
        return decode(read_file(picture))
    except OSError as error:
        raise LogError(f"{picture}: {error.strerror}; use a JPEG, PNG or WebP file") from None
    except LogError as error:
        raise type(error)(f"{picture}: {error}") from None


def _look(detector: Detector, picture: Path, output: Path) -> Detections | None:
    """Run a detector on one picture and draw its detections; return None for a road network.

    Raises:
        LogError: The picture cannot be read or decoded.
        OutputError: The drawing cannot be written.
    """
    pixels, size = _pixels_of(picture)
    (found,) = detector([Frame(0, "", pixels, size)])
    write_bytes(output, encode_overlay(pixels, found))
    return found if isinstance(found, Detections) else None
