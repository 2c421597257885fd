"""Actions sent in a flight and the motion of the vehicle, kept in memory up to a limit."""

from collections import deque
from collections.abc import Callable

import numpy as np

from mavbridge.commands.identify.fit import Array
from mavbridge.core.clock import NS_PER_S
from mavbridge.core.records import Event, Tick, VehicleState
from mavbridge.core.vehicle import Action

MAX_ROWS = 100_000
"""Most actions, and most states: four minutes at 400 Hz. Beyond it the oldest are forgotten."""


class ResponseRecording:
    """A sink of ticks that keeps the policy's actions and the states that they came from.

    One thread emits; the rest is for after the flight.
    """

    def __init__(self) -> None:
        self._sent: deque[tuple[int, Action]] = deque(maxlen=MAX_ROWS)
        self._states: deque[VehicleState] = deque(maxlen=MAX_ROWS)

    def emit(self, event: Event) -> None:
        """Keep a tick in which the policy flew; see ``mavbridge.core.ports.TickSink``."""
        if not isinstance(event, Tick) or event.trace is None:
            return
        # As the policy's after its limits, before any mapping to this vehicle's own curves.
        self._sent.append((event.sent_ns, event.trace.smoothed))
        state = event.state
        if state is not None and (not self._states or state is not self._states[-1]):
            self._states.append(state)

    def inputs(self, column: int) -> tuple[Array, Array]:
        """Times in s and values of one number of the actions."""
        times = np.array([at_ns for at_ns, _ in self._sent], np.float64) / NS_PER_S
        return times, np.array([action[column] for _, action in self._sent], np.float64)

    def outputs(
        self, read: Callable[[VehicleState], float], measured_ns: Callable[[VehicleState], int]
    ) -> tuple[Array, Array]:
        """Times in s and values of something that ``read`` finds in a state; each moment once."""
        times = np.array([measured_ns(state) for state in self._states], np.int64)
        values = np.array([read(state) for state in self._states], np.float64)
        _, first = np.unique(times, return_index=True)
        return times[first].astype(np.float64) / NS_PER_S, values[first]
