"""Who speaks on the link, and which of them is the vehicle to fly."""

from dataclasses import dataclass

from pymavlink.dialects.v20 import ardupilotmega as dialect

from mavbridge.clock import NS_PER_S
from mavbridge.errors import PeerError
from mavbridge.mavlink.messages import Heartbeat, Source
from mavbridge.mavlink.transport import Address

AUTOPILOT_COMPONENT = 1
SETTLE_NS = 3 * NS_PER_S // 2
"""Every vehicle beats at 1 Hz: after this long a second one on the link has been heard."""

_NOT_VEHICLES = frozenset(
    {
        dialect.MAV_TYPE_GCS,
        dialect.MAV_TYPE_ONBOARD_CONTROLLER,
        dialect.MAV_TYPE_GIMBAL,
        dialect.MAV_TYPE_ADSB,
        dialect.MAV_TYPE_CAMERA,
        dialect.MAV_TYPE_ANTENNA_TRACKER,
    }
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Peer:
    """The vehicle that was chosen."""

    source: Source
    address: Address | None
    vehicle_type: int
    autopilot: str


class Roster:
    """Chooses component 1 of one vehicle, and says what it heard when it cannot."""

    def __init__(self, *, target_system: int) -> None:
        self._target_system = target_system
        self._vehicles: dict[int, Peer] = {}
        self._others: set[str] = set()
        self._first_ns: int | None = None

    def hear(self, source: Source, beat: Heartbeat, address: Address | None, now_ns: int) -> None:
        """Note one heartbeat of anybody."""
        is_vehicle = (
            source.component == AUTOPILOT_COMPONENT
            and source.system != 0
            and beat.vehicle_type not in _NOT_VEHICLES
            and beat.autopilot != dialect.MAV_AUTOPILOT_INVALID
        )
        if not is_vehicle:
            kind = dialect.enums["MAV_TYPE"].get(beat.vehicle_type)
            name = kind.name.removeprefix("MAV_TYPE_") if kind else str(beat.vehicle_type)
            if len(self._others) < 16:
                self._others.add(f"{name} (system {source.system}, component {source.component})")
            return
        if source.system not in self._vehicles and len(self._vehicles) < 255:
            self._vehicles[source.system] = Peer(
                source=source,
                address=address,
                vehicle_type=beat.vehicle_type,
                autopilot=_AUTOPILOTS.get(beat.autopilot, "generic"),
            )
            self._first_ns = now_ns if self._first_ns is None else self._first_ns

    def choose(self, now_ns: int) -> Peer | None:
        """The vehicle to fly, or None while it is not certain.

        Raises:
            PeerError: two vehicles, and nobody said which.
        """
        if self._target_system:
            return self._vehicles.get(self._target_system)
        if self._first_ns is None or now_ns - self._first_ns < SETTLE_NS:
            return None
        if len(self._vehicles) > 1:
            raise PeerError(
                f"several vehicles are on this link (systems {sorted(self._vehicles)}): "
                "choose one with --target-system"
            )
        return next(iter(self._vehicles.values()))

    def describe(self) -> str:
        """What was heard instead of the vehicle, with advice."""
        if self._vehicles:
            heard = ", ".join(map(str, sorted(self._vehicles)))
            return (
                f"system {self._target_system} did not speak, but {heard} did: "
                "correct --target-system"
            )
        if self._others:
            return (
                f"heard only {', '.join(sorted(self._others))}, which is no autopilot: connect to "
                "the vehicle's own port, or have the ground station forward it"
            )
        return (
            "heard nothing: is the vehicle running, and does it send to this address? "
            "(udp: listens, udpout: calls)"
        )


_AUTOPILOTS = {
    dialect.MAV_AUTOPILOT_ARDUPILOTMEGA: "ardupilot",
    dialect.MAV_AUTOPILOT_PX4: "px4",
}
