"""Chunks and history in seconds: which action acts now, and which sticks were sent before."""

from collections import deque

import numpy as np

from mavbridge.core.clock import NS_PER_S
from mavbridge.core.records import NEUTRAL, FloatArray, Sticks


def sample_chunk(chunk: FloatArray, *, chunk_dt_s: float, at_s: float) -> Sticks:
    """Action of a chunk at a time, linear between its points, held at its ends.

    Args:
        chunk: [horizon, 4]; row k acts ``k * chunk_dt_s`` after the state that it was made from.
        chunk_dt_s: time between rows, s.
        at_s: time since that state, s.
    """
    last = len(chunk) - 1
    position = min(max(at_s / chunk_dt_s, 0.0), float(last))
    low = int(position)
    high = min(low + 1, last)
    weight = position - low
    a, b = chunk[low].tolist(), chunk[high].tolist()
    return Sticks(*[(1.0 - weight) * a[k] + weight * b[k] for k in range(4)])


class SentHistory:
    """Sticks as they were sent, resampled to the policy's history grid.

    A stick holds until the next one is sent, so the value at a time is that of the last send before
    it; what is older than the first send, and any release, counts as neutral.
    """

    def __init__(self, *, length: int, dt_s: float) -> None:
        self._length = length
        self._dt_ns = round(dt_s * NS_PER_S)
        self._sent: deque[tuple[int, Sticks]] = deque()

    def append(self, sent: Sticks | None, now_ns: int) -> None:
        """Remember what left at ``now_ns`` (None = released); forgets what is too old to matter."""
        self._sent.append((now_ns, NEUTRAL if sent is None else sent))
        horizon_ns = now_ns - (self._length + 1) * self._dt_ns
        while len(self._sent) > 1 and self._sent[1][0] <= horizon_ns:
            self._sent.popleft()

    def resample(self, now_ns: int) -> FloatArray:
        """[1, K, 4], oldest first; the newest is one ``history_dt_s`` before ``now_ns``."""
        newest_first: list[Sticks] = []
        at_ns = now_ns - self._dt_ns
        for sent_ns, sticks in reversed(self._sent):
            while at_ns >= sent_ns and len(newest_first) < self._length:
                newest_first.append(sticks)
                at_ns -= self._dt_ns
            if len(newest_first) == self._length:
                break
        newest_first += [NEUTRAL] * (self._length - len(newest_first))
        flat = [value for sticks in reversed(newest_first) for value in sticks]
        return np.array(flat, dtype=np.float32).reshape(1, self._length, 4)
