"""MAVLink peer for tests, built on the dialect alone: packs messages and reads ours."""

import socket

import pytest
from pymavlink.dialects.v20 import ardupilotmega as dialect

from mavbridge.mavlink.codec.calibration import RcCalibration, RcChannel

ARDUPILOT = RcCalibration(
    throttle=RcChannel(number=3, min_us=1100, trim_us=1100, max_us=1900),
    yaw=RcChannel(number=4, min_us=1100, trim_us=1500, max_us=1900),
    pitch=RcChannel(number=2, min_us=1100, trim_us=1500, max_us=1900),
    roll=RcChannel(number=1, min_us=1100, trim_us=1500, max_us=1900),
    throttle_floor_us=985,
)
"""Stick calibration of ArduPilot SITL, as our code reads it."""

CALIBRATION = {
    **dict(
        zip(("RCMAP_ROLL", "RCMAP_PITCH", "RCMAP_THROTTLE", "RCMAP_YAW"), (1, 2, 3, 4), strict=True)
    ),
    **{
        f"RC{n}_{part}": value
        for n in range(1, 9)
        for part, value in (
            ("MIN", 1100),
            ("TRIM", 1500),
            ("MAX", 1900),
            ("REVERSED", 0),
            ("DZ", 20),
        )
    },
    "FS_THR_VALUE": 975,
}
"""Parameters that give this calibration."""


class WireEnd:
    def __init__(self, system: int = 1, component: int = 1) -> None:
        self.mav = dialect.MAVLink(None, srcSystem=system, srcComponent=component)
        self.mav.robust_parsing = True

    def pack(self, message: dialect.MAVLink_message) -> bytes:
        data: bytes = message.pack(self.mav)
        self.mav.seq = (self.mav.seq + 1) % 256
        return data

    def read(self, data: bytes) -> list[dialect.MAVLink_message]:
        return self.mav.parse_buffer(data) or []

    def heartbeat(
        self,
        *,
        autopilot: int = dialect.MAV_AUTOPILOT_ARDUPILOTMEGA,
        mode: int = 2,
        armed: bool = False,
    ) -> bytes:
        base = 1 | (128 if armed else 0)
        return self.pack(
            self.mav.heartbeat_encode(dialect.MAV_TYPE_QUADROTOR, autopilot, base, mode, 3)
        )


def sent(data: bytes) -> dialect.MAVLink_message:
    """Return the one message in a packet of ours."""
    (message,) = WireEnd().read(data)
    return message


def _has_ipv6() -> bool:
    try:
        with socket.socket(socket.AF_INET6, socket.SOCK_DGRAM) as probe:
            probe.bind(("::1", 0))
    except OSError:
        return False
    return True


needs_ipv6 = pytest.mark.skipif(not _has_ipv6(), reason="this computer has no IPv6 loopback")
