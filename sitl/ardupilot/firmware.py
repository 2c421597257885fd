"""ArduCopter as a whole: parameters, flight controller and links of one vehicle."""

from sitl.ardupilot.autopilot import Autopilot
from sitl.ardupilot.link.server import MavlinkServer
from sitl.ardupilot.params import Params
from sitl.report import FlightLog
from sitl.vehicle.config import VehicleConfig


class ArduCopter:
    """A `sitl.firmware.Firmware`."""

    def __init__(self, config: VehicleConfig, links: int, boot_ns: int, log: FlightLog) -> None:
        self.params = Params(config.conditions, config.ardupilot_release)
        self.ap = Autopilot(self.params, config, boot_ns)
        self.server = MavlinkServer(self.ap, links, log)

    def reboot(self) -> None:
        """Restart on the ground at the origin."""
        self.ap = Autopilot(self.params, self.ap.config, self.ap.now_ns)
        self.server.restart(self.ap)
