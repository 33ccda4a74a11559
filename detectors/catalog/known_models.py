"""The model catalog: list models, show their cards, and fetch their weights."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar, Final

from crosscue.detectors.catalog.card import Evidence, ModelCard, read_card
from crosscue.detectors.catalog.class_names import CUE_LABELS
from crosscue.detectors.catalog.entries import entry, weights_path
from crosscue.detectors.catalog.fetch import FetchedFile, fetch_weights
from crosscue.detectors.catalog.places import card_named, names
from crosscue.replay.errors import UsageError
from crosscue.replay.progress import Progress, emit
from crosscue.results import Listing, Result
from crosscue.verb import Option

# Networks to begin with: of objects, and of road.
OBJECTS: Final = "yolox-nano"
ROAD: Final = "road-segmentation-adas-0001"
# CPU time in ms of one image of 1920 x 1080, on one core of a Xeon at 2.1 GHz.
_COST_MS: Final = {OBJECTS: 85, ROAD: 85}


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Model(Result):
    """A network described by a card; its text is the output of ``crosscue model show``.

    Attributes:
        name: Name in the catalog, or file name of the card.
        card: Input, meaning of the output, and measured performance.
    """

    name: str
    card: ModelCard

    json_is: ClassVar = "card"

    @property
    def size_mb(self) -> float:
        """Size of the published weights, in 10^6 bytes."""
        return sum(file.size_bytes for file in self.card.files) / 1e6

    @property
    def is_fetched(self) -> bool:
        """True if all published weights are on this machine."""
        return all(weights_path(self.card, file).exists() for file in self.card.files)

    @property
    def cue_labels(self) -> list[str]:
        """Labels of its classes that a default cue uses, sorted."""
        card = self.card
        meant = {card.meaning(i) for i in range(len(card.output.classes))}
        return sorted(meant & {*CUE_LABELS})

    def lines(self) -> Iterator[str]:
        """Yield the origin of the network, its input and output, and what was measured."""
        card, given = self.card, self.card.input
        resizable = ", resizable" if given.is_resizable else ""
        network = "" if card.network is None else f"{card.network.architecture}, "
        decoded = given.decode if card.network is None else "full"
        cues = ", ".join(self.cue_labels) or "no default cue uses any of its classes"
        yield f"{self.name}: {card.about or 'no description'}"
        yield f"licence    {card.licence or 'not named'}"
        yield f"source     {card.source or 'not named'}"
        yield f"weights    {card.weights}, SHA-256 {card.sha256}"
        yield (
            f"input      {given.width_px} x {given.height_px}{resizable}, {given.colour}, "
            f"{given.fit}, JPEGs decoded {decoded}"
        )
        yield f"output     {network}{card.output.kind}, {len(card.output.classes)} classes"
        yield f"cues       {cues}"
        yield from (f"evidence   {_evidence(one)}" for one in card.evidence)
        if not card.evidence:
            yield "evidence   nothing measured yet"


def _evidence(one: Evidence) -> str:
    """Return a measurement as one line."""
    interval = "" if one.low is None else f" ({one.low:g} to {one.high:g})"
    boxes = "" if one.boxes is None else f", {one.boxes:,} boxes"
    facts = [f"{one.metric}: {one.value:g}{interval} on {one.pictures}{boxes}"]
    facts += [f"at {one.input}"] if one.input else []
    facts += [text for text in (one.measured, one.note) if text]
    return "; ".join(facts)


class Models(Listing[Model]):
    """Models; its repr has one line per model."""

    head = ("name", "size_mb", "licence", "state", "about")

    def cells(self, row: Model) -> tuple[str, ...]:
        """Return the cells of a row."""
        state = "fetched" if row.is_fetched else "not fetched"
        return (row.name, f"{row.size_mb:.1f}", row.card.licence, state, row.card.about)

    def as_dict(self) -> list[dict[str, object]]:
        """Return the JSON output of ``crosscue model list``."""
        return [
            {
                "name": one.name,
                "about": one.card.about,
                "kind": one.card.output.kind,
                "licence": one.card.licence,
                "size_mb": one.size_mb,
                "is_fetched": one.is_fetched,
            }
            for one in self
        ]

    def lines(self) -> Iterator[str]:
        """Yield one line for each model."""
        for one in self:
            yield "{:34} {:>6} MB  {:12} {:12} {}".format(*self.cells(one))


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class FetchedModel(Result):
    """Weights of a model on this machine; its repr has one line per file.

    Attributes:
        name: Name of the model.
        files: Path and origin of each file.
    """

    name: str
    files: tuple[FetchedFile, ...]

    json_is: ClassVar = "paths"

    @property
    def paths(self) -> dict[str, list[Path]]:
        """Paths of the files, by the model's name."""
        return {self.name: [file.path for file in self.files]}

    def lines(self) -> Iterator[str]:
        """Yield one line for each file."""
        yield from (f"{self.name}: {file.path} (from {file.came_from})" for file in self.files)


