"""Registry of detectors by name; each is imported only when it is used.

A name is one of ``BUILTIN``, a model of the catalog (``crosscue model list``), an entry point of
the group ``crosscue.detectors`` of an installed package, a ``module:factory``, or the file name of
a model card (``.toml``). A factory accepts the settings of the vehicle file as keyword arguments
and returns a ``Detector``; a class is its own factory. From Python, a class, a function from a
frame to its boxes, or a detector itself can take the place of a name.
"""

import difflib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from inspect import Parameter, getattr_static, isfunction, signature
from pathlib import Path
from typing import Final, cast

from crosscue.replay.errors import UsageError, VehicleError
from crosscue.replay.plugins import imported, offered

from .base import Detector, DetectorChoice
from .box_detector import FunctionDetector
from .catalog import places as catalog

# ``module:factory`` of each detector, by name.
BUILTIN: Final[Mapping[str, str]] = {
    "mask-rcnn": "crosscue.detectors.networks.mask_rcnn.detector:build",
    "model": "crosscue.detectors.networks.model_detector:build",
    "road": "crosscue.detectors.networks.road.detector:build",
    "signs": "crosscue.detectors.signs.detector:build",
}

# Detectors of the demo and the studies: embedded networks, trained on simulated scenes only.
EMBEDDED: Final = "mask-rcnn,road,signs"

# Setting that selects a network, and its default, which selects the embedded one.
_EMBEDDED_BY: Final = {"mask-rcnn": ("network", "embedded"), "road": ("checkpoint", None)}

# Endings of files with weights, which need a card.
_WEIGHTS: Final = (".onnx", ".pt", ".pth", ".safetensors", ".tflite", ".xml")

_POSITIONAL: Final = (Parameter.POSITIONAL_ONLY, Parameter.POSITIONAL_OR_KEYWORD)
# Attributes that every ``Detector`` has.
_PARTS: Final = ("view", "identity", "__call__")


def chosen(
    names: str | Sequence[object], sections: Mapping[str, DetectorChoice]
) -> tuple[DetectorChoice, ...]:
    """Return the detectors of a list such as ``cars,signs,my.toml,pack.mod:make``.

    Args:
        names: Comma-separated names, or names and detectors as classes, functions or objects.
        sections: Detectors of the vehicle file, by name; they have precedence.

    Raises:
        UsageError: The list is empty, names a detector twice, or holds something else.
    """
    listed = names.split(",") if isinstance(names, str) else names
    asked = [name.strip() if isinstance(name, str) else name for name in listed]
    asked = [name for name in asked if name != ""]
    if not asked:
        raise UsageError(f"--detectors: none named; expected some of {', '.join(known(sections))}")
    found = tuple(_choice(name, sections) for name in asked)
    if len({choice.name for choice in found}) != len(found):
        twice = ", ".join(choice.name for choice in found)
        raise UsageError(f"--detectors {twice}: one is named twice; name each once")
    return found


def _choice(name: object, sections: Mapping[str, DetectorChoice]) -> DetectorChoice:
    if not isinstance(name, str):
        return _choice_of_object(name)
    if name in sections:
        return sections[name]
    if name.endswith(".toml"):
        stem = name.replace("\\", "/").rsplit("/", 1)[-1].removesuffix(".toml")
        return DetectorChoice(stem, "model", {"card": name})
    return DetectorChoice(name, name)


def _choice_of_object(given: object) -> DetectorChoice:
    """Return the choice of a detector that is a class, a function or an object."""
    kind = given if isinstance(given, type) or isfunction(given) else type(given)
    name = getattr(given, "name", kind.__name__)
    if not callable(given):
        raise UsageError(
            f"detectors: {given!r}: expected a name, a class, a function from a frame to its "
            "boxes, or a detector"
        )
    place = f"{kind.__module__}:{kind.__qualname__}"
    choice = DetectorChoice(str(name), place, factory=_factory_from(given))
    return replace(choice, identity=make(choice).identity)


def knows_simulated_only(choice: DetectorChoice) -> bool:
    """Whether a detector runs a network that was trained on simulated scenes only."""
    if choice.kind not in _EMBEDDED_BY:
        return False
    setting, embedded = _EMBEDDED_BY[choice.kind]
    return bool(choice.settings.get(setting, embedded) == embedded)


def is_plugin(choice: DetectorChoice) -> bool:
    """Whether a detector is code of the user's: a ``module:factory`` or an entry point."""
    return choice.kind not in BUILTIN and choice.kind not in catalog.names()


