"""A bus shared by the car and a Mobileye: every frame is accounted for once."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from crosscue.replay.can.database import CanDatabase
from crosscue.replay.can.decode import BusDecoder
from crosscue.replay.can.layout import CanMessage, CanSignal
from crosscue.replay.columns import DATA, ERROR, REMOTE, Block, CanFrames
from crosscue.replay.ledger import Ledger
from crosscue.replay.mobileye.can.admit import Admission, all_ids
from crosscue.replay.mobileye.settings import MobileyeSettings

SPEED = CanMessage("Speed", 0x100, False, 2, (CanSignal("kph", 0, 16, scale=0.01, unit="km/h"),))
TWIN = CanMessage("Twin", 0x739, True, 8, (CanSignal("raw", 0, 16),))
TEN_SLOTS = MobileyeSettings(slots=10, is_shared_bus=True)
FRAME = st.tuples(
    # Frames of the car, of an unknown device, the first obstacle, and slot 11, beyond the ten.
    st.sampled_from([0x100, 0x123, 0x738, 0x739, 0x757]),
    st.sampled_from([DATA, DATA, DATA, REMOTE, ERROR]),
    st.booleans(),
    st.booleans(),
    st.sampled_from([0, 2, 7, 8]),
)


@given(frames=st.lists(FRAME, min_size=1, max_size=30))
def test_each_frame_is_accounted_for_by_exactly_one_decoder(
    frames: list[tuple[int, int, bool, bool, int]],
) -> None:
    ids, kinds, extended, fd, lengths = (np.array(column) for column in zip(*frames, strict=True))
    rows = CanFrames(
        ids.astype(np.uint32),
        extended,
        kinds.astype(np.uint8),
        lengths.astype(np.uint8),
        np.zeros((len(frames), 8), np.uint8),
        fd,
    )
    log_ns = np.arange(len(frames), dtype=np.int64)
    ledger = Ledger("made up")
    car = BusDecoder(CanDatabase.of([SPEED, TWIN]), "can0", ledger, elsewhere=all_ids(TEN_SLOTS))

    decoded = sum(len(block) for block in car(Block("can0", log_ns, rows)))
    admitted = len(Admission("can0", ledger, TEN_SLOTS)(rows, log_ns))

    assert decoded + admitted + ledger.topic("can0").skipped.total() == len(frames)
