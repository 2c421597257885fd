"""Slots that follow the vehicle's attitude messages, for the freshest state at each command."""

from mavbridge.core.clock import Clock, Slot
from mavbridge.core.ports import Link


class StatePacer:
    """A slot as soon as a new attitude arrives, or by the clock when none does.

    - Never sooner than 3/4 of a period after the last tick: a faster stream is thinned.
    - Never later than 5/4 of a period, or one period while no attitudes arrive at all. The usual
      age limits then decide whether the state is fresh enough.

    Slots lost to a stall are counted, as by ``GridPacer``.
    """

    def __init__(self, clock: Clock, link: Link, *, period_ns: int) -> None:
        self._clock = clock
        self._link = link
        self._period_ns = period_ns
        self._index = -1
        self._last_ns: int | None = None
        self._is_live = False

    def wait(self) -> Slot:
        """Sleep until a new attitude has arrived, within the limits."""
        last_ns = self._last_ns
        if last_ns is not None:
            earliest_ns = last_ns + self._period_ns * 3 // 4
            self._clock.sleep_until_ns(earliest_ns)
            patience_ns = self._period_ns * 5 // 4 if self._is_live else self._period_ns
            newest_ns = self._link.wait_for_attitude(
                newer_than_ns=earliest_ns, until_ns=last_ns + patience_ns
            )
            self._is_live = newest_ns > last_ns - self._period_ns
        woke_ns = self._clock.now_ns()
        due_ns = woke_ns if last_ns is None else last_ns + self._period_ns
        missed = max(0, (woke_ns - due_ns + self._period_ns // 2) // self._period_ns)
        self._index += 1 + missed
        self._last_ns = woke_ns
        return Slot(index=self._index, due_ns=due_ns, woke_ns=woke_ns, missed=missed)
