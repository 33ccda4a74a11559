"""Every column of every table, declared once: its name, type and meaning.

Arrow schemas, ``crosscue query --schema`` and the pages of the tables come from these rows. The
unit of a column is the end of its name. Types are those of SQL; a column whose type ends in
``NOT NULL`` has a value in every row.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Final, NamedTuple, TypeAlias

if TYPE_CHECKING:
    import pyarrow as pa


class Column(NamedTuple):
    """One column.

    Attributes:
        kind: SQL type.
        meaning: Meaning in one phrase.
    """

    kind: str
    meaning: str


Columns: TypeAlias = Mapping[str, Column]

INT: Final = "BIGINT"
SMALL: Final = "INTEGER"
REAL: Final = "DOUBLE"
TEXT: Final = "VARCHAR"
TEXTS: Final = "VARCHAR[]"
FLAG: Final = "BOOLEAN"
BYTES: Final = "BLOB"

# A column that is a probability, whose name the vehicle file may choose.
PROBABILITY: Final = Column(REAL, "probability")
# Columns that the rows of several tables begin with.
DRIVE: Final = {"drive": Column(TEXT, "name of the drive")}
RUN: Final = {"run": Column(TEXT, "path of the run, relative to the folder of the catalog")}
_TIME: Final = {"t_ns": Column(INT, "log time")}
_FRAME: Final = {
    "frame": Column(INT, "number of the frame, from 0"),
    **_TIME,
    "camera": Column(TEXT, "topic of the camera"),
}
_STEP: Final = {
    **_TIME,
    "approach": Column(INT, "number of the approach in its run; null between approaches"),
}
_REFERENCE: Final = {"reference": Column(TEXT, "start or end of the intersection")}
_RANGE: Final = {
    "range_m": Column(REAL, "estimated range"),
    "var_m2": Column(REAL, "variance of the estimate"),
}
_BOX: Final = {
    "x0": Column(REAL, "left edge of the box in the picture, in pixels"),
    "y0": Column(REAL, "top edge"),
    "x1": Column(REAL, "right edge"),
    "y1": Column(REAL, "bottom edge"),
}
_MASK: Final = Column(BYTES, "mask, run-length encoded as by pycocotools; null without")
# Columns that the rows of every table of a run end with.
LOG_TIME: Final = {
    "segment": Column(SMALL, "time segment of the drive, from 0"),
    "log_t_ns": Column(INT, "time on the log's own clock"),
}
_CAUSE: Final = Column(TEXT, "reason")
_PLACE: Final = {"x_m": Column(REAL, "position"), "y_m": Column(REAL, "position")}
_HEADING: Final = Column(REAL, "counterclockwise from the x axis")
_DISTANCE: Final = Column(REAL, "true distance to the intersection")
# Tables of a run, by name, without the columns of ``LOG_TIME``.
OF_RUN: Final[Mapping[str, Columns]] = {
    "visual_odometry": {
        "start_ns": Column(INT, "time of the earlier picture"),
        "t_ns": Column(INT, "time of the later picture"),
        "distance_m": Column(REAL, "distance of the rear axle; null if the ground hides it"),
        "distance_sd_m": Column(REAL, "its standard deviation"),
        "turn_rad": Column(REAL, "change of heading, counterclockwise; null if unknown"),
        "turn_sd_rad": Column(REAL, "its standard deviation"),
        "pitch_rad": Column(REAL, "pitch of the camera relative to the direction of travel"),
        "is_standing": Column(FLAG, "whether nothing in the static scene moves"),
        "corners": Column(INT, "number of corners followed"),
        "patches": Column(INT, "number of patches of the ground that agree"),
    },
    "frames": {
        **_FRAME,
        "width_px": Column(SMALL, "width of the picture"),
        "height_px": Column(SMALL, "height of the picture"),
    },
    "detections": {
        **_FRAME,
        "detector": Column(TEXT, "name of the detector"),
        "label": Column(TEXT, "class of the object"),
        "score": Column(REAL, "score, comparable within one detector"),
        **_BOX,
        "mask": _MASK,
        "height_px": Column(REAL, "height of the mask, or of the box without one"),
        "lens": Column(TEXT, "lit lens of a traffic light; null if not examined"),
        "look": Column(TEXT, "result of the second look at a stop sign or light; null without"),
        "same_as": Column(TEXT, "detector with a better score for the same object; null without"),
        "range_m": Column(REAL, "range by the object's height; null if unknown"),
        "range_sd_m": Column(REAL, "its standard deviation"),
        "picture_width_px": Column(SMALL, "width of the picture"),
        "picture_height_px": Column(SMALL, "height of the picture"),
    },
    "road": {
        **_FRAME,
        "fraction_left": Column(REAL, "fraction of the left region that is road"),
        "fraction_straight": Column(REAL, "fraction of the region ahead that is road"),
        "fraction_right": Column(REAL, "fraction of the right region that is road"),
        "mask": _MASK,
        "mask_width_px": Column(SMALL, "width of the mask"),
        "mask_height_px": Column(SMALL, "height of the mask"),
    },
    "cues": {
        **_STEP,
        "cue": Column(TEXT, "its name"),
        "count": Column(INT, "how many were found in the frame"),
    },
    "range": {
        **_STEP,
        **_REFERENCE,
        **_RANGE,
        "measured_m": Column(REAL, "range measured in this step; null without"),
    },
    "belief": {
        **_STEP,
        "intersection": PROBABILITY,
        "left": Column(REAL, 'probability; SQL needs "left" in quotes'),
        "right": Column(REAL, 'probability; SQL needs "right" in quotes'),
        "straight": PROBABILITY,
        "established": Column(FLAG, "whether a road was established"),
        "not_believed": Column(TEXT, "cues that were observed but not used, with reasons"),
    },
    "ranged_objects": {
        **_TIME,
        "cue": Column(TEXT, "cue that the object is of"),
        "object": Column(INT, "number of the object"),
        "facing": Column(TEXT, "facing of a light, from its lit lenses"),
        "reference": Column(TEXT, "reference that it marks: start or end; null if none"),
        **_RANGE,
        "height_m": Column(REAL, "estimated height of the object"),
        **_BOX,
    },
    "pose": {
        **_TIME,
        **_PLACE,
        "heading_rad": _HEADING,
        "speed_mps": Column(REAL, "speed"),
        "cov_xx_m2": Column(REAL, "variance of x"),
        "cov_xy_m2": Column(REAL, "covariance of x and y"),
        "cov_xh_mrad": Column(REAL, "covariance of x and heading"),
        "cov_yy_m2": Column(REAL, "variance of y"),
        "cov_yh_mrad": Column(REAL, "covariance of y and heading"),
        "cov_hh_rad2": Column(REAL, "variance of the heading"),
        "major_axis_m": Column(REAL, "major axis of the 2-sigma ellipse"),
        "travelled_m": Column(REAL, "distance since the start"),
        "landmark": Column(TEXT, "landmark that corrected this pose; null without"),
    },
    "measurements": {
        "kind": Column("ENUM", "start, odometry, gap, heading, landmark or position"),
        "start_ns": Column(INT, "log time at which odometry or a gap starts"),
        **_TIME,
        "distance_m": Column(REAL, "distance travelled"),
        "turn_rad": Column(REAL, "change of heading, counterclockwise"),
        "distance_var_m2": Column(REAL, "variance of the distance"),
        "turn_var_rad2": Column(REAL, "variance of the change of heading"),
        "speed_mps": Column(REAL, "speed at the end"),
        "speed_var_m2ps2": Column(REAL, "variance of the speed"),
        "heading_rad": _HEADING,
        "heading_var_rad2": Column(REAL, "variance of the heading"),
        **_PLACE,
        "xx_m2": Column(REAL, "variance of x"),
        "xy_m2": Column(REAL, "covariance of x and y"),
        "yy_m2": Column(REAL, "variance of y"),
        "landmark": Column(TEXT, "name of the landmark"),
        "turn_from": Column("ENUM", "yaw rate, steering or wheels; null by pictures"),
    },
    "mobileye_obstacles": {
        **_TIME,
        "burst": Column(REAL, "number of the picture that the device examined"),
        "x_m": Column(REAL, "distance ahead of the rear axle"),
        "y_m": Column(REAL, "distance to the left"),
        "vx_mps": Column(REAL, "speed ahead, relative to the ego vehicle"),
        "type": Column(REAL, "the device's code of the type"),
        "status": Column(REAL, "the device's code of the motion"),
        "valid": Column(REAL, "the device's code of validity"),
        "age_frames": Column(REAL, "number of pictures with the obstacle"),
    },
    "mobileye_lanes": {
        **_TIME,
        "side": Column(REAL, "side of the car"),
        "lane_type": Column(REAL, "the device's code of the marking"),
        "quality": Column(REAL, "the device's quality"),
        "c0_m": Column(REAL, "offset of the marking to the left; NaN without a marking"),
        "c1": Column(REAL, "slope of the marking"),
        "c2_per_m": Column(REAL, "second coefficient of the marking"),
        "c3_per_m2": Column(REAL, "third coefficient of the marking"),
        "x_end_m": Column(REAL, "how far the marking is seen; NaN without a marking"),
    },
    "skipped": {
        "t_ns": Column(INT, "time of the row as recorded; null of rows listed in bulk"),
        "topic": Column(TEXT, "topic"),
        "reason": _CAUSE,
        "detail": Column(TEXT, "what exactly"),
        "count": Column(INT, "number of rows; null if unknown"),
        "is_dropped": Column(FLAG, "whether rows were dropped, not skipped"),
        "log": Column(TEXT, "name of the log"),
    },
}
_RESULT: Final = {
    "truth": Column(INT, "id in the truth; null without truth, or if not in the truth"),
    "intersection": Column(TEXT, "name of the intersection in the truth"),
    "control": Column(TEXT, "stop_sign, traffic_light or none"),
    "conditions": Column(TEXTS, "conditions in the truth, such as 'dusk'"),
    "present": Column(TEXTS, "features that are present"),
    "detected_m": Column(REAL, "true distance at which it was detected; null if never"),
    "full_m": Column(REAL, "the same for all features; null if never"),
    "features_m": Column("MAP(VARCHAR, DOUBLE)", "true distance of each present feature"),
    "false_features": Column(TEXTS, "absent features that were detected"),
    "why_not_detected": Column(TEXT, "why it was not detected; empty if it was"),
    "why_not_full": Column(TEXT, "why not all features were; empty if they were"),
}
_APPROACH: Final = Column(INT, "number in its run; null if the run did not find it")
# Tables of a score, by name.
OF_SCORE: Final[Mapping[str, Columns]] = {
    "by_drive": {
        "log": Column(TEXT, "identity of the drive's logs; equal for all runs of a drive"),
        "metric": Column(TEXT, "path, such as cues.stop_sign.precision"),
        "kind": Column(TEXT, "pooling over drives: mean, rms or sum"),
        "total": Column(REAL, "sum over the drive's rows; of squares for rms"),
        "rows": Column(INT, "number of rows"),
        "places": Column(TEXTS, "places of the drive, which comparisons resample"),
    },
    "cue_frames": {
        **DRIVE,
        **_TIME,
        "cue": Column(TEXT, "its name"),
        "count": Column(INT, "how many were found in the frame"),
        "approach": Column(INT, "id in the truth"),
        "object": Column(INT, "1 if the object is present, 0 if not, null if unknown"),
        "feature": Column(INT, "the same for the feature that the cue indicates"),
        "true_count": Column(INT, "true number of objects; null if unknown"),
        "distance_m": _DISTANCE,
        "visible": Column(REAL, "visible fraction"),
    },
    "curves": {
        **DRIVE,
        "approach": Column(INT, "id in the truth"),
        "intersection": PROBABILITY,
        **_TIME,
        "distance_m": _DISTANCE,
        "left": PROBABILITY,
        "right": PROBABILITY,
        "straight": PROBABILITY,
    },
    "approaches": {**DRIVE, "approach": _APPROACH, **_RESULT},
}
# Tables of a catalog's index, by name.
INDEXED: Final[Mapping[str, Columns]] = {
    "runs": {
        **RUN,
        "name": Column(TEXT, "last part of the path"),
        "outcome": Column(TEXT, "whole, losses where rows were dropped, or failed"),
        "exit_status": Column(SMALL, "0, 3 where rows were dropped, or that of a failed run"),
        "error": Column(TEXT, "error of the last attempt; null if it did not fail"),
        "stage": Column(TEXT, "estimate; detect if not yet estimated; null of a failed run"),
        "identity": Column(
            TEXT, "hash of the drive's logs, 64 hex digits; equal for all runs of a drive"
        ),
        "logs": Column(TEXTS, "names of the drive's logs"),
        "is_simulated": Column(FLAG, "whether a log is simulated"),
        "vehicle": Column(TEXT, "name in the vehicle file"),
        "crosscue": Column(TEXT, "version that made the run"),
        "crosscue_commit": Column(TEXT, "commit of crosscue, if it ran from a checkout"),
        "models": Column(
            "STRUCT(name VARCHAR, identity VARCHAR)[]",
            "detectors; the identity is a hash of weights, settings and code",
        ),
        "settings": Column(TEXT, "JSON of all settings: (settings->>'$.fusion.established')"),
        "settings_sha256": Column(TEXT, "hash of settings, models and selection of the logs"),
        "tags": Column("MAP(VARCHAR, VARCHAR)", "set by crosscue tag: tags['weather']"),
        "conditions": Column(TEXTS, "conditions of the drive's approaches, from the truth"),
        "start_ns": Column(INT, "drive time at which the drive starts"),
        "end_ns": Column(INT, "drive time at which it ends"),
        "made_at": Column("TIMESTAMP", "when the run was finished, UTC"),
        "seconds": Column(REAL, "wall time of the run; null without timings.json"),
        "travelled_m": Column(REAL, "length of the track; null without estimate"),
        "frames": Column(INT, "number of camera frames; null without detectors"),
        "approaches": Column(INT, "number of approaches that the run found"),
        "is_scored": Column(FLAG, "whether the run has a score"),
        "rows_in": Column(INT, "input rows over all stages"),
        "rows_used": Column(INT, "rows used"),
        "rows_skipped": Column(INT, "rows skipped, with reasons in the manifest"),
        "rows_dropped": Column(INT, "rows dropped, with reasons in the table dropped"),
        "notices": Column(TEXTS, "notices of the run"),
        "tables": Column(TEXTS, "names of the run's Parquet files"),
    },
    "approaches": {
        **RUN,
        "approach": _APPROACH,
        "start_ns": Column(INT, "first log time of the run's approach"),
        "end_ns": Column(INT, "last log time"),
        "detected_ns": Column(INT, "log time of the detection; null without"),
        "detected_range_m": Column(REAL, "range estimated at the detection"),
        "reference": Column(TEXT, "reference of ranges: start or end of the intersection"),
        "probabilities": Column("MAP(VARCHAR, DOUBLE)", "last belief: probabilities['left']"),
        "not_seen": Column(TEXTS, "features without an observation by any cue"),
        **_RESULT,
        "tags": Column("MAP(VARCHAR, VARCHAR)", "tags of the run"),
    },
    "dropped": {
        **RUN,
        "stage": Column(TEXT, "reading, detecting or estimating"),
        "stream": Column(TEXT, "topic, camera or input"),
        "reason": _CAUSE,
        "rows": Column(INT, "number of rows; null if unknown"),
    },
    "left_out": {**RUN, "reason": Column(TEXT, "why the run is left out")},
}
# Tables of runs that a query can name, by name; every other table of a run can be queried, too.
QUERIED: Final[Mapping[str, Columns]] = {
    "cues": {**RUN, **OF_RUN["cues"], **LOG_TIME},
    "scores": {**RUN, **OF_SCORE["by_drive"], "value": Column(REAL, "value of this drive alone")},
    **{name: {**RUN, **OF_RUN[name], **LOG_TIME} for name in ("belief", "range", "pose")},
    **{name: {**RUN, **OF_SCORE[name]} for name in ("cue_frames", "curves")},
}


def arrow_schema(columns: Columns) -> pa.Schema:
    """Return the columns as an Arrow schema."""
    import pyarrow as pa

    types = {
        INT: pa.int64(),
        "UBIGINT": pa.uint64(),
        SMALL: pa.int32(),
        REAL: pa.float64(),
        TEXT: pa.string(),
        TEXTS: pa.list_(pa.string()),
        "ENUM": pa.dictionary(pa.int8(), pa.string()),
        FLAG: pa.bool_(),
        BYTES: pa.binary(),
        "TIMESTAMP": pa.timestamp("us"),
        "MAP(VARCHAR, VARCHAR)": pa.map_(pa.string(), pa.string()),
        "MAP(VARCHAR, DOUBLE)": pa.map_(pa.string(), pa.float64()),
        "STRUCT(name VARCHAR, identity VARCHAR)[]": pa.list_(
            pa.struct({"name": pa.string(), "identity": pa.string()})
        ),
    }
    fields = []
    for name, column in columns.items():
        kind = column.kind.removesuffix(" NOT NULL")
        fields.append(pa.field(name, types[kind], nullable=kind == column.kind))
    return pa.schema(fields)
