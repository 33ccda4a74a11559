"""Read ``mobileye_560_660_msgs`` from a bag into the same tables as frames.

The messages have the fields of the frames, named as in the layout table (``ros``), but do not
document units, signs or codes for missing values. The reader uses these conventions:

* Obstacles: users of the driver treat ``obstacle_pos_x`` and ``obstacle_pos_y`` as a frame with y
  to the left, as on the wire. The reader does so too. A notice reports lateral positions and angles
  with the same sign.
* Lanes: on the wire they are positive to the right, but two public programs draw the messages'
  polynomials unchanged in a frame with y to the left. ``ros_lane_sign = "auto"`` therefore
  determines the sign from the positions of the left and the right lane, and reports it.
* ``Lane`` (0x737), reference points and signs: as on the wire, which could not be verified.
* Codes for missing values are recognized by their value on the wire (length 31.5 m, radar
  255.9375 m).
* ``next_lka_lanes`` does not identify the lane of a message: ``index`` is -1, and ``side`` follows
  from its position. ``Tsr`` does not identify the sign: ``sign`` is -1. ``FixedFoe`` has no
  counterpart on CAN.

Each obstacle message is complete, so a missing status message does not drop it: it then has its own
time and burst -1. Tables other than status and obstacles always have burst -1.
"""

from collections.abc import Iterable, Mapping
from typing import Final

import numpy as np
from numpy.typing import NDArray

from crosscue.replay.columns import Block, Floats, Int64s, Table
from crosscue.replay.ledger import Ledger
from crosscue.replay.mobileye.bursts import NO_BURST
from crosscue.replay.mobileye.clock import CounterClock
from crosscue.replay.mobileye.layout import Columns, Message, layout, variant_number
from crosscue.replay.mobileye.settings import DEFAULTS, LaneSign, MobileyeSettings, device_mounting
from crosscue.replay.mobileye.tables import LEFT, RIGHT, table_block, to_vehicle
from crosscue.replay.mobileye.wire import blank_dependent, from_given, si_columns

from .bursts import Obstacles, RosBursts

# Number of votes required, about 3 s of lanes on both sides. That is longer than a lane change, in
# which lanes are on the wrong side.
VOTES_WANTED: Final = 50
USABLE_QUALITY: Final = 2
CLEAR_OF_MIDDLE_M: Final = 0.3


class LaneSignVotes:
    """Votes of all usable lanes next to the vehicle for the sign that puts them on their side."""

    def __init__(self, label: str, sign: LaneSign) -> None:
        self._label = label
        self.is_decided = sign != "auto"
        self.is_left_positive = sign == "left"
        self._right = self._left = 0
        self._was_set = sign != "auto"

    def add(self, side: int, c0_m: NDArray[np.float64], quality: NDArray[np.float64]) -> None:
        """Add lanes of one side (1 left, -1 right), with the sign of the messages."""
        clear = c0_m[(quality >= USABLE_QUALITY) & (np.abs(c0_m) > CLEAR_OF_MIDDLE_M)]
        left = int((clear * side > 0).sum())
        self._left += left
        self._right += len(clear) - left
        if not self.is_decided and self._left + self._right >= VOTES_WANTED:
            self.close()

    def close(self) -> None:
        """Decide by the available votes; without votes, the sign is that of the wire."""
        if not self.is_decided:
            self.is_decided = True
            self.is_left_positive = self._left > self._right

    def notices(self) -> list[str]:
        """Return notices for the end of the log."""
        total = self._left + self._right
        if not total:
            return []
        against = self._right if self.is_left_positive else self._left
        side = "left" if self.is_left_positive else "right"
        if 2 * against > total:
            return [
                f"{self._label} are read as positive to the {side}, but most of them are then on "
                "the wrong side; their sign may change within the log: replay its parts alone"
            ]
        if self._was_set or not self.is_left_positive:
            return []
        return [f"{self._label} in the messages are positive to the left, unlike on the wire"]


PACKAGE: Final = "mobileye_560_660_msgs"
NO_COUNTERPART: Final = "message without a known counterpart on CAN"
LACKS_FIELDS: Final = "message lacks fields of its type"
NOT_COLUMNS: Final = "message was not decoded to columns"

# Messages whose sign is determined, and their names in notices.
_SIDED: Final = (("LkaLane", "lanes"), ("AftermarketLane", "aftermarket lanes"))
# Variant whose fields the messages have.
_VARIANT_OF: Final[Mapping[str, str]] = {
    "status": "classic",
    "lane_details": "classic",
    "high_beam_area": "classic",
    "warnings": "extended",
    "sign": "basic",
}


