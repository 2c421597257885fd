"""Parameters that are set for one flight and restored at its normal end."""

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

from mavbridge.core.clock import NS_PER_MS
from mavbridge.core.reasons import Code, Reason, because
from mavbridge.mavlink.codec.messages import ParamRequest, ParamValue, ParamWrite

_TIMEOUT_NS = 500 * NS_PER_MS
"""Longer than for a read: the vehicle stores the value, and a telemetry radio is slow."""
_ATTEMPTS = 6


def is_same(one: float, other: float) -> bool:
    """True if the values are equal in PARAM_VALUE's float32."""
    return math.isclose(one, other, rel_tol=1e-6, abs_tol=1e-9)


@dataclass(slots=True)
class _Write:
    """Write of one parameter until the vehicle confirms it, with at most six requests."""

    value: float
    answer: float | None = None
    """Value that the vehicle reported last, perhaps in answer to an older request."""
    requested_ns: int = 0
    attempts: int = 0

    @property
    def is_confirmed(self) -> bool:
        return self.answer is not None and is_same(self.answer, self.value)


class TemporaryParams:
    """Sets parameters of a disarmed vehicle for a flight, and restores the old values after it."""

    def __init__(
        self,
        wanted: tuple[tuple[str, float], ...],
        *,
        before: dict[str, float],
        report: Callable[[str], None],
    ) -> None:
        """``before``: old values of changed parameters, by name; outlives a vehicle's reboot."""
        self._wanted = dict(wanted)
        self._before = before
        self._report = report
        self._failures: dict[str, Reason] = {}
        self._altered: dict[str, float] = {}
        """Values that the vehicle stored in place of ours: rounded, or limited to its range."""
        self._is_disarmed = self._is_ending = self._is_restoring = False
        self._open: dict[str, _Write] | None = None if wanted else {}
        """Outstanding writes; None before the first."""

    def problem(self) -> Reason | None:
        """Return why a flight may not begin yet, or None."""
        if self._failures:
            return next(iter(self._failures.values()))
        if self.is_settled or self._is_restoring:
            return None
        return because(Code.SETTING_PARAMETERS if self._is_disarmed else Code.SET_NEEDS_DISARMING)

    @property
    def is_settled(self) -> bool:
        """True if no write is outstanding."""
        return self._open == {}

    def receive(self, param: ParamValue) -> None:
        """Process a PARAM_VALUE: a confirmation, or a value that the pilot has corrected."""
        write = (self._open or {}).get(param.name)
        if write is not None and write.attempts and not write.is_confirmed:
            write.answer = param.value
        if (why := self._failures.get(param.name)) is None:
            return
        wanted, is_late = self._wanted[param.name], why.code is Code.SET_ABSENT
        if is_same(param.value, wanted):
            del self._failures[param.name]
        elif is_late and self._open is not None and not self._is_ending:  # the first were lost
            del self._failures[param.name]
            self._before[param.name], self._open[param.name] = param.value, _Write(wanted)

    def step(
        self, now_ns: int, values: Mapping[str, float], *, is_complete: bool, is_disarmed: bool
    ) -> Iterator[ParamWrite | ParamRequest]:
        """Yield the requests that are due.

        A repetition also reads the value: a vehicle that has it already may not answer a write.
        ``values``: all values received from the vehicle; ``is_complete``: no more will arrive.
        """
        self._is_disarmed = is_disarmed
        if self._is_ending and not self._is_restoring:
            self._open = self._begin_restoring(values)
        elif self._open is None and is_complete and is_disarmed:
            self._open = self._begin_writing(values)
        if not self._open:
            return
        for name, write in list(self._open.items()):
            is_waiting = write.attempts > 0 and now_ns - write.requested_ns < _TIMEOUT_NS
            is_due = is_disarmed and not is_waiting
            if write.is_confirmed or (is_due and write.attempts >= _ATTEMPTS):
                self._conclude(name, self._open.pop(name))
            elif is_due:
                write.requested_ns, write.attempts = now_ns, write.attempts + 1
                yield ParamWrite(name, write.value)
                if write.attempts > 1:
                    yield ParamRequest(name)
        if self._is_restoring and self._open and not is_disarmed:
            self._open.clear()
            self._report_what_stays()

    def _begin_writing(self, values: Mapping[str, float]) -> dict[str, _Write]:
        writes = {}
        for name, value in self._wanted.items():
            if (now := values.get(name)) is None:
                self._failures[name] = because(Code.SET_ABSENT, name=name, value=value)
            elif not is_same(now, value):
                self._before[name] = now
                writes[name] = _Write(value)
        return writes

    def _conclude(self, name: str, write: _Write) -> None:
        """Report the outcome of this parameter's write."""
        asked, answer = write.value, write.answer
        if self._is_restoring:
            if write.is_confirmed:
                self._report(f"{name} put back to {asked:g}")
                self._before.pop(name, None)
            else:
                self._report(
                    f"{name} could not be put back to {asked:g}, as the vehicle did not confirm "
                    "it: set it with your ground station"
                )
        elif write.is_confirmed:
            self._report(f"{name} set from {self._before[name]:g} to {asked:g} for this flight")
        elif answer is None:
            self._failures[name] = because(Code.SET_UNANSWERED, name=name, value=asked)
        else:
            self._failures[name] = because(Code.SET_REFUSED, name=name, value=asked, stays=answer)
            self._altered[name] = answer
            if is_same(answer, self._before[name]):
                del self._before[name]

    def restore(self) -> bool:
        """Restore changed parameters in the next steps; True if nothing more can be done now."""
        self._is_ending = True
        return not self._before or (self._is_restoring and self.is_settled)

    def _begin_restoring(self, values: Mapping[str, float]) -> dict[str, _Write]:
        self._is_restoring, writes = True, {}
        for name, before in list(self._before.items()):
            now, wanted = values.get(name), self._wanted[name]
            known = (before, wanted, self._altered.get(name, wanted))
            if now is not None and not any(is_same(now, value) for value in known):
                self._report(f"{name} was set to {now:g} by another station: it is left so")
                del self._before[name]
            elif self._is_disarmed:
                # Also if it shows the old value: a write may be under way.
                writes[name] = _Write(before)
        if not self._is_disarmed:
            self._report_what_stays()
        return writes

    def _report_what_stays(self) -> None:
        if self._before:
            texts = (f"{name} (it was {value:g})" for name, value in self._before.items())
            self._report(
                "the vehicle is still armed, so what was set for the flight stays: "
                f"{', '.join(texts)}"
            )
