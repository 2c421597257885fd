"""Who speaks on the link, and which of them is the vehicle to fly."""

from dataclasses import dataclass

from pymavlink.dialects.v20 import ardupilotmega as dialect

from mavbridge.core.clock import NS_PER_S
from mavbridge.core.errors import PeerError
from mavbridge.mavlink.codec.messages import Heartbeat, Source
from mavbridge.mavlink.transport.sockets import Address

AUTOPILOT_COMPONENT = 1
SETTLE_NS = 3 * NS_PER_S // 2
"""Every vehicle beats at 1 Hz: after this long a second one on the link has been heard."""
MOVED_NS = 3 * NS_PER_S
"""Silence after which a vehicle that speaks from a new address has moved there."""

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
_AUTOPILOTS = {
    dialect.MAV_AUTOPILOT_ARDUPILOTMEGA: "ardupilot",
    dialect.MAV_AUTOPILOT_PX4: "px4",
}
_MOST_KEPT = 64


@dataclass(frozen=True, slots=True, kw_only=True)
class Peer:
    """A vehicle: one system id at one address."""

    source: Source
    address: Address | None
    vehicle_type: int
    autopilot: str


class Roster:
    """Chooses component 1 of one vehicle, and says what it heard when it cannot."""

    def __init__(self, *, target_system: int) -> None:
        self._target_system = target_system
        self._heard_ns: dict[Peer, int] = {}
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
            self._note_other(source, beat)
            return
        peer = Peer(
            source=source,
            address=address,
            vehicle_type=beat.vehicle_type,
            autopilot=_AUTOPILOTS.get(beat.autopilot, "generic"),
        )
        if peer in self._heard_ns or len(self._heard_ns) < _MOST_KEPT:
            self._heard_ns[peer] = now_ns
        if self._first_ns is None and self._is_wanted(peer):
            self._first_ns = now_ns

    def _note_other(self, source: Source, beat: Heartbeat) -> None:
        kind = dialect.enums["MAV_TYPE"].get(beat.vehicle_type)
        name = kind.name.removeprefix("MAV_TYPE_") if kind else str(beat.vehicle_type)
        if len(self._others) < _MOST_KEPT:
            self._others.add(f"{name} (system {source.system}, component {source.component})")

    def _is_wanted(self, peer: Peer) -> bool:
        return self._target_system in (0, peer.source.system)

    @property
    def is_settling(self) -> bool:
        """A vehicle was heard; whether it is the only one is not certain yet."""
        return self._first_ns is not None

    def choose(self, now_ns: int) -> Peer | None:
        """The vehicle to fly, or None while it is not certain.

        Raises:
            PeerError: two vehicles, and nobody said which, or they cannot be told apart.
        """
        if self._first_ns is None or now_ns - self._first_ns < SETTLE_NS:
            return None
        wanted = [peer for peer in self._heard_ns if self._is_wanted(peer)]
        systems = sorted({peer.source.system for peer in wanted})
        if len(systems) > 1:
            raise PeerError(
                f"several vehicles are on this link (systems {systems}): "
                "choose one with --target-system"
            )
        if len(wanted) > 1:
            raise PeerError(
                f"two vehicles call themselves system {systems[0]} "
                f"(from {' and '.join(str(peer.address) for peer in wanted)}): give one of them "
                "another id (MAV_SYSID, SYSID_THISMAV) or another port"
            )
        return wanted[0]

    def moved(self, peer: Peer, now_ns: int) -> Peer | None:
        """The same vehicle at the address it speaks from now, if it has moved."""
        if now_ns - self._heard_ns.get(peer, 0) < MOVED_NS:
            return None
        for other, heard_ns in self._heard_ns.items():
            if other.source == peer.source and now_ns - heard_ns < SETTLE_NS:
                return other
        return None

    def describe(self) -> str:
        """What was heard instead of the vehicle, with advice."""
        if self._heard_ns:
            heard = ", ".join(str(s) for s in sorted({p.source.system for p in self._heard_ns}))
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