class RosMobileye:
    """Converter of decoded messages to tables, a block at a time; call ``flush`` at the end."""

    def __init__(
        self,
        bus: str,
        types: Mapping[str, str],
        ledger: Ledger,
        settings: MobileyeSettings = DEFAULTS,
    ) -> None:
        """Prepare the converter.

        Args:
            bus: First part of the tables' names, ``BUS/mobileye/TABLE``.
            types: Message types by topic, as spelled in the log; other topics are ignored.
            ledger: Records unused messages under the topic's name.
            settings: Mounting, slots and the lanes' sign.
        """
        self._bus = bus
        self._ledger = ledger
        self._types = {
            topic: name.split("/")[-1]
            for topic, name in types.items()
            if name.startswith(f"{PACKAGE}/")
        }
        topics = {name: topic for topic, name in self._types.items()}
        self._bursts = RosBursts(topics.get("ObstacleData", ""), ledger, settings)
        self._bursts.has_status = "ObstacleStatus" in topics
        self._clock = CounterClock()
        self._votes = {name: LaneSignVotes(label, settings.ros_lane_sign) for name, label in _SIDED}
        self._waiting: dict[str, list[Block]] = {name: [] for name, _ in _SIDED}
        self._mounting = device_mounting(settings, bus, ledger)

    def __call__(self, block: Block) -> list[Block]:
        """Return the new rows of tables from a block of decoded messages."""
        name = self._types.get(block.topic)
        if name is None:
            return []
        if not isinstance(block.rows, Table):
            return self._skip(block, NOT_COLUMNS, type(block.rows).__name__)
        messages = [m for m in layout().values() if m.ros_type == name]
        messages = [m for m in messages if not m.name.startswith("next_lane_")]
        if not messages:
            return self._skip(block, NO_COUNTERPART, name)
        lacking = _lacking(messages, block.rows)
        if lacking:
            return self._skip(block, LACKS_FIELDS, ", ".join(lacking))
        if name in self._votes:
            return self._sided(block, block.rows, name)
        if name == "ObstacleData":
            return self._obstacles(self._bursts.hold(self._obstacles_in(block, messages)))
        if name == "ObstacleStatus":
            return self._statuses(block, block.rows)
        return [self._plain(block, block.rows, message) for message in messages]

    def flush(self) -> list[Block]:
        """Return the rows that were held back for later messages."""
        given = self._obstacles(self._bursts.release(is_last=True))
        for name, votes in self._votes.items():
            votes.close()
            given += self._decided(name)
        notices = [n for votes in self._votes.values() for n in votes.notices()]
        for notice in (*self._clock.notices, *notices):
            self._ledger.notice(f"{self._bus}: {notice}")
        return given

    def _skip(self, block: Block, reason: str, detail: str) -> list[Block]:
        if len(block):
            first_ns = int(block.log_ns[0])
            self._ledger.skip(block.topic, reason, len(block), detail, first_ns)
        return []

    def _statuses(self, block: Block, rows: Table) -> list[Block]:
        stamp_ns = stamps_of(block)
        message = layout()["status"]
        columns = si_columns(message, _values(message, rows))
        image_ns = self._clock.feed(columns["counter_ms"].astype(np.int64), stamp_ns)
        number = self._bursts.add_status(stamp_ns, image_ns, columns["count"].astype(np.int64))
        leading: Columns = {
            "t_ns": image_ns,
            "burst": number,
            "latency_ns": stamp_ns - image_ns,
            "layout": np.full(len(rows), variant_number("classic"), dtype=np.int8),
        }
        block = table_block(self._bus, "status", block.log_ns, leading | columns, image_ns)
        return [block, *self._obstacles(self._bursts.release())]

    def _obstacles_in(self, block: Block, messages: Iterable[Message]) -> Obstacles:
        columns: Columns = {}
        assert isinstance(block.rows, Table)
        for message in messages:
            columns |= si_columns(message, _values(message, block.rows))
        self._check_angle(columns)
        return Obstacles(stamps_of(block), block.log_ns, columns)

    def _check_angle(self, columns: Columns) -> None:
        y_m, angle_rad = (columns[name].astype(np.float64) for name in ("y_m", "angle_rad"))
        is_clear = (np.abs(y_m) > 1.0) & (np.abs(angle_rad) > 0.01)
        is_same = y_m[is_clear] * angle_rad[is_clear] > 0  # both left-positive columns
        if len(is_same) and is_same.mean() < 0.5:
            self._ledger.notice(
                f"{self._bus}: obstacle_pos_y and obstacle_angle have the same sign, unlike on the "
                "wire; compare the obstacles' sides with a picture"
            )

    def _obstacles(self, ready: Obstacles | None) -> list[Block]:
        if ready is None:
            return []
        columns = to_vehicle("obstacles", ready.columns, self._mounting)
        image_ns = columns["t_ns"].astype(np.int64)
        return [table_block(self._bus, "obstacles", ready.log_ns, columns, image_ns)]

    def _plain(
        self, block: Block, rows: Table, message: Message, is_mirrored: bool = False
    ) -> Block:
        values = _values(message, rows, is_mirrored)
        columns = {**self._leading(block, message), **si_columns(message, values)}
        columns = to_vehicle(message.table, columns, self._mounting)
        return table_block(self._bus, message.table, block.log_ns, columns)

    def _leading(self, block: Block, message: Message) -> Columns:
        n = len(block)
        leading: Columns = {"t_ns": stamps_of(block), "burst": np.full(n, NO_BURST, dtype=np.int64)}
        if message.name == "sign":
            leading["sign"] = np.full(n, -1, dtype=np.int8)
        if message.variant:
            number = variant_number(_VARIANT_OF[message.name])
            leading["layout"] = np.full(n, number, dtype=np.int8)
        return leading

    def _sided(self, block: Block, rows: Table, name: str) -> list[Block]:
        """Hold rows until the sign of their messages is known, and return them then."""
        votes = self._votes[name]
        side = _side_of_topic(block.topic)
        if name == "AftermarketLane":
            values = _values(layout()["aftermarket_lane"], rows)
            votes.add(LEFT, values["y_left_m"], values["confidence_left"])
            votes.add(RIGHT, values["y_right_m"], values["confidence_right"])
        elif side is not None:
            values = _values(layout()["lane_a"], rows)
            votes.add(side, values["c0_m"], values["quality"])
        self._waiting[name].append(block)
        return self._decided(name) if votes.is_decided else []

    def _decided(self, name: str) -> list[Block]:
        waiting, self._waiting[name] = self._waiting[name], []
        is_mirrored = self._votes[name].is_left_positive
        given = []
        for block in waiting:
            assert isinstance(block.rows, Table)
            if name == "LkaLane":
                given.append(self._lane_rows(block, block.rows, is_mirrored))
            else:
                message = layout()["aftermarket_lane"]
                given.append(self._plain(block, block.rows, message, is_mirrored))
        return given

    def _lane_rows(self, block: Block, rows: Table, is_mirrored: bool) -> Block:
        side = _side_of_topic(block.topic)
        columns: Columns = {}
        for name in ("lane_a", "lane_b"):
            columns |= si_columns(layout()[name], _values(layout()[name], rows, is_mirrored))
        n = len(block)
        table, places = "lanes", {"side": np.full(n, side or 0, dtype=np.int8)}
        if side is None:
            is_left = columns["c0_m"].astype(np.float64) > 0
            table = "next_lanes"
            places = {
                "side": np.where(is_left, LEFT, RIGHT).astype(np.int8),
                "index": np.full(n, -1, dtype=np.int8),
            }
        leading: Columns = {"t_ns": stamps_of(block), "burst": np.full(n, NO_BURST, dtype=np.int64)}
        columns = to_vehicle(table, {**leading, **places, **columns}, self._mounting)
        return table_block(self._bus, table, block.log_ns, columns)


