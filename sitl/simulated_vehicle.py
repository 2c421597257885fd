"""A whole vehicle without I/O: bytes in and out per link, and a clock that the caller steps."""

from collections.abc import Sequence
from dataclasses import dataclass

from sitl.ardupilot.autopilot import STEP_NS, Autopilot, VehicleConfig
from sitl.ardupilot.params import Params
from sitl.course.layout import AirborneStart, Course
from sitl.link.server import MavlinkServer
from sitl.report import FlightLog
from sitl.vehicle.dynamics import BodyState

MAX_STEPS_AT_ONCE = 400
"""One second of simulated time; after a longer stall the rest follows in later calls."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Pose:
    """State of the vehicle for the camera; replaced as a whole, so any thread may read it."""

    stamp_ns: int
    body: BodyState


class SimulatedVehicle:
    """Autopilot, physics and MAVLink of one vehicle; stamps are the caller's monotonic clock."""

    def __init__(
        self,
        *,
        links: int,
        boot_ns: int,
        config: VehicleConfig | None = None,
        course: Course | None = None,
    ) -> None:
        self._config = config or VehicleConfig()
        self.params = Params(self._config.conditions)
        self.log = FlightLog(boot_ns, course)
        self.ap = Autopilot(self.params, self._config, boot_ns)
        self._transmitter_us: Sequence[int] | None = None
        self.server = MavlinkServer(self.ap, links, self.log)
        self.pose = Pose(stamp_ns=boot_ns, body=self.ap.truth)

    @property
    def bad_frames(self) -> int:
        """Unreadable frames on all links."""
        return sum(link.bad_frames for link in self.server.links)

    def receive(self, link_id: int, data: bytes, now_ns: int) -> None:
        """Act on bytes that arrived on a link at ``now_ns``."""
        self.log.on_received(now_ns)
        self.server.receive(link_id, data, now_ns)

    def set_receiver(self, values_us: Sequence[int]) -> None:
        """Move the pilot's sticks and switches (`RcEngine.set_receiver`); a reboot leaves them."""
        self._transmitter_us = values_us
        self.ap.rc.set_receiver(values_us)

    def step(self, now_ns: int) -> None:
        """Advance the simulation to ``now_ns`` in whole control steps, then queue what is due.

        Missed control steps are all run; missed message slots are dropped.
        """
        steps = min((now_ns - self.ap.now_ns) // STEP_NS, MAX_STEPS_AT_ONCE)
        for _ in range(steps):
            self.ap.step()
            self.log.on_step(self.ap)
        self.pose = Pose(stamp_ns=self.ap.now_ns, body=self.ap.truth)
        self.server.step()
        if self.server.reboot_requested:
            self.reboot()

    def take_outgoing(self, link_id: int) -> bytes:
        """Bytes to send on a link: whole frames, in order."""
        return self.server.links[link_id].take_outgoing()

    def launch(self, start: AirborneStart) -> None:
        """Put the vehicle in the air in this state, armed and in ALT_HOLD."""
        self.ap.launch(start.position_ned_m, start.velocity_ned_mps, start.ned_from_body_wxyz)
        self.log.start_over(start.next_gate)
        self.pose = Pose(stamp_ns=self.ap.now_ns, body=self.ap.truth)

    def reboot(self) -> None:
        """Restart on the ground at the origin: time_boot_ms is 0, parameters stay."""
        self.ap = Autopilot(self.params, self._config, self.ap.now_ns)
        if self._transmitter_us is not None:
            self.ap.rc.set_receiver(self._transmitter_us)
        self.server.restart(self.ap)
        self.log.on_reboot()
