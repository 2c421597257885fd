"""Reads parameters by name."""

from collections.abc import Iterator

from mavbridge.core.clock import NS_PER_MS
from mavbridge.mavlink.codec.messages import ParamRequest, ParamValue

_WINDOW = 16
"""Requests in flight at once; ArduPilot queues twenty."""
_TIMEOUT_NS = 300 * NS_PER_MS
_ATTEMPTS = 4


class ParamReader:
    """Reads a list of parameters by name, a few at a time, and repeats requests that get lost."""

    def __init__(self, names: tuple[str, ...], *, known: frozenset[str] | None = None) -> None:
        self._known = known
        """All that may be asked for; None: anything."""
        self._open: dict[str, tuple[int, int]] = {}
        """Time of the last request and number of requests."""
        self._names: set[str] = set()
        self.values: dict[str, float] = {}
        """In the order of their names."""
        self.request(names)

    def request(self, names: tuple[str, ...]) -> None:
        """Read these parameters as well, those that were given up before included."""
        if self._known is not None:
            names = tuple(name for name in names if name in self._known)
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
            is_new = param.name not in self.values
            self.values[param.name] = param.value
            if is_new:  # sorted here, once a name, and not at every look at them
                self.values = dict(sorted(self.values.items()))

    def absent(self, name: str) -> None:
        """Give up on a parameter that the vehicle does not have."""
        self._open.pop(name, None)

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