def stamps_of(block: Block) -> Int64s:
    """Return the messages' own times, or the recorder's where they are missing."""
    if block.header_ns is None:
        return block.log_ns
    return np.where(block.header_ns > 0, block.header_ns, block.log_ns)


def _side_of_topic(topic: str) -> int | None:
    name = topic.rpartition("/")[2].lower()
    if "next" in name:
        return None
    return LEFT if "left" in name else RIGHT if "right" in name else None


def _lacking(messages: Iterable[Message], rows: Table) -> list[str]:
    wanted = {f.ros for m in messages for f in m.fields if f.ros}
    if any(m.name == "warnings" for m in messages):
        wanted |= {"night_time", "dusk_time"}
    return sorted(wanted - set(rows.columns))


def _values(message: Message, rows: Table, is_mirrored: bool = False) -> dict[str, Floats]:
    """Return values on the wire, NaN where missing.

    Args:
        message: Layout of the message.
        rows: The messages.
        is_mirrored: True if they are positive to the left, while the wire is positive to the right.
    """
    values: dict[str, Floats] = {}
    for f in message.fields:
        if f.ros:
            value = rows[f.ros].astype(np.float64)
            values[f.name] = from_given(f, 0.0 - value if is_mirrored and f.flip else value)
        elif f.name not in values:
            values[f.name] = np.full(len(rows), np.nan)
    if message.name == "warnings":
        dusk, night = (rows[name].astype(np.float64) for name in ("dusk_time", "night_time"))
        values["time_of_day"] = dusk + 2 * night
    blank_dependent(message, values)
    return values
