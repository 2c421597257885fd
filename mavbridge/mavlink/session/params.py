"""Reading the parameters that the bridge flies by; nothing is ever written."""

from collections.abc import Iterator, Mapping

from mavbridge.core.clock import NS_PER_MS
from mavbridge.core.errors import PeerError
from mavbridge.mavlink.codec.calibration import FS_THR_MARGIN_US, RcCalibration, RcChannel
from mavbridge.mavlink.codec.messages import ParamValue
from mavbridge.mavlink.codec.requests import AskParam

STICKS = ("THROTTLE", "YAW", "PITCH", "ROLL")
"""RCMAP_* suffixes in the order of ``Sticks``."""

_WINDOW = 16
"""Reads under way at once; ArduPilot queues twenty."""
_TIMEOUT_NS = 300 * NS_PER_MS
_ATTEMPTS = 4
OPTION_CHANNELS = range(5, 17)
"""Channels whose RCn_OPTION may hold the override switch."""
OVERRIDE_SWITCH_OPTION = 46
"""RCn_OPTION "RC Override Enable": low refuses all overrides."""


class ParamReader:
    """Reads a list of parameters by name, a few at a time, asking again for what gets lost."""

    def __init__(self, names: tuple[str, ...]) -> None:
        self._waiting = list(dict.fromkeys(names))
        self._asked: dict[str, tuple[int, int]] = {}
        self.values: dict[str, float] = {}
        self.missing: set[str] = set()

    @property
    def done(self) -> bool:
        """Every name was answered or given up."""
        return not self._waiting and not self._asked

    def receive(self, param: ParamValue) -> None:
        """Take an answer (or any PARAM_VALUE that flies by)."""
        self._asked.pop(param.name, None)
        if param.name in self._waiting:
            self._waiting.remove(param.name)
        self.values[param.name] = param.value

    def step(self, now_ns: int) -> Iterator[AskParam]:
        """Reads that are due."""
        for name, (asked_ns, attempts) in list(self._asked.items()):
            if now_ns - asked_ns < _TIMEOUT_NS:
                continue
            if attempts >= _ATTEMPTS:
                del self._asked[name]
                self.missing.add(name)
                continue
            self._asked[name] = (now_ns, attempts + 1)
            yield AskParam(name)
        while self._waiting and len(self._asked) < _WINDOW:
            name = self._waiting.pop(0)
            self._asked[name] = (now_ns, 1)
            yield AskParam(name)


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
"""Read first; which RCn_MIN... to read then follows from RCMAP_*."""


def calibration_names(values: Mapping[str, float]) -> tuple[str, ...]:
    """RCn_* of the four stick channels."""
    numbers = [int(values.get(f"RCMAP_{stick}", 0)) for stick in STICKS]
    return tuple(
        f"RC{number}_{part}" for number in numbers for part in ("MIN", "TRIM", "MAX", "REVERSED")
    )


def calibration(values: Mapping[str, float]) -> RcCalibration:
    """The radio calibration that these parameters describe.

    Raises:
        PeerError: the vehicle did not tell them, or they make no sense.
    """
    try:
        throttle, yaw, pitch, roll = (
            _channel(values, int(values[f"RCMAP_{stick}"])) for stick in STICKS
        )
        return RcCalibration(
            throttle=throttle,
            yaw=yaw,
            pitch=pitch,
            roll=roll,
            throttle_floor_us=int(values.get("FS_THR_VALUE", 0)) + FS_THR_MARGIN_US,
        )
    except KeyError as error:
        raise PeerError(
            f"the vehicle did not answer for parameter {error}: without it sticks cannot be mapped"
        ) from error
    except ValueError as error:
        raise PeerError(f"the vehicle's radio calibration is unusable: {error}") from error


def _channel(values: Mapping[str, float], number: int) -> RcChannel:
    return RcChannel(
        number=number,
        min_us=int(values[f"RC{number}_MIN"]),
        trim_us=int(values[f"RC{number}_TRIM"]),
        max_us=int(values[f"RC{number}_MAX"]),
        is_reversed=bool(values[f"RC{number}_REVERSED"]),
    )


def override_switch(values: Mapping[str, float]) -> int | None:
    """Number of the channel that enables overrides, or None."""
    for number in OPTION_CHANNELS:
        if values.get(f"RC{number}_OPTION") == OVERRIDE_SWITCH_OPTION:
            return number
    return None


def override_obstacles(values: Mapping[str, float], source_system: int) -> Iterator[str]:
    """Why this vehicle would not obey our overrides, as far as its parameters tell."""
    low = values.get("MAV_GCS_SYSID", values.get("SYSID_MYGCS"))
    if low is not None:
        high = max(values.get("MAV_GCS_SYSID_HI", 0), low)
        if not low <= source_system <= high:
            yield (
                f"it obeys system {low:.0f} and we are {source_system}: use --source-system "
                f"{low:.0f}, or set MAV_GCS_SYSID (SYSID_MYGCS on older firmware)"
            )
    if int(values.get("RC_OPTIONS", 0)) & 2:
        yield "RC_OPTIONS bit 1 (ignore overrides) is set"
    if values.get("RC_OVERRIDE_TIME") == 0:
        yield "RC_OVERRIDE_TIME is 0, which refuses overrides"


def override_advice(values: Mapping[str, float]) -> Iterator[str]:
    """Settings that work, but leave the vehicle unattended for longer than need be."""
    time_s = values.get("RC_OVERRIDE_TIME")
    if time_s is not None and (time_s < 0 or time_s > 1):
        yield (
            f"RC_OVERRIDE_TIME is {time_s:g}: if this computer dies, its last sticks stay for that "
            "long (negative: for ever); 0.5 is a better value"
        )
