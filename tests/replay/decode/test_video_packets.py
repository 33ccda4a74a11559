"""Packets of a video are decoded to pictures with their own times."""

from pathlib import Path

import numpy as np
import pytest

import crosscue
from crosscue.replay.columns import Block, Images, Topic
from crosscue.replay.decode.packets import NO_PICTURE, NOT_DECODED
from crosscue.replay.ledger import Ledger
from crosscue.replay.logs.opening import open_log
from crosscue.replay.signals.extractor import SampleExtractor
from crosscue.replay.signals.kinds import SignalPlan, SignalSource
from crosscue.replay.vehicle.vehicle import Vehicle
from support.videos import SIZE_PX, number_of, video

STEP_NS = 50_000_000
CODECS = ["libx264", "libx265", "libsvtav1"]


def packets(path: Path) -> tuple[Topic, list[Block]]:
    with open_log(path) as log:
        return log.topics[0], list(log.read(Ledger("video")))


def numbers_shown(topic: Topic, blocks: list[Block]) -> tuple[dict[int, int], Ledger]:
    """Return the number shown in each picture, keyed by time, and the ledger of the extractor."""
    found: dict[int, int] = {}

    def read_numbers(block: Block) -> None:
        assert isinstance(block.rows, Images)
        for i, t_ns in enumerate(block.log_ns.tolist()):
            pixels = np.frombuffer(block.rows.bytes_.payload(i), np.uint8)
            found[t_ns] = number_of(pixels.reshape(SIZE_PX[1], SIZE_PX[0], 3))

    ledger = Ledger("video")
    planned = SignalPlan((SignalSource(0, topic, ()),), {})
    extractor = SampleExtractor(planned, Vehicle(version=1), 0, ledger, on_pictures=read_numbers)
    for block in blocks:
        for _ in extractor(block):
            pass
    for _ in extractor.finish():
        pass
    return found, ledger


@pytest.mark.parametrize("codec", CODECS)
def test_every_packet_is_decoded_to_picture_with_its_time(codec: str, tmp_path: Path) -> None:
    suffix = ".mkv" if codec == "libsvtav1" else ".mp4"
    topic, blocks = packets(video(tmp_path / f"front{suffix}", codec=codec))

    found, ledger = numbers_shown(topic, blocks)

    assert [found[t] for t in sorted(found)] == list(range(24))
    assert sorted(found) == [k * STEP_NS for k in range(24)]
    assert not any(account.skipped for account in ledger.accounts.values())


def test_stream_that_begins_within_a_group_loses_only_that_group(tmp_path: Path) -> None:
    topic, blocks = packets(video(tmp_path / "front.mp4", options={"g": "12", "bf": "0"}))
    (block,) = blocks

    found, ledger = numbers_shown(topic, [block.take(slice(5, None))])

    account = ledger.topic(topic.name)
    skipped = account.skipped + account.dropped
    assert sum(skipped.values()) + len(found) == 19
    assert set(skipped) <= {NO_PICTURE, NOT_DECODED}
    assert sorted(found)[-1] == 23 * STEP_NS
    assert all(found[12 * STEP_NS + k * STEP_NS] == 12 + k for k in range(12))


def test_pixels_of_a_video_are_handed_over_without_a_copy(tmp_path: Path) -> None:
    with crosscue.open(video(tmp_path / "v.mp4")) as log:
        shown = [frame for topic in log.topics.values() for frame in topic.frames()]

    assert [number_of(frame.rgb) for frame in shown] == list(range(24))
    for frame in shown:
        stored = np.frombuffer(frame.encoded, np.uint8)
        assert np.shares_memory(stored, frame.rgb)
        # One picture in each buffer, so that a picture that is kept does not keep others.
        assert isinstance(frame.encoded, memoryview)
        assert frame.encoded.nbytes == memoryview(frame.encoded.obj).nbytes