def known(sections: Mapping[str, DetectorChoice]) -> list[str]:
    """List all names that can be used."""
    plugins = (point.name for point in offered("detector"))
    return sorted({*sections, *BUILTIN, *catalog.names(), *plugins})


def make(choice: DetectorChoice, table: Mapping[str, str] = BUILTIN) -> Detector:
    """Build one detector.

    Raises:
        UsageError: The detector does not exist or cannot be imported.
        VehicleError: Its settings are invalid, or the factory returns no detector.
    """
    if choice.factory is not None:
        return _built(choice, choice.factory, choice.kind)
    choice = _with_card(choice, table)
    place, factory = _factory_of(choice, table)
    if not choice.settings and (_is_of_frames(factory) or not _lacking(factory)):
        factory = _factory_from(factory)
    return _built(choice, factory, place)


def _is_of_frames(given: object) -> bool:
    """Whether a function has one argument without a default: the frame, without settings."""
    values = signature(given).parameters.values() if isfunction(given) else ()
    required = [one for one in values if one.default is one.empty and one.kind in _POSITIONAL]
    return len(required) == 1


def _lacking(given: object) -> list[str]:
    """Attributes of a detector that an object lacks; static, as a property may hash weights."""
    return [name for name in _PARTS if getattr_static(given, name, None) is None]


def _factory_from(given: object) -> Callable[..., object]:
    """Return the factory of a detector that is a class, a function of a frame or an object."""
    if isfunction(given):
        return partial(FunctionDetector, given)
    return given if isinstance(given, type) else lambda: given


def _built(choice: DetectorChoice, factory: Callable[..., object], place: str) -> Detector:
    """Build a detector with its settings, and check that it is one.

    Raises:
        VehicleError: The settings are invalid, or the factory returns no detector.
    """
    if isinstance(factory, type):
        # ``BoxDetector.build`` explains invalid settings.
        factory = getattr(factory, "build", factory)
    try:
        built = factory(**choice.settings)
    except TypeError as error:
        raise VehicleError(f"detector {choice.name}: settings do not fit: {error}") from None
    if lacking := _lacking(built):
        raise VehicleError(
            f"detector {choice.name}: {place} returned a {type(built).__name__} without "
            f"{', '.join(lacking)}; derive from crosscue.BoxDetector, or see crosscue.Detector"
        )
    return cast("Detector", built)


def check(choice: DetectorChoice, table: Mapping[str, str] = BUILTIN) -> None:
    """Refuse a detector that does not exist, without building it.

    Raises:
        UsageError: The detector does not exist or cannot be imported.
        VehicleError: Its model card or weights cannot be read.
    """
    if choice.factory is not None:
        return
    choice = _with_card(choice, table)
    _factory_of(choice, table)
    if isinstance(card := choice.settings.get("card"), str):
        # These import the decoders of all networks.
        from .catalog.card import read_card, read_weights
        from .catalog.entries import weights_folder

        path = Path(card)
        found = read_card(path)
        read_weights(found, weights_folder(found, path))


def _with_card(choice: DetectorChoice, table: Mapping[str, str]) -> DetectorChoice:
    """Return a model of the catalog as a detector with its card."""
    if choice.kind not in catalog.names() or choice.kind in table:
        return choice
    card = str(catalog.card_path(choice.kind))
    return DetectorChoice(choice.name, "model", {**choice.settings, "card": card})


def _factory_of(
    choice: DetectorChoice, table: Mapping[str, str]
) -> tuple[str, Callable[..., object]]:
    """Return the ``module:factory`` of a detector, and the imported factory."""
    place = table.get(choice.kind) or _offered(choice.kind) or choice.kind
    if ":" not in place and choice.kind.endswith(_WEIGHTS):
        raise UsageError(
            f"detector {choice.kind!r}: expected a model card (.toml); write one with crosscue "
            "model init, or name a checkpoint of crosscue train under [detectors.NAME] of a "
            "vehicle file"
        )
    if ":" not in place:
        names = known({})
        close = difflib.get_close_matches(choice.kind, names, n=1)
        hint = f"did you mean {close[0]}?" if close else f"there are: {', '.join(names)}."
        raise UsageError(f"detector {choice.kind!r}: no such name; {hint} Or use module:factory")
    return place, cast("Callable[..., object]", imported(place, "detector"))


def _offered(name: str) -> str | None:
    return next((point.value for point in offered("detector") if point.name == name), None)
