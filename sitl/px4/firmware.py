"""PX4 as a whole: parameters, flight controller and links of one vehicle."""

from sitl.px4.autopilot import Autopilot
from sitl.px4.link.server import MavlinkServer
from sitl.px4.params import Params
from sitl.report import FlightLog
from sitl.vehicle.config import VehicleConfig


class Px4:
    """A `sitl.firmware.Firmware`."""

    def __init__(self, config: VehicleConfig, links: int, boot_ns: int, log: FlightLog) -> None:
        self.params = Params(
            config.conditions, receiver=config.receiver, release=config.px4_release
        )
        self.ap = Autopilot(self.params, config, boot_ns)
        self.server = MavlinkServer(self.ap, links, log)

    def reboot(self) -> None:
        """Restart on the ground at the origin."""
        self.ap = Autopilot(self.params, self.ap.config, self.ap.now_ns)
        self.server.restart(self.ap)
