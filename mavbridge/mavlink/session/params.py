"""Reads the parameters that the bridge depends on; nothing is ever written."""

from collections.abc import Iterator, Mapping

from mavbridge.core.clock import NS_PER_MS
from mavbridge.core.errors import PeerError
from mavbridge.mavlink.codec.calibration import FS_THR_MARGIN_US, RcCalibration, RcChannel
from mavbridge.mavlink.codec.messages import ParamRequest, ParamValue

STICKS = ("THROTTLE", "YAW", "PITCH", "ROLL")
"""RCMAP_* suffixes in the order of ``Sticks``."""

_WINDOW = 16
"""Requests in flight at once; ArduPilot queues twenty."""
_TIMEOUT_NS = 300 * NS_PER_MS
_ATTEMPTS = 4
OPTION_CHANNELS = range(5, 17)
"""Channels whose RCn_OPTION may hold the override switch."""
OVERRIDE_SWITCH_OPTION = 46
"""RCn_OPTION "RC Override Enable": while the switch is low, all overrides are refused."""


class ParamReader:
    """Reads a list of parameters by name, a few at a time, and repeats requests that get lost."""

    def __init__(self, names: tuple[str, ...]) -> None:
        self._open: dict[str, tuple[int, int]] = {}
        """Time of the last request and number of requests."""
        self.values: dict[str, float] = {}
        self.request(names)

    def request(self, names: tuple[str, ...]) -> None:
        """Read these parameters as well."""
        self._open |= dict.fromkeys(names, (0, 0))

    @property
    def is_done(self) -> bool:
        """Every parameter has arrived or was given up."""
        return not self._open

    def receive(self, param: ParamValue) -> None:
        """Take a PARAM_VALUE, requested or not."""
        self._open.pop(param.name, None)
        self.values[param.name] = param.value

    def step(self, now_ns: int) -> Iterator[ParamRequest]:
        """Requests that are due: repeated ones first, then new ones up to the window."""
        in_flight = sum(attempts > 0 for _, attempts in self._open.values())
        for name, (requested_ns, attempts) in list(self._open.items()):
            if attempts == 0:
                if in_flight >= _WINDOW:
                    continue
                in_flight += 1
            elif now_ns - requested_ns < _TIMEOUT_NS:
                continue
            elif attempts >= _ATTEMPTS:
                del self._open[name]
                in_flight -= 1
                continue
            self._open[name] = (now_ns, attempts + 1)
            yield ParamRequest(name)


FIRST_NAMES = (
    *(f"RCMAP_{stick}" for stick in STICKS),
    "RC_OVERRIDE_TIME",
    "RC_OPTIONS",
    "FS_THR_VALUE",
    "MAV_GCS_SYSID",
    "MAV_GCS_SYSID_HI",
    "SYSID_MYGCS",
    *(f"RC{number}_OPTION" for number in OPTION_CHANNELS),
)
"""Read first; RCMAP_* then tells which RCn_MIN ... to read."""


def calibration_names(values: Mapping[str, float]) -> tuple[str, ...]:
    """RCn_* of the four stick channels; raises PeerError if RCMAP_* is missing."""
    numbers = [int(_require(values, f"RCMAP_{stick}")) for stick in STICKS]
    return tuple(
        f"RC{number}_{part}" for number in numbers for part in ("MIN", "TRIM", "MAX", "REVERSED")
    )


def calibration(values: Mapping[str, float]) -> RcCalibration:
    """The radio calibration, or PeerError if a parameter is missing or contradicts another."""
    try:
        throttle, yaw, pitch, roll = (
            _channel(values, int(_require(values, f"RCMAP_{stick}"))) for stick in STICKS
        )
        floor_us = int(values.get("FS_THR_VALUE", 0)) + FS_THR_MARGIN_US
        return RcCalibration(
            throttle=throttle, yaw=yaw, pitch=pitch, roll=roll, throttle_floor_us=floor_us
        )
    except ValueError as error:
        raise PeerError(
            f"the vehicle's radio calibration is unusable: {error}; calibrate the radio"
        ) from error


def _channel(values: Mapping[str, float], number: int) -> RcChannel:
    return RcChannel(
        number=number,
        min_us=int(_require(values, f"RC{number}_MIN")),
        trim_us=int(_require(values, f"RC{number}_TRIM")),
        max_us=int(_require(values, f"RC{number}_MAX")),
        is_reversed=bool(_require(values, f"RC{number}_REVERSED")),
    )


def _require(values: Mapping[str, float], name: str) -> float:
    if name not in values:
        raise PeerError(
            f"the vehicle did not send parameter {name}, without which sticks cannot be mapped to "
            "channels: is this an ArduPilot vehicle with RC input?"
        )
    return values[name]


def override_switch(values: Mapping[str, float]) -> int | None:
    """Number of the channel that enables overrides, or None."""
    options = {number: values.get(f"RC{number}_OPTION") for number in OPTION_CHANNELS}
    return next((n for n, option in options.items() if option == OVERRIDE_SWITCH_OPTION), None)


def override_obstacles(values: Mapping[str, float], source_system: int) -> Iterator[str]:
    """Reasons, as far as parameters show, for which this vehicle would ignore our overrides."""
    low = values.get("MAV_GCS_SYSID", values.get("SYSID_MYGCS"))
    if low is not None:
        high = max(values.get("MAV_GCS_SYSID_HI", 0), low)
        if not low <= source_system <= high:
            yield (
                f"it obeys system {low:.0f} and we are system {source_system}: use "
                f"--source-system {low:.0f}, or set MAV_GCS_SYSID (SYSID_MYGCS on older firmware)"
            )
    if int(values.get("RC_OPTIONS", 0)) & 2:
        yield "RC_OPTIONS bit 1 (ignore overrides) is set: clear it"
    if values.get("RC_OVERRIDE_TIME") == 0:
        yield "RC_OVERRIDE_TIME is 0, which disables overrides: set it to 0.5"


def override_advice(values: Mapping[str, float]) -> Iterator[str]:
    """Settings that work, but leave the vehicle without a pilot for longer than necessary."""
    time_s = values.get("RC_OVERRIDE_TIME")
    if time_s is not None and (time_s < 0 or time_s > 1):
        yield (
            f"RC_OVERRIDE_TIME is {time_s:g}: if this computer dies, the vehicle holds its last "
            "sticks for that many seconds (negative: forever); set it to 0.5"
        )
