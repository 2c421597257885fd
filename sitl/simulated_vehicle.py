"""A complete vehicle without I/O: bytes in and out per link, and a clock that the caller steps."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from sitl.ardupilot.autopilot import ArduCopter
from sitl.ardupilot.params import ArduPilotParams
from sitl.ardupilot.server import ArduPilotServer
from sitl.clock import NS_PER_S
from sitl.course import AirborneStart, Course
from sitl.link.server import MavlinkServer
from sitl.px4.autopilot import Px4
from sitl.px4.params import Px4Params
from sitl.px4.server import Px4Server
from sitl.report import FlightLog
from sitl.vehicle.config import DEFAULT_VEHICLE, VehicleConfig
from sitl.vehicle.dynamics import BodyState
from sitl.vehicle.firmware import Autopilot, Severity

MAX_CATCH_UP_NS = NS_PER_S
"""Longest time simulated in one call; after a longer stall the rest follows in later calls."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Pose:
    """Vehicle state for the camera. Replaced as a whole, so any thread may read it."""

    stamp_ns: int
    body: BodyState


class SimulatedVehicle:
    """Autopilot, physics and MAVLink of one vehicle. Stamps use the caller's monotonic clock."""

    def __init__(
        self,
        *,
        links: int,
        boot_ns: int,
        config: VehicleConfig | None = None,
        course: Course | None = None,
    ) -> None:
        self._config = config = config or DEFAULT_VEHICLE
        self.log = FlightLog(boot_ns, course)
        self.params: ArduPilotParams | Px4Params
        """The firmware's parameters; they survive a reboot."""
        self.ap: Autopilot  # the flight controller since its last boot
        self.server: MavlinkServer[Any, Any]  # the vehicle's links
        is_px4 = config.autopilot == "px4"
        self.params = Px4Params(config) if is_px4 else ArduPilotParams(config)
        self._boot(links, boot_ns)
        self._transmitter_us: Sequence[int] | None = None
        self.pose = Pose(stamp_ns=boot_ns, body=self.ap.truth)

    def _boot(self, links: int, boot_ns: int) -> None:
        if isinstance(self.params, Px4Params):
            self.ap = px4 = Px4(self.params, self._config, boot_ns)
            self.server = Px4Server(px4, links, self.log)
        else:
            self.ap = copter = ArduCopter(self.params, self._config, boot_ns)
            self.server = ArduPilotServer(copter, links, self.log)

    def receive(self, link_id: int, data: bytes, now_ns: int) -> None:
        self.log.on_received(now_ns)
        self.server.receive(link_id, data, now_ns)

    def set_receiver(self, values_us: Sequence[int]) -> None:
        """Move the pilot's sticks and switches [us]; they survive a reboot."""
        self._transmitter_us = values_us
        self.ap.receiver.move(values_us)

    def step(self, now_ns: int) -> None:
        """Advance the simulation to ``now_ns`` in whole control steps, then queue due messages.

        All missed control steps are run; missed message slots are dropped.
        """
        ap = self.ap
        behind_ns = min(now_ns - ap.now_ns, MAX_CATCH_UP_NS)
        for _ in range(behind_ns // ap.step_ns):
            ap.step()
            had_crashed = self.log.crashed
            self.log.on_step(ap)
            if (crash := self.log.crash) is not None and not had_crashed:
                text = f"Crash: hit {crash.hit} at {crash.speed_mps:.1f} m/s"
                ap.send_text(Severity.CRITICAL, text)
        self.pose = Pose(stamp_ns=ap.now_ns, body=ap.truth)
        self.server.step(now_ns)
        if self.server.reboot_requested:
            self.reboot()

    def take_outgoing(self, link_id: int) -> bytes:
        outgoing: bytes = self.server.links[link_id].take_outgoing()
        return outgoing

    def launch(self, start: AirborneStart) -> None:
        """Put the vehicle into the air in this state, armed, in a mode with lean and climb
        sticks."""
        self.ap.launch(start.position_ned_m, start.velocity_ned_mps, start.ned_from_body_wxyz)
        self.log.start_over(start.next_gate)
        self.pose = Pose(stamp_ns=self.ap.now_ns, body=self.ap.truth)

    def reboot(self) -> None:
        """Restart on the ground at the origin: time_boot_ms is 0, parameters stay."""
        unsent = [link.take_outgoing() for link in self.server.links]
        self._boot(len(unsent), self.ap.now_ns)
        for link, data in zip(self.server.links, unsent, strict=True):
            link.pass_on(data)
        if self._transmitter_us is not None:
            self.ap.receiver.move(self._transmitter_us)
        self.log.on_reboot()
