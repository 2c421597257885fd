"""The other end of the wire, written with the dialect alone: packs messages and reads ours."""

from pymavlink.dialects.v20 import ardupilotmega as dialect


class WireEnd:
    """A MAVLink endpoint for tests."""

    def __init__(self, system: int = 1, component: int = 1) -> None:
        self.mav = dialect.MAVLink(None, srcSystem=system, srcComponent=component)
        self.mav.robust_parsing = True

    def pack(self, message: dialect.MAVLink_message) -> bytes:
        data: bytes = message.pack(self.mav)
        self.mav.seq = (self.mav.seq + 1) % 256
        return data

    def read(self, data: bytes) -> list[dialect.MAVLink_message]:
        return self.mav.parse_buffer(data) or []

    def heartbeat(
        self,
        *,
        vehicle_type: int = dialect.MAV_TYPE_QUADROTOR,
        autopilot: int = dialect.MAV_AUTOPILOT_ARDUPILOTMEGA,
        mode: int = 2,
        armed: bool = False,
    ) -> bytes:
        base = 1 | (128 if armed else 0)
        return self.pack(self.mav.heartbeat_encode(vehicle_type, autopilot, base, mode, 3))
