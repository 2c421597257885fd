"""Ticks that follow the vehicle's clock instead of ours: as fresh a state as can be had."""

from mavbridge.core.clock import Clock, Slot
from mavbridge.core.ports import Link


class StatePacer:
    """A tick as soon as a fresh attitude arrives; by the clock when it does not come.

    - Never sooner than 3/4 of a period after the last tick: a faster stream is thinned.
    - Never later than 5/4 of a period (one period where no stream is alive at all): then the tick
      fires with what there is, and the state's age is judged by the same rules as ever.

    A stall counts the slots that it has cost, as with the grid.
    """

    def __init__(self, clock: Clock, link: Link, *, period_ns: int) -> None:
        self._clock = clock
        self._link = link
        self._period_ns = period_ns
        self._index = -1
        self._last_ns: int | None = None
        self._is_live = False

    def wait(self) -> Slot:
        """Sleep until a fresh attitude is in, within the limits."""
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
