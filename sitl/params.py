"""The parameters that the vehicle really reads, with ArduCopter 4.7's names and SITL defaults.

Values are float32, as on the wire (PARAM_VALUE carries REAL32).
"""

import math
import struct
from collections.abc import Iterator

RC_CHANNELS_WITH_PARAMS = 8

_VEHICLE: tuple[tuple[str, float], ...] = (
    ("ACRO_BAL_PITCH", 1.0),
    ("ACRO_BAL_ROLL", 1.0),
    ("ACRO_RP_EXPO", 0.3),
    ("ACRO_RP_RATE", 360.0),  # deg/s
    ("ACRO_TRAINER", 2.0),  # 0 none, 1 levels itself, 2 also limits the lean
    ("ACRO_Y_RATE", 202.5),  # deg/s
    ("ANGLE_MAX", 3000.0),  # cdeg
    ("DISARM_DELAY", 10.0),  # s
    ("FS_GCS_ENABLE", 0.0),
    ("FS_GCS_TIMEOUT", 5.0),  # s
    ("FS_OPTIONS", 16.0),  # bit 4: carry on under pilot control when the GCS is lost
    ("FS_THR_ENABLE", 1.0),  # 0 off, 1 RTL, 3 LAND
    ("FS_THR_VALUE", 975.0),  # us
    ("LAND_SPEED", 50.0),  # cm/s
    ("MAV_GCS_SYSID", 255.0),
    ("MAV_GCS_SYSID_HI", 0.0),
    ("MAV_OPTIONS", 0.0),  # bit 0: listen to the GCS alone
    ("MAV_SYSID", 1.0),
    ("MOT_THST_HOVER", 0.39),
    ("PILOT_ACCEL_Z", 250.0),  # cm/s^2
    ("PILOT_SPEED_DN", 0.0),  # cm/s; 0: as up
    ("PILOT_SPEED_UP", 250.0),  # cm/s
    ("PILOT_Y_RATE", 202.5),  # deg/s
    ("RCMAP_PITCH", 2.0),
    ("RCMAP_ROLL", 1.0),
    ("RCMAP_THROTTLE", 3.0),
    ("RCMAP_YAW", 4.0),
    ("RC_FS_TIMEOUT", 1.0),  # s
    ("RC_OPTIONS", 32.0),  # bit 0 ignore receiver, 1 ignore overrides, 6 no neutral-stick check
    ("RC_OVERRIDE_TIME", 3.0),  # s; 0 refuses overrides, < 0 never expires
    ("RTL_ALT", 1500.0),  # cm
    ("SCHED_LOOP_RATE", 400.0),  # Hz; bounds the message rates
    ("THR_DZ", 100.0),  # per mille of stick, each side of the middle
)
_RC_DEFAULTS: tuple[tuple[str, float], ...] = (
    ("DZ", 0.0),
    ("MAX", 2000.0),
    ("MIN", 1000.0),
    ("OPTION", 0.0),
    ("REVERSED", 0.0),
    ("TRIM", 1500.0),
)
_RC_DEAD_ZONES_US = {1: 20.0, 2: 20.0, 3: 30.0, 4: 20.0}


def _float32(value: float) -> float:
    """The value that survives the wire."""
    (rounded,) = struct.unpack("<f", struct.pack("<f", value))
    return float(rounded)


def _defaults() -> Iterator[tuple[str, float]]:
    yield from _VEHICLE
    for channel in range(1, RC_CHANNELS_WITH_PARAMS + 1):
        for suffix, value in _RC_DEFAULTS:
            if suffix == "DZ":
                value = _RC_DEAD_ZONES_US.get(channel, value)
            yield f"RC{channel}_{suffix}", value


class Params:
    """Named numbers in a fixed, sorted order (the order is PARAM_VALUE's index)."""

    def __init__(self) -> None:
        self._values = {name: _float32(value) for name, value in sorted(_defaults())}
        self.names: tuple[str, ...] = tuple(self._values)

    def __getitem__(self, name: str) -> float:
        return self._values[name]

    def __contains__(self, name: object) -> bool:
        return name in self._values

    def __len__(self) -> int:
        return len(self._values)

    def integer(self, name: str) -> int:
        """An enumeration or bit mask."""
        return int(self._values[name])

    def set(self, name: str, value: float) -> bool:
        """Store the value; False for an unknown name or a value that is not a number."""
        if name not in self._values or not math.isfinite(value):
            return False
        try:
            self._values[name] = _float32(value)
        except OverflowError:
            return False
        return True
