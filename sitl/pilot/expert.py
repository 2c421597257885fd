"""The expert as the pilot: arms, flies the course, lands and disarms, by the receiver alone.

For tests, and to fill a disk with flights. The expert knows ArduCopter's sticks.
"""

from collections.abc import Sequence
from typing import Literal

from sitl.clock import NS_PER_S
from sitl.course.layout import Course
from sitl.expert.demonstrator import Expert
from sitl.expert.stick_response import CENTRED, StickPositions
from sitl.pilot.transmitter import Hand, Switch, Transmitter
from sitl.simulated_vehicle import SimulatedVehicle

WAIT_NS = 8 * NS_PER_S
"""From boot to the arming gesture: the estimator needs 3 s for the attitude and 5 s for the
position, and whoever records asks for parameters and streams."""
HOVER_NS = 2 * NS_PER_S
"""After the last gate, before the landing."""
IDLE = CENTRED._replace(throttle=-1.0)
DESCENT = CENTRED._replace(throttle=-0.8)


class ExpertPilot:
    """A `Pilot` for one flight over the course."""

    def __init__(self, vehicle: SimulatedVehicle, course: Course, *, speed_mps: float) -> None:
        self._vehicle = vehicle
        self._expert = Expert(course, speed_mps)
        self._start_ns = vehicle.ap.now_ns
        self._transmitter = Transmitter(self._start_ns)
        self._phase: Literal["waiting", "flying", "landing", "over"] = "waiting"
        self._over_course_ns: int | None = None

    def latest(self) -> Sequence[int] | None:
        """See `Pilot`."""
        now_ns = self._vehicle.ap.now_ns
        if not self._transmitter.begins_frame(now_ns):
            return None
        return self._transmitter.channels_us(self._hand(now_ns), now_ns)

    def _hand(self, now_ns: int) -> Hand:
        ap = self._vehicle.ap
        if self._phase == "waiting":
            if ap.armed:
                self._phase = "flying"
            elif now_ns - self._start_ns >= WAIT_NS:
                return Hand(IDLE, gesture="arm")
            return Hand(IDLE)
        if not ap.armed:
            self._phase = "over"
            return Hand(IDLE)
        if self._phase == "flying":
            return Hand(self._fly(now_ns), switch=self._switch)
        return Hand(DESCENT, gesture="disarm" if ap.landed else None)

    @property
    def _switch(self) -> Switch:
        """High over the course."""
        return "high" if self._over_course_ns is None else "low"

    def _fly(self, now_ns: int) -> StickPositions:
        sticks = self._expert.sticks(self._vehicle.ap.truth, now_ns / NS_PER_S)
        if self._expert.next_gate is None:
            if self._over_course_ns is None:
                self._over_course_ns = now_ns
            if now_ns - self._over_course_ns >= HOVER_NS:
                self._phase = "landing"
        return sticks

    def close(self) -> None:
        """Nothing to free."""
