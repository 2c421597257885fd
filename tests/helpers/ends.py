"""Far ends of a simulated vehicle's links."""

from pymavlink.dialects.v20 import ardupilotmega as mav

from sitl.clock import NS_PER_S
from sitl.simulated_vehicle import SimulatedVehicle
from sitl.vehicle.config import STEP_NS, VehicleConfig


class Ends:
    """Far ends of a vehicle's links, on a clock that the test steps."""

    def __init__(self, links=1, config=None):
        self.vehicle = SimulatedVehicle(links=links, boot_ns=0, config=config)
        self.now_ns = 0
        self._parsers = [mav.MAVLink(None) for _ in range(links)]
        self._sender = mav.MAVLink(None, srcSystem=255, srcComponent=190)

    @property
    def ap(self):
        return self.vehicle.ap

    def pack(self, message, system_id=255, component_id=190):
        self._sender.srcSystem, self._sender.srcComponent = system_id, component_id
        return message.pack(self._sender)

    def send(self, message, link=0, system_id=255, component_id=190):
        self.vehicle.receive(link, self.pack(message, system_id, component_id), self.now_ns)

    def run(self, seconds, sticks=None, link=0):
        """Step on, sending ``sticks`` (link: x, y, z, r) at 50 Hz; return messages on ``link``."""
        received = []
        for step in range(round(seconds * NS_PER_S / STEP_NS)):
            if step % 8 == 0:
                for source, values in (sticks or {}).items():
                    self.send(mav.MAVLink_manual_control_message(1, *values, 0), source)
            self.now_ns += STEP_NS
            self.vehicle.step(self.now_ns)
            received += self._parsers[link].parse_buffer(self.vehicle.take_outgoing(link)) or []
        return received

    def interval(self, message_id, rate_hz, link=0):
        return self.command(mav.MAV_CMD_SET_MESSAGE_INTERVAL, message_id, 1e6 / rate_hz, link=link)

    def command(self, number, *params, link=0):
        padded = (*params, *[0.0] * (7 - len(params)))
        self.send(mav.MAVLink_command_long_message(1, 1, number, 0, *padded), link)
        acks = [m for m in self.run(0.01, link=link) if m.get_type() == "COMMAND_ACK"]
        return acks[-1].result if acks else None


def px4_ends(links=1, **changes):
    """Far ends of a PX4 that is ready at once; ``changes`` as in ``VehicleConfig``."""
    ready = {"receiver_us": None, "estimator_ready_s": 0.0, "position_ready_s": 0.0}
    return Ends(links, VehicleConfig(autopilot="px4", **ready, **changes))
