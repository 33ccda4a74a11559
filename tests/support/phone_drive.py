"""A simulated drive in the layout of the smartphone driving data set, with a left turn."""

import math
from pathlib import Path
from typing import Final

SPEED_MPH: Final = 20.0
YAW_RATE_RADPS: Final = 0.1
CAR: Final = (
    "Time,Seconds,Latitude / Y Position (Degrees),Longitude / X Position (Degrees),"
    "Distance (Miles),Speed (MPH),Steering Angle,Throttle Position,Engine RPM"
)
PHONE: Final = (
    "loggingTime(txt),locationTimestamp_since1970(s),locationLatitude(WGS84),"
    "locationLongitude(WGS84),locationAltitude(m),locationSpeed(m/s),locationCourse(°),"
    "locationHorizontalAccuracy(m),locationHeadingX(µT),locationHeadingY(µT),locationHeadingZ(µT),"
    "gyroRotationX(rad/s),gyroRotationY(rad/s),gyroRotationZ(rad/s),"
    "motionGravityX(G),motionGravityY(G),motionGravityZ(G)"
)
# 10:31:37 local time in a time zone five hours behind UTC.
START_S: Final = 1_523_201_497
# Age of a position fix when the phone logs it.
LATE_S: Final = 1.1


def phone_drive(path: Path, count: int = 60) -> Path:
    """Write both files at ten rows per second; the phone is on its right side and tilted back."""
    path.mkdir(parents=True)
    car, phone = [CAR], [PHONE]
    lean = 0.3
    for i in range(count):
        wall = f"2018-04-08 10:31:{37 + i // 10:02d}.{i % 10}"
        at = 30.3273 - 8e-6 * i
        car.append(f"{wall}05628,{0.1 * i:.3f},{at:.6f},-97.756,0.1,{SPEED_MPH},-0.3,13,2146")
        fix_s = START_S + i // 10 - LATE_S
        rate = YAW_RATE_RADPS if 2 * i > count else 0.0
        axes = (math.cos(lean), 0.0, math.sin(lean))
        gyro = ",".join(f"{-rate * axis:.9f}" for axis in axes)
        gravity = ",".join(f"{axis:.9f}" for axis in axes)
        phone.append(
            f"{wall}97,{fix_s:.6f},{30.3273 - 8e-5 * (i // 10):.6f},-97.756,209,8.94,180.0,8,"
            f"20,-30,40,{gyro},{gravity}"
        )
    (path / "made_car.csv").write_text("\n".join(car) + "\n", encoding="utf-8")
    (path / "made_phone.csv").write_text("\n".join(phone) + "\n", encoding="utf-8")
    return path
