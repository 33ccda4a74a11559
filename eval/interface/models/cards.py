"""Draft model cards from model files, and check cards by running their networks."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from crosscue.datasets.truth.box_labels import class_names_given
from crosscue.detectors.base import Detections, Detector, Frame
from crosscue.detectors.catalog.architectures import WEIGHTS_SUFFIXES
from crosscue.detectors.catalog.draft import Draft, draft_card_text
from crosscue.detectors.catalog.places import card_named
from crosscue.detectors.catalog.recognise import closed, guesses, plausible, read_interface
from crosscue.detectors.decoders.base import Guess, Interface
from crosscue.detectors.images import decode, read_file
from crosscue.detectors.networks.model_detector import build
from crosscue.detectors.networks.trial import fault_seen
from crosscue.detectors.overlay import encode_overlay
from crosscue.replay.columns import Bytes
from crosscue.replay.errors import LogError, UsageError, VehicleError
from crosscue.replay.files.whole_file import write_bytes, write_text

# Supported tasks in the metadata of Ultralytics' exports.
_TASKS: Final = ("detect", "segment")
_MAX_TASK_CHARACTERS: Final = 40


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class CardDraft:
    """A drafted model card, with its assumptions to check.

    Attributes:
        path: The card.
        draft: Text of the card, kind of output, and certain and assumed properties.
        picture: Copy of the picture with detections; None without a picture.
        boxes: Number of detections; None without a picture, and for a road network.
    """

    path: Path
    draft: Draft
    picture: Path | None = None
    boxes: int | None = None

    def as_dict(self) -> dict[str, object]:
        """Return the JSON output of ``crosscue model init``."""
        return {
            "card": str(self.path),
            "kind": self.draft.kind,
            "certain": list(self.draft.certain),
            "assumed": list(self.draft.assumed),
            "picture": None if self.picture is None else str(self.picture),
        }

    def __repr__(self) -> str:
        lines = [f"{self.path}: {self.draft.kind}; the network runs with it"]
        lines += [f"certain    {line}" for line in self.draft.certain]
        lines += [f"assumed    {line}" for line in self.draft.assumed]
        if self.picture is not None:
            what = "road" if self.boxes is None else f"{self.boxes} boxes"
            lines.append(f"picture    {what}, drawn in {self.picture}: please check them")
        return "\n".join(lines)


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class CardCheck:
    """A card that fits its network.

    Attributes:
        path: The card.
        identity: Identity of the detector, unique to its card, weights and version.
        picture: Copy of the picture with detections; None without a picture.
        found: Number of detections by label; None without a picture, and for a road network.
    """

    path: Path
    identity: str
    picture: Path | None = None
    found: Mapping[str, int] | None = None

    def as_dict(self) -> dict[str, object]:
        """Return the JSON output of ``crosscue model check``."""
        result: dict[str, object] = {"card": str(self.path), "identity": self.identity}
        if self.picture is not None:
            result["picture"] = str(self.picture)
            result["found"] = None if self.found is None else dict(self.found)
        return result

    def __repr__(self) -> str:
        fits = f"{self.path}: fits its network"
        if self.picture is None:
            return fits
        counts = self.found
        text = "road" if counts is None else ", ".join(f"{n} {name}" for name, n in counts.items())
        return f"{fits}\nfound      {text or 'nothing'}; drawn in {self.picture}"


def draft_card(
    weights: Path | str,
    output: Path | str | None = None,
    *,
    kind: str | None = None,
    class_names: Sequence[str] | Path | str | None = None,
    classes: str | None = None,
    size_px: tuple[int, int] | str | None = None,
    picture: Path | str | None = None,
    overwrite: bool = False,
) -> CardDraft:
    """Write a model card from the contents of a model file, and run the network with it.

    Args:
        weights: An ONNX file, an OpenVINO ``.xml``, or the ``state_dict`` of a torchvision network
            (``.pth``, ``.pt``, ``.safetensors``).
        output: Card to write, in the folder of the weights; default: their name with ``.toml``.
        kind: Layout of the outputs, or torchvision's name of the network, if several fit.
        class_names: Names in the order of the outputs, or a file with one name per line, if the
            model file has none.
        classes: The same names as text, separated by commas: ``road,curb,mark``.
        size_px: Width and height of the input, also as text, ``1280x736``, if the network accepts
            any.
        picture: Picture to detect in; a copy with detections is written next to the card, as
            ``CARD.PICTURE.found.jpg``.
        overwrite: Replace an existing card.

    Raises:
        UsageError: The card exists, the file is damaged or of another kind, no layout or several
            layouts fit, or class names are missing.
        VehicleError: The network does not run with the card, its boxes in noise, in grey or in the
            picture cannot be right, or a weights file contains more than tensors; no card is
            written.
        LogError: The picture cannot be read or decoded.
    """
    path = Path(weights)
    place = path.with_suffix(".toml") if output is None else Path(output)
    if place.exists() and not overwrite:
        raise UsageError(f"{place}: exists; give another name or --overwrite")
    if place.resolve().parent != path.resolve().parent:
        raise UsageError(f"{place}: expected a card in the folder of its weights, {path.parent}")
    if classes is not None:
        if class_names is not None:
            raise UsageError("--classes and --class-names: give one of the two")
        class_names = [name.strip() for name in classes.split(",")]
    size = _size(size_px) if isinstance(size_px, str) else size_px
    if path.suffix.lower() in WEIGHTS_SUFFIXES:
        from crosscue.detectors.catalog.recognise_weights import recognise_weights

        model, guess = recognise_weights(path, kind, size)
    else:
        model = read_interface(path)
        guess = _guess(path, closed(path, model, size), kind)
    written = draft_card_text(
        path, model, guess, () if class_names is None else class_names_given(class_names), size
    )
    if picture is None:
        _try(place, written)
        return CardDraft(place, written)
    seen = Path(picture)
    # Errors in the picture are reported before a card is written.
    _try(place, written, _pixels_of(seen)[0])
    found = _look(build(card=str(place)), seen, drawing := _drawing(place, seen))
    return CardDraft(place, written, drawing, None if found is None else len(found))


def check_card(
    model: Path | str, picture: Path | str | None = None, output: Path | str | None = None
) -> CardCheck:
    """Check that a model card fits its network, by running it.

    Args:
        model: Name in the catalog, or file name of a card, which ends in ``.toml``.
        picture: JPEG, PNG or WebP file to detect in.
        output: Copy of the picture with detections; default: ``CARD.PICTURE.found.jpg`` next to the
            card, or in the current folder for a model of the catalog.

    Raises:
        UsageError: The catalog has no such model.
        VehicleError: Card, weights and back end do not fit each other, or the boxes found in noise,
            in grey or in the picture cannot be right.
        LogError: The picture cannot be read or decoded.
        OutputError: The drawing cannot be written.
    """
    card = card_named(str(model))
    detector = build(card=str(card))
    pixels = None if picture is None else _pixels_of(Path(picture))[0]
    fault = fault_seen(detector, pixels)
    if fault is not None:
        raise VehicleError(f"{card}: {fault}; correct its [input] and [output], or kind")
    if picture is None:
        return CardCheck(card, detector.identity)
    seen = Path(picture)
    place = card if Path(str(model)).suffix == ".toml" else Path(card.name)
    drawing = _drawing(place, seen) if output is None else Path(output)
    found = _look(detector, seen, drawing)
    counts = None if found is None else dict(Counter(found.labels))
    return CardCheck(card, detector.identity, drawing, counts)


def _guess(path: Path, model: Interface, kind: str | None) -> Guess:
    """Return the requested layout of the outputs, or the only one that fits.

    Raises:
        UsageError: No layout or several fit; the message contains the file's declarations.
    """
    task = model.metadata.get("task", "detect")[:_MAX_TASK_CHARACTERS]
    if task not in _TASKS:
        raise UsageError(
            f"{path}: task in its metadata: expected one of {', '.join(_TASKS)}, found "
            f"{task!r}; export a network that detects boxes"
        )
    found = guesses(model)
    if kind is not None:
        found = [guess for guess in found if guess.settings["kind"] == kind]
    elif len(found) > 1:
        found = plausible(path, model, found)
    if len(found) == 1:
        return found[0]
    if not found:
        outputs = ", ".join(f"{out.name} {_shape(out.shape)}" for out in model.outputs)
        asked = "" if kind is None else f" as {kind}"
        raise UsageError(
            f"{path}: outputs {outputs}: not supported{asked}; write a card by hand, "
            "or a detector (docs: Write a detector)"
        )
    listed = "; ".join(f"{g.settings['kind']} ({', '.join(g.reasons)})" for g in found)
    raise UsageError(f"{path}: several kinds fit: {listed}; choose one with --kind")


def _shape(shape: tuple[int | str | None, ...]) -> str:
    return "x".join("?" if side is None else str(side) for side in shape)


def _size(text: str) -> tuple[int, int]:
    found = re.fullmatch(r"(\d{1,4})x(\d{1,4})", text)
    if found is None:
        raise UsageError(f"--size {text}: expected WxH, such as 1280x736")
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
