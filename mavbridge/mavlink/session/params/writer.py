"""Sets parameters, and repeats what gets lost."""

import math
from collections.abc import Iterator
from typing import NamedTuple

from mavbridge.core.clock import NS_PER_MS
from mavbridge.mavlink.codec.messages import ParamRequest, ParamValue, ParamWrite

_TIMEOUT_NS = 500 * NS_PER_MS
"""Longer than a read: the vehicle stores the value, and a telemetry radio is slow."""
_ATTEMPTS = 6


def is_same(one: float, other: float) -> bool:
    """Equal as far as PARAM_VALUE's float32 can tell."""
    return math.isclose(one, other, rel_tol=1e-6, abs_tol=1e-9)


class Outcome(NamedTuple):
    """The end of one write."""

    name: str
    asked: float
    answer: float | None
    """Value that the vehicle named last; None: it did not answer."""

    @property
    def is_confirmed(self) -> bool:
        """The vehicle has the value."""
        return self.answer is not None and is_same(self.answer, self.asked)


class _Write:
    def __init__(self, value: float) -> None:
        self.value = value
        self.answer: float | None = None
        self.requested_ns = 0
        self.attempts = 0


class ParamWriter:
    """Writes parameters until PARAM_VALUE confirms each, six times at most."""

    def __init__(self) -> None:
        self._open: dict[str, _Write] = {}
        self._outcomes: list[Outcome] = []

    @property
    def is_done(self) -> bool:
        """Every write is confirmed or was given up."""
        return not self._open

    def write(self, name: str, value: float) -> None:
        """Set this parameter; replaces an unfinished write of the same one."""
        self._open[name] = _Write(value)

    def cancel(self) -> None:
        """Forget what is unfinished; the vehicle may have taken it."""
        self._open.clear()

    def take_outcomes(self) -> list[Outcome]:
        """Results of the writes that ended since the last call."""
        outcomes, self._outcomes = self._outcomes, []
        return outcomes

    def receive(self, param: ParamValue) -> None:
        """Take a PARAM_VALUE. Another value than ours may be the answer to an older request."""
        write = self._open.get(param.name)
        if write is None or write.attempts == 0:
            return
        write.answer = param.value
        if is_same(param.value, write.value):
            self._close(param.name, write)

    def step(self, now_ns: int) -> Iterator[ParamWrite | ParamRequest]:
        """Requests that are due.

        A repetition also reads the value: a vehicle that has it already may not answer a write.
        """
        for name, write in list(self._open.items()):
            if write.attempts and now_ns - write.requested_ns < _TIMEOUT_NS:
                continue
            if write.attempts >= _ATTEMPTS:
                self._close(name, write)
                continue
            write.requested_ns, write.attempts = now_ns, write.attempts + 1
            yield ParamWrite(name, write.value)
            if write.attempts > 1:
                yield ParamRequest(name)

    def _close(self, name: str, write: _Write) -> None:
        del self._open[name]
        self._outcomes.append(Outcome(name, write.value, write.answer))
