"""The exact grid on which sticks leave."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True, kw_only=True)
class Slot:
    """One point of the stick grid that has come due."""

    index: int
    due_ns: int
    missed: int
    """Slots before it for which no stick left within one period."""


class StickGrid:
    """Slots at ``origin + index * period``, whatever happens between them.

    A slot is served by the first send from half a period before it to one period after it, so one
    that was served early is left out, and one that nobody served in time is missed, never made up
    for.
    """

    def __init__(self, period_ns: int, origin_ns: int) -> None:
        self._period_ns = period_ns
        self._origin_ns = origin_ns
        self._index = -1
        self._served_ns = origin_ns - period_ns
        """Last send, or the last slot in which nothing was to be sent."""

    @property
    def next_ns(self) -> int:
        """When the next slot is due."""
        return self._origin_ns + (self._index + 1) * self._period_ns

    def take(self, now_ns: int) -> Slot | None:
        """The newest slot that has come due since the last call; None if there is none to serve."""
        index = (now_ns - self._origin_ns) // self._period_ns
        if index <= self._index:
            return None
        first, self._index = self._index + 1, index
        missed = index - first
        if self._is_served(first):
            if not missed:
                return None
            missed -= 1
        due_ns = self._origin_ns + index * self._period_ns
        return Slot(index=index, due_ns=due_ns, missed=missed)

    def serve(self, sent_ns: int) -> None:
        """Note that sticks have left, or that none were to be sent."""
        self._served_ns = sent_ns

    def _is_served(self, index: int) -> bool:
        due_ns = self._origin_ns + index * self._period_ns
        return due_ns - self._served_ns < self._period_ns // 2
