"""A segment in openpilot's layout, its messages written by the Cap'n Proto library."""

import bz2
from functools import cache
from pathlib import Path
from typing import Any, Final

from support.videos import video

START_NS: Final = 25_000_000_000
# Of openpilot's schema what decides the positions of the fields that are read: the numbers and
# types of all fields up to them.
_STRUCTS: Final = """\
@0xd1e4a3c27b5f6088;
struct Can { address @0 :UInt32; busTime @1 :UInt16; dat @2 :Data; src @3 :UInt8; }
struct Wheels { fl @0 :Float32; fr @1 :Float32; rl @2 :Float32; rr @3 :Float32; }
struct Car {
  a @0 :AnyPointer; vEgo @1 :Float32; wheelSpeeds @2 :Wheels; b @3 :Float32; c @4 :Bool;
  d @5 :Float32; e @6 :Bool; steeringAngleDeg @7 :Float32; f @8 :Float32; g @9 :Bool;
  h @10 :AnyPointer; i @11 :AnyPointer; j @12 :AnyPointer; k @13 :AnyPointer; l @14 :UInt16;
  m @15 :Float32; aEgo @16 :Float32;
}
struct Gps {
  flags @0 :UInt16; latitude @1 :Float64; longitude @2 :Float64; altitude @3 :Float64;
  speed @4 :Float32; bearingDeg @5 :Float32; horizontalAccuracy @6 :Float32;
  unixTimestampMillis @7 :Int64;
}
struct Index {
  a @0 :UInt32; b @1 :UInt16; c @2 :UInt32; d @3 :Int32; segmentId @4 :UInt32; e @5 :UInt32;
  timestampSof @6 :UInt64; timestampEof @7 :UInt64;
}
struct Vec { v @0 :List(Float32); status @1 :Int8; }
struct Sensor {
  a @0 :Int32; b @1 :Int32; c @2 :Int32; timestamp @3 :Int64; source @8 :UInt16; d @10 :Bool;
  union {
    acceleration @4 :Vec; magnetic @5 :Vec; orientation @6 :Vec; gyro @7 :Vec; pressure @9 :Vec;
    magneticUncalibrated @11 :Vec; gyroUncalibrated @12 :Vec;
  }
}
struct Calibration {
  a @0 :List(Float32); b @1 :Int8; c @2 :Int32; d @3 :Int8; e @4 :List(Float32);
  f @5 :List(Float32); g @6 :List(Float32); rpyCalib @7 :List(Float32); h @8 :List(Float32);
  i @9 :Int32; j @10 :List(Float32); calStatus @11 :UInt16; height @12 :List(Float32);
}
"""
# A reading of the gyro in a left turn.
TURN: Final = {"gyroUncalibrated": {"v": [0.1, 0.02, -0.03]}}
_KINDS: Final = {
    5: "can @5 :List(Can)",
    11: "sensorEvents @11 :List(Sensor)",
    15: "roadEncodeIdx @15 :Index",
    18: "logMessage @18 :Text",
    19: "liveCalibration @19 :Calibration",
    21: "gpsLocation @21 :Gps",
    22: "carState @22 :Car",
    48: "gpsLocationExternal @48 :Gps",
    90: "qRoadEncodeIdx @90 :Index",
    98: "accelerometer @98 :Sensor",
    99: "gyroscope @99 :Sensor",
}
_VALID: Final = 67


@cache
def event_type() -> Any:
    """Return the library's type of a message."""
    import tempfile

    import capnp

    capnp.remove_import_hook()
    members = " ".join(
        f"{_KINDS.get(n, f'k{n} @{n} :AnyPointer')};" for n in range(1, 128) if n != _VALID
    )
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "log.capnp")
        path.write_text(
            f"{_STRUCTS}struct Event {{ logMonoTime @0 :UInt64; valid @{_VALID} :Bool = true;"
            f" union {{ {members} }} }}\n"
        )
        return capnp.load(str(path)).Event


def event(t_ns: int, **kind: object) -> bytes:
    coded: bytes = event_type().new_message(logMonoTime=t_ns, **kind).to_bytes()
    return coded


def _index(i: int) -> dict[str, int]:
    return {"segmentId": i, "timestampSof": START_NS + 50_000_000 * i, "timestampEof": at_ns(i)}


def at_ns(i: int) -> int:
    return START_NS + 50_000_000 * i + 12_000_000


def drive_messages(frames: int) -> list[bytes]:
    """Return the messages of a drive that turns left, with a frame every 50 ms."""
    found = []
    for i in range(frames):
        t_ns = START_NS + 50_000_000 * i
        wheels = {"fl": 9.5, "fr": 10.5, "rl": 9.75, "rr": 10.25}
        found += [
            event(t_ns, qRoadEncodeIdx=_index(i)),
            event(
                t_ns,
                can=[
                    {"address": 0xAA, "dat": bytes([i, 1, 2, 3]), "src": 0},
                    {"address": 0x18FEF100, "dat": bytes(8), "src": 128},
                ],
            ),
            event(
                t_ns + 1000,
                carState={
                    "vEgo": 10.0,
                    "aEgo": 0.5,
                    "steeringAngleDeg": -3.5,
                    "wheelSpeeds": wheels,
                },
            ),
            event(t_ns + 2000, gyroscope=TURN),
            event(t_ns + 3000, logMessage="a note"),
        ]
    fix = {
        "latitude": 37.5,
        "longitude": -122.25,
        "altitude": 12.0,
        "speed": 10.0,
        "bearingDeg": 60.0,
        "horizontalAccuracy": 2.5,
        "unixTimestampMillis": 1_600_000_000_000,
    }
    found.append(event(START_NS + 4000, gpsLocationExternal=fix))
    calibration = {"rpyCalib": [0.0, 0.02, -0.01], "height": [1.25], "calStatus": 1}
    found.append(event(START_NS + 5000, liveCalibration=calibration))
    return found


def openpilot_drive(folder: Path, frames: int = 24, name: str = "rlog.bz2") -> Path:
    folder.mkdir(parents=True)
    coded = b"".join(drive_messages(frames))
    (folder / name).write_bytes(bz2.compress(coded) if name.endswith(".bz2") else coded)
    # The device codes no picture out of order.
    video(folder / "qcamera.ts", frames, options={"bf": "0"}, file_format="mpegts")
    return folder