class FetchedModels(Listing[FetchedModel]):
    """Models whose weights are on this machine."""

    head = ("name", "files")
    is_printed_in_parts = True

    def cells(self, row: FetchedModel) -> tuple[object, ...]:
        """Return the cells of a row."""
        return (row.name, len(row.files))

    def as_dict(self) -> dict[str, object]:
        """Return the paths of the files, by the model's name."""
        return {name: paths for one in self for name, paths in one.as_dict().items()}


def models() -> Models:
    """List the networks of the catalog.

    Examples:
        crosscue model list
    """
    return Models([Model(name, entry(name)) for name in names()])


def model(name: Annotated[Path | str, Option(metavar="MODEL")]) -> Model:
    """Show a network's origin, classes and measurements.

    The cues' labels of its classes, and its measured performance, are part of it.

    Examples:
        crosscue model show yolox-nano
        crosscue model show my.toml --json

    Args:
        name: Name in the catalog, or model card.

    Raises:
        UsageError: The catalog has no such model; the message suggests the nearest.
        VehicleError: The card cannot be read, or a key or value is not valid; the message names the
            line.
    """
    return Model(str(name), read_card(card_named(str(name))))


def road_sections() -> str:
    """Return sections of a vehicle file that find objects and road, with the networks' costs."""
    lines = [
        f"# Networks of the catalog: crosscue model fetch {OBJECTS} {ROAD}; pip install openvino"
    ]
    for name, cost_ms in _COST_MS.items():
        one = Model(name, entry(name))
        lines.append(
            f"# {name}: {one.card.about}; {one.card.licence}, {one.size_mb:.1f} MB, about "
            f"{cost_ms} ms of CPU time per image."
        )
    for name in _COST_MS:
        lines += ["", f"[detectors.{name}]", f'kind = "{name}"']
    return "\n".join(lines) + "\n"


def fetch_model(name: str, weights: Path | str | None = None) -> FetchedModel:
    """Fetch the weights of a model of the catalog, and verify them by their SHA-256.

    They are kept in the user's cache, or in ``$CROSSCUE_MODELS``. Sources are, in this order,
    ``weights``, ``$CROSSCUE_DATA``, ``$CROSSCUE_MODEL_MIRROR`` and the publisher.

    Args:
        name: Name in the catalog.
        weights: File, or folder with the files, to copy instead of downloading.

    Raises:
        UsageError: The model does not exist, or ``weights`` is missing or another file.
        CrosscueError: A file cannot be downloaded, or its SHA-256 differs from the catalog's.
        OutputError: The cache cannot be written.
    """

    def show(file: str, done: int, of: int) -> None:
        emit(Progress(file, done / 1e6, of / 1e6, "MB"))

    given = None if weights is None else Path(weights)
    return FetchedModel(name, tuple(fetch_weights(name, given, show)))


def fetch_models(
    *names: Annotated[str, Option(metavar="MODEL")],
    weights: Annotated[Path | None, Option("--from")] = None,
) -> FetchedModels:
    """Fetch the weights of a network of the catalog.

    They are downloaded and verified by their SHA-256. Files that exist below $CROSSCUE_DATA/weights
    are copied from there. An interrupted download continues where it stopped.
    $CROSSCUE_MODEL_MIRROR is a server to download from instead of the publisher's, and
    $CROSSCUE_MODELS is the folder to keep the weights in.

    Examples:
        crosscue model fetch yolox-nano
        crosscue model fetch yolox-s --from Downloads/object_detection_yolox_2022nov.onnx

    Args:
        names: Names from crosscue model list.
        weights: Copy the weights from this file or folder instead of downloading them.
    """
    if weights is not None and len(names) > 1:
        raise UsageError("weights: one model at a time")
    found = []
    for name in names:
        found.append(fetch_model(name, weights))
        emit(found[-1])
    return FetchedModels(found)
