"""Reads parameters by name, and knows which ones the bridge needs."""

from collections.abc import Iterator, Mapping

from mavbridge.core.clock import NS_PER_MS
from mavbridge.mavlink.codec.messages import ParamRequest, ParamValue

STICKS = ("THROTTLE", "YAW", "PITCH", "ROLL")
"""RCMAP_* suffixes in the order of ``Sticks``."""
OPTION_CHANNELS = range(5, 17)
"""Channels whose RCn_OPTION may hold the override switch."""

FIRST_NAMES = (
    *(f"RCMAP_{stick}" for stick in STICKS),
    "RC_OVERRIDE_TIME",
    "RC_OPTIONS",
    "RC_FS_TIMEOUT",
    "FS_THR_ENABLE",
    "FS_THR_VALUE",
    "FS_OPTIONS",
    "THR_DZ",
    "MAV_GCS_SYSID",
    "MAV_GCS_SYSID_HI",
    "SYSID_MYGCS",
    *(f"RC{number}_OPTION" for number in OPTION_CHANNELS),
)
"""Read first; RCMAP_* then tells which RCn_MIN ... to read."""

RISK_NAMES = ("RC_OVERRIDE_TIME", "RC_OPTIONS", "FS_THR_ENABLE")
"""Those that decide how safe a flight is: asked for again if the first requests get lost."""

_CALIBRATION_PARTS = ("MIN", "TRIM", "MAX", "REVERSED")

_WINDOW = 16
"""Requests in flight at once; ArduPilot queues twenty."""
_TIMEOUT_NS = 300 * NS_PER_MS
_ATTEMPTS = 4


def calibration_names(values: Mapping[str, float]) -> tuple[str, ...]:
    """Parameters without which sticks cannot be mapped to channels, as far as RCMAP_* is known."""
    names = tuple(f"RCMAP_{stick}" for stick in STICKS)
    numbers = sorted({int(values[name]) for name in names if name in values})
    return names + tuple(f"RC{number}_{part}" for number in numbers for part in _CALIBRATION_PARTS)


def dead_zone_names(values: Mapping[str, float]) -> tuple[str, ...]:
    """RCn_DZ of the stick channels, as far as RCMAP_* is known."""
    known = (values.get(f"RCMAP_{stick}") for stick in STICKS)
    return tuple(f"RC{int(number)}_DZ" for number in known if number is not None)


class ParamReader:
    """Reads a list of parameters by name, a few at a time, and repeats requests that get lost."""

    def __init__(self, names: tuple[str, ...]) -> None:
        self._open: dict[str, tuple[int, int]] = {}
        """Time of the last request and number of requests."""
        self._names: set[str] = set()
        self.values: dict[str, float] = {}
        self.request(names)

    def request(self, names: tuple[str, ...]) -> None:
        """Read these parameters as well, those that were given up before included."""
        missing = [name for name in names if name not in self.values]
        self._open |= {name: (0, 0) for name in missing if name not in self._open}
        self._names |= set(names)

    @property
    def is_done(self) -> bool:
        """Every parameter has arrived or was given up."""
        return not self._open

    def receive(self, param: ParamValue) -> None:
        """Take a PARAM_VALUE, whoever asked for it; of a parameter in the list, it is kept."""
        self._open.pop(param.name, None)
        if param.name in self._names:
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
