"""Draft a model card from a model file, with a list of what had to be assumed."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import tomlkit

from crosscue.detectors.decoders.base import DEFAULT_SCORE, Guess, Interface
from crosscue.replay.errors import UsageError

from .class_names import COCO_80, COCO_90, cue_label
from .recognise import input_settings, size_in
from .segmentation import drivable

_LINE: Final = 100
_VERSION: Final = "version = 1"
_ASSUMED: Final = "# Assumed, please check: {}."
_DECODE: Final = 'decode = "full"  # as scripts around networks do; "reduced" is faster'
# Number of classes for which a pose export without metadata is taken. Its columns are a box, a
# score (in YOLOv7 also a class) and 17 points with x, y and visibility.
_POSE_CLASSES: Final[Mapping[object, int]] = {"yolov5": 52, "yolov8": 52}
# Names of a background class, which no detection has.
_NOTHING: Final = ("background", "bg")


@dataclass(frozen=True, slots=True)
class Draft:
    """A card's text, with the facts and the assumptions behind it.

    Attributes:
        text: The card in TOML.
        kind: Kind of the output.
        certain: Facts from the file.
        assumed: Assumptions, for the user to check.
    """

    text: str
    kind: str
    certain: tuple[str, ...]
    assumed: tuple[str, ...]

    def with_assumption(self, why: str) -> Draft:
        """Return the draft with one more assumption, also in the card."""
        text = self.text.replace(_VERSION, f"{_ASSUMED.format(why)}\n{_VERSION}", 1)
        return replace(self, text=text, assumed=(*self.assumed, why))


def draft_card_text(
    path: Path,
    model: Interface,
    guess: Guess,
    names: Sequence[str] = (),
    size_px: tuple[int, int] | None = None,
) -> Draft:
    """Draft a card.

    Args:
        path: The model file.
        model: The interface that the file declares.
        guess: The layout of its output.
        names: Class names, where the file has none.
        size_px: Width and height of the input, where they are variable.

    Raises:
        UsageError: The class names are missing, or their number differs from the output's.
    """
    certain = list(guess.reasons) if guess.is_decided else []
    suggested = () if guess.is_decided else guess.reasons
    assumed = [*(f"{guess.settings['kind']}: {why}" for why in suggested), *guess.assumptions]
    classes = _classes(path, model, guess, names, certain, assumed)
    given = _input(model, guess, size_px, certain, assumed)
    output: dict[str, object]
    if guess.settings["kind"] == "segmentation":
        road, labels = _road(path, classes, assumed), {}
        output = {**guess.settings, "classes": classes, "road": road}
    else:
        output = {**guess.settings, "score": DEFAULT_SCORE, "classes": classes}
        labels = {name: label for name in classes if (label := cue_label(name)) and label != name}
    lines = [
        f"# Written by crosscue model init for {path.name}.",
        *(f"# Found in the file: {reason}." for reason in certain),
        *map(_ASSUMED.format, assumed),
        _VERSION,
        f"weights = {_value(path.name)}",
        f'sha256 = "{hashlib.sha256(path.read_bytes()).hexdigest()}"',
    ]
    second = path.with_suffix(".bin")
    if path.suffix == ".xml" and second.exists():
        lines.append(f'sha256_bin = "{hashlib.sha256(second.read_bytes()).hexdigest()}"')
    licence = model.metadata.get("license", "")
    lines += [
        f"licence = {_value(licence)}" + ("" if licence else "  # not in the file"),
        "",
        "[input]",
        *_table(given),
        *([_DECODE] if guess.network is None else []),
        "",
        "[output]",
        *_table(output),
    ]
    if guess.network is not None:
        lines += ["", "[network]  # what the weights are for", *_table(guess.network)]
    if labels:
        lines += ["", "[labels]  # what a class means to the cues", *_table(labels)]
    return Draft(
        "\n".join(lines) + "\n", str(guess.settings["kind"]), tuple(certain), tuple(assumed)
    )


def _classes(
    path: Path,
    model: Interface,
    guess: Guess,
    names: Sequence[str],
    certain: list[str],
    assumed: list[str],
) -> tuple[str, ...]:
    count = guess.class_count
    is_road = guess.settings["kind"] == "segmentation"
    if is_road and count is not None and len(names) == count - 1:
        assumed.append("class 0 is the background")
        return ("background", *names)
    if (
        not is_road
        and count is not None
        and len(names) == count + 1
        and names[0].strip("_").lower() in _NOTHING
    ):
        names = names[1:]
    if names:
        if count is not None and len(names) != count:
            raise UsageError(f"{path}: {count} classes, but {len(names)} class names were passed")
        return tuple(names)
    if model.class_names and count in (None, len(model.class_names)):
        certain.append(f"{len(model.class_names)} class names in its metadata")
        return model.class_names
    usual = COCO_90 if guess.numbers_as_coco else COCO_80
    for known in (COCO_80, COCO_90) if not is_road else ():
        is_unsaid = count is None and known is usual and not guess.needs_names
        if count == len(known) or is_unsaid:
            unsaid = "" if count else "; the file does not say how many it has (--class-names FILE)"
            assumed.append(f"the {len(known)} classes are COCO's, in its order{unsaid}")
            return known
    if count == len(COCO_90) + 1 and not is_road:
        assumed.append("the 91 classes are COCO's numbers, 0 unused")
        return ("unused 0", *COCO_90)
    if guess.settings["kind"] in _POSE_CLASSES and count == _POSE_CLASSES[guess.settings["kind"]]:
        raise UsageError(
            f"{path}: {guess.reasons[0]}, as those of a network for poses (a person's box and 17 "
            "points); export a network that detects boxes, or name the classes: --class-names FILE"
        )
    raise UsageError(
        f"{path}: {count or 'its'} classes without names; name them in their order, such as "
        f"--classes {'road,curb,mark' if is_road else 'car,truck'}, or one per line in "
        "--class-names FILE"
    )


def _road(path: Path, classes: Sequence[str], assumed: list[str]) -> tuple[str, ...]:
    found = drivable(classes)
    if not found:
        raise UsageError(
            f"{path}: none of the classes {', '.join(classes)} is known to be drivable; name that "
            "class road"
        )
    assumed.append(f"drivable are: {', '.join(found)} (output.road)")
    return found


def _input(
    model: Interface,
    guess: Guess,
    size_px: tuple[int, int] | None,
    certain: list[str],
    assumed: list[str],
) -> dict[str, object]:
    if guess.network is not None:
        return dict(guess.input or {})
    usual = input_settings(model, guess)
    declared = model.declared_px
    given: dict[str, object] = {}
    width, height = size_px or declared
    if size_px is not None:
        if None not in declared and declared != size_px:
            given["is_resizable"] = True
            assumed.append("the network is fully convolutional, so it may run at another size")
    elif width is not None and height is not None:
        certain.append(f"its input is {width} x {height}")
    else:
        width, height = size_in(model.metadata) or guess.usual_size_px
        assumed.append(f"its input size is variable; {width} x {height} (--size WxH)")
    if (limits := model.inputs[0].limits) and usual.get("scale") != (guess.input or {}).get(
        "scale"
    ):
        certain.append(f"its input is quantised for {limits[0]:.3g} to {limits[1]:.3g}")
    if "colour" in usual and not model.class_names:
        assumed.append(f"colours are {usual['colour']}, pictures fitted by {usual.get('fit')}")
    return {"width_px": width, "height_px": height, **usual, **given}


def _value(value: object) -> str:
    """Format a TOML value; long lists are broken into several lines."""
    if isinstance(value, tuple | list):
        items = [_value(one) for one in value]
        line = f"[{', '.join(items)}]"
        return line if len(line) < _LINE - 20 else _over_lines(items)
    return tomlkit.item(value).as_string()


def _over_lines(items: Sequence[str]) -> str:
    lines, current = [], " "
    for item in items:
        if len(current) + len(item) + 2 > _LINE:
            lines.append(current)
            current = " "
        current += f" {item},"
    return "\n".join(["[", *lines, current, "]"])


def _table(values: Mapping[str, object]) -> list[str]:
    return [f"{_key(name)} = {_value(value)}" for name, value in values.items()]


def _key(name: str) -> str:
    return name if name.isidentifier() else _value(name)
