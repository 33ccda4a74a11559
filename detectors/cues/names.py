"""Names of the cues, as in ``cues.parquet`` (Table 5)."""

from __future__ import annotations

from enum import StrEnum


class Cue(StrEnum):
    """What a frame can say about an intersection; sides are the driver's."""

    STOP_SIGN = "stop_sign"
    TRAFFIC_LIGHT = "traffic_light"
    ROAD_LEFT = "road_left"
    ROAD_STRAIGHT = "road_straight"
    ROAD_RIGHT = "road_right"
    CROSS_TRAFFIC_LEFT = "cross_traffic_left"
    CROSS_TRAFFIC_RIGHT = "cross_traffic_right"
    PARKED_LEFT = "parked_left"
    PARKED_RIGHT = "parked_right"
    LANES = "lanes_past"
    VEHICLES = "vehicles_past"
    ONE_WAY_LEFT = "one_way_left"
    ONE_WAY_RIGHT = "one_way_right"
    DO_NOT_ENTER = "do_not_enter"
