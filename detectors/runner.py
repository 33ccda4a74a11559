"""Run detectors over encoded pictures, in batches; each picture is decoded once and cached."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Final

from crosscue.replay.columns import Block, Bytes, Images
from crosscue.replay.errors import CrosscueError, LogError, UsageError, one_line

from .base import Detections, Detector, Found, Frame, View, fault_of, reportable
from .images import NOT_DECODED, Encoded, decode, encoded, picture_size, reduction
from .ranging import lens
from .result_cache import ResultCache, picture_key
from .signs import second_look

# Number of pictures decoded and passed to a detector at a time.
BATCH: Final = 8
OTHER_SIZE: Final = "picture of another size than the first"


@dataclass(frozen=True, slots=True)
class Named:
    """A detector and its name in tables."""

    name: str
    detector: Detector


@dataclass(frozen=True, slots=True)
class FrameResult:
    """Results of all detectors for one frame.

    Attributes:
        t_ns: Log time of the frame.
        size_px: Width and height of the picture.
        picture: The encoded picture.
        found: One result for each detector, in order.
    """

    t_ns: int
    size_px: tuple[int, int]
    picture: Encoded
    found: tuple[Found, ...]


@dataclass(slots=True)
class FrameCounts:
    """Account of the frames, by detector name where it differs."""

    frames: int = 0
    decoded: int = 0
    ran: dict[str, int] = field(default_factory=dict)
    from_cache: dict[str, int] = field(default_factory=dict)


@dataclass(slots=True)
class _Prepared:
    """One picture with its cached results, and its pixels for the detectors yet to run."""

    t_ns: int
    picture: Encoded
    key: bytes
    size_px: tuple[int, int]
    known: list[Found | None]
    pixels: dict[tuple[int, bool], Bytes]


@dataclass(slots=True)
class Runner:
    """Runs detectors over one camera's pictures.

    Attributes:
        detectors: In the order of results.
        cache: Results of earlier runs; only missing results are computed.
        camera: Topic.
        depth_bits: Number of bits that the camera uses in a 16-bit picture.
        on_skip: Called with the time and reason of each picture that cannot be decoded.
        light_labels: Labels of traffic lights, whose lenses and surroundings are examined.
        sign_labels: Labels of stop signs, at which a second look is taken.
        is_one_size: True to skip pictures of another size than the first, because the camera's
            intrinsics are for one size.
        counts: Account of all frames so far.
    """

    detectors: Sequence[Named]
    cache: ResultCache
    camera: str
    depth_bits: int
    on_skip: Callable[[int, str, str], None]
    light_labels: tuple[str, ...] = ()
    sign_labels: tuple[str, ...] = ()
    is_one_size: bool = False
    counts: FrameCounts = field(default_factory=FrameCounts)
    _size_px: tuple[int, int] | None = None

    def __call__(self, block: Block) -> Iterator[FrameResult]:
        """Yield the results of a block's pictures in order, without those that do not decode.

        Raises:
            UsageError: A detector returned more or fewer results than frames, or one that breaks
                its contract (``fault_of``).
            CrosscueError: A detector failed.
        """
        if not isinstance(block.rows, Images):
            return
        images, times = block.rows, block.log_ns.tolist()
        known = [self._known(encoded(images, i), t_ns) for i, t_ns in enumerate(times)]
        parts = [known[i : i + BATCH] for i in range(0, len(known), BATCH)]
        with ThreadPoolExecutor(1, "decode") as pool:
            ahead: Future[list[_Prepared]] | None = None
            for i, part in enumerate(parts):
                prepared = self._decoded(part) if ahead is None else ahead.result()
                # Decoding releases the interpreter's lock, so it overlaps with the networks.
                ahead = pool.submit(self._decoded, parts[i + 1]) if i + 1 < len(parts) else None
                yield from self._run(prepared)

    def _known(self, picture: Encoded, t_ns: int) -> _Prepared:
        key = picture_key(picture)
        known = [self.cache.get(key, self._identity(named), t_ns) for named in self.detectors]
        return _Prepared(t_ns, picture, key, (0, 0), known, {})

    def _decoded(self, pictures: list[_Prepared]) -> list[_Prepared]:
        return [picture for picture in pictures if self._decode(picture)]

    def _decode(self, prepared: _Prepared) -> bool:
        try:
            prepared.size_px = picture_size(prepared.picture)
            self._size_px = self._size_px or prepared.size_px
            if self.is_one_size and prepared.size_px != self._size_px:
                self.on_skip(prepared.t_ns, OTHER_SIZE, f"{prepared.size_px}, not {self._size_px}")
                return False
            for named, found in zip(self.detectors, prepared.known, strict=True):
                view = named.detector.view
                scale = _scale(prepared, view)
                if found is None and scale not in prepared.pixels:
                    pixels, _ = decode(prepared.picture, view, self.depth_bits)
                    prepared.pixels[scale] = pixels
                    self.counts.decoded += 1
        except LogError as error:
            self.on_skip(prepared.t_ns, NOT_DECODED, str(error))
            return False
        return True

    def _run(self, pictures: list[_Prepared]) -> Iterator[FrameResult]:
        fresh: list[tuple[bytes, str, Found]] = []
        for i, named in enumerate(self.detectors):
            missing = [picture for picture in pictures if picture.known[i] is None]
            self._count(named.name, len(missing), len(pictures) - len(missing))
            if not missing:
                continue
            for picture, found in zip(missing, self._detect(named, missing), strict=True):
                picture.known[i] = found
                fresh.append((picture.key, self._identity(named), found))
        self.cache.put(fresh)
        self.counts.frames += len(pictures)
        for picture in pictures:
            results = tuple(found for found in picture.known if found is not None)
            yield FrameResult(picture.t_ns, picture.size_px, picture.picture, results)

    def _detect(self, named: Named, pictures: list[_Prepared]) -> Sequence[Found]:
        view = named.detector.view
        frames = [
            Frame(p.t_ns, self.camera, p.pixels[_scale(p, view)], p.size_px) for p in pictures
        ]
        try:
            found = named.detector(frames)
        except UsageError as error:
            raise UsageError(f"detector {named.name}: {error}") from None
        except CrosscueError:
            raise
        except Exception as error:
            why = f"{type(error).__name__}: {one_line(error, 200)}"
            raise CrosscueError(
                f"detector {named.name}: failed at {frames[0].t_ns} ns: {why}; leave it out of "
                "--detectors, or correct it"
            ) from error
        if len(found) != len(frames):
            raise UsageError(
                f"detector {named.name}: returned {len(found)} results for {len(frames)} frames; "
                "expected one for each"
            )
        labels = reportable(named.detector)
        for one, frame in zip(found, frames, strict=True):
            fault = fault_of(one, frame, labels)
            if fault is not None:
                raise UsageError(f"detector {named.name}: frame at {frame.t_ns} ns: {fault}")
        return [
            second_look.with_looks(one, frame, self.sign_labels, self.light_labels)
            if isinstance(one, Detections)
            else one
            for one, frame in zip(found, frames, strict=True)
        ]

    def _identity(self, named: Named) -> str:
        """Identify all that determines a result: the detector, and the second look."""
        return (
            f"{named.detector.identity} lens {lens.VERSION} {' '.join(self.light_labels)} "
            f"look {second_look.VERSION} {' '.join(self.sign_labels)}"
        )

    def _count(self, name: str, ran: int, from_cache: int) -> None:
        self.counts.ran[name] = self.counts.ran.get(name, 0) + ran
        self.counts.from_cache[name] = self.counts.from_cache.get(name, 0) + from_cache


def _scale(prepared: _Prepared, view: View) -> tuple[int, bool]:
    by = reduction(prepared.size_px[0], view) if prepared.picture.coding == "jpeg" else 1
    return by, view.is_grey
