"""Discovery of the vehicle to fly among all senders on the link."""

from dataclasses import dataclass

from pymavlink.dialects.v20 import ardupilotmega as dialect

from mavbridge.core.address import LinkAddress, SerialAddress, TcpAddress, UdpAddress, spelled
from mavbridge.core.clock import NS_PER_MS, NS_PER_S
from mavbridge.core.errors import PeerError
from mavbridge.core.reasons import Code, Reason, because
from mavbridge.mavlink.codec.messages import Endpoint, Heartbeat
from mavbridge.mavlink.transport.connection import Address, Connection

AUTOPILOT_COMPONENT = 1
SETTLE_NS = 3 * NS_PER_S // 2
"""Time by which a second vehicle has been heard: every vehicle sends a heartbeat at 1 Hz."""
MOVED_NS = 3 * NS_PER_S
"""Silence after which a vehicle that is heard at a new address has moved there."""

_NOT_VEHICLES = (
    *(dialect.MAV_TYPE_GCS, dialect.MAV_TYPE_ONBOARD_CONTROLLER, dialect.MAV_TYPE_GIMBAL),
    *(dialect.MAV_TYPE_ADSB, dialect.MAV_TYPE_CAMERA, dialect.MAV_TYPE_ANTENNA_TRACKER),
)
_CAPACITY = 64
_MOVED_NS, _MOVED_STAMPS = 250 * NS_PER_MS, 3
"""Silence, and consecutive stamps of its clock from elsewhere, that mean a move in flight."""
_SILENT_NS = 500 * NS_PER_MS
"""Silence of the vehicle after which another sender with its system id ends the flight."""
_DUPLICATE_SYSTEMS = 16


@dataclass(frozen=True, slots=True, kw_only=True)
class VehicleIdentity:
    """System id, address and type of one vehicle."""

    source: Endpoint
    address: Address | None
    vehicle_type: int
    autopilot: int
    """MAV_AUTOPILOT."""

    @property
    def place(self) -> str:
        """The vehicle's address as text."""
        return _place(self.address)


class VehicleDiscovery:
    """Chooses component 1 of one vehicle, or explains why it cannot."""

    def __init__(self, *, target_system: int) -> None:
        self._target_system = target_system
        self._heard_ns: dict[VehicleIdentity, tuple[int, int]] = {}
        """First and last heartbeat of each vehicle, in the order of the last."""
        self._others: dict[str, Endpoint] = {}
        self._odd_ids: set[Endpoint] = set()
        """Autopilots with another component than 1, or with system 0."""
        self._first_ns: int | None = None

    def receive(
        self, source: Endpoint, heartbeat: Heartbeat, address: Address | None, now_ns: int
    ) -> None:
        """Note a heartbeat from any sender."""
        is_vehicle = (
            heartbeat.vehicle_type not in _NOT_VEHICLES
            and heartbeat.autopilot != dialect.MAV_AUTOPILOT_INVALID
        )
        if not is_vehicle:
            kind = dialect.enums["MAV_TYPE"].get(heartbeat.vehicle_type)
            name = kind.name.removeprefix("MAV_TYPE_") if kind else str(heartbeat.vehicle_type)
            if len(self._others) < _CAPACITY:
                named = f"{name} (system {source.system}, component {source.component})"
                self._others[named] = source
            return
        if source.component != AUTOPILOT_COMPONENT or source.system == 0:
            self._odd_ids.add(source)
            return
        vehicle = VehicleIdentity(
            source=source,
            address=address,
            vehicle_type=heartbeat.vehicle_type,
            autopilot=heartbeat.autopilot,
        )
        first_ns, _ = self._heard_ns.pop(vehicle, (now_ns, now_ns))
        if len(self._heard_ns) >= _CAPACITY:
            del self._heard_ns[next(iter(self._heard_ns))]
        self._heard_ns[vehicle] = first_ns, now_ns
        if self._first_ns is None and self._is_wanted(vehicle):
            self._first_ns = now_ns

    def _is_wanted(self, vehicle: VehicleIdentity) -> bool:
        return self._target_system in (0, vehicle.source.system)

    def _is_present(self, vehicle: VehicleIdentity) -> bool:
        """False for a type heard once among others at its address, perhaps damaged, or replaced."""
        others = [
            times
            for each, times in self._heard_ns.items()
            if (each.source, each.address) == (vehicle.source, vehicle.address) and each != vehicle
        ]
        first_ns, last_ns = self._heard_ns[vehicle]
        is_replaced = any(last_ns < first < last for first, last in others)
        return not others or (first_ns < last_ns and not is_replaced)

    def is_settling(self, now_ns: int) -> bool:
        """True if a vehicle was heard, but a second one may still appear."""
        return self._first_ns is not None and now_ns - self._first_ns < SETTLE_NS

    def choose(self, now_ns: int) -> VehicleIdentity | None:
        """Return the vehicle to fly, or None until it is certain.

        Raises:
            PeerError: several vehicles are possible, or two cannot be told apart.
        """
        if self._first_ns is None or self.is_settling(now_ns):
            return None
        present = filter(self._is_present, self._heard_ns)
        wanted = [vehicle for vehicle in present if self._is_wanted(vehicle)]
        systems = sorted({vehicle.source.system for vehicle in wanted})
        if len(systems) > 1:
            raise PeerError(
                f"several vehicles are on this link (systems {systems}): "
                "choose one with link.target_system"
            )
        if len(wanted) > 1:
            addresses = " and ".join(vehicle.place for vehicle in wanted)
            raise PeerError(
                f"two vehicles use system id {systems[0]} (from {addresses}): give one of them "
                "another id (MAV_SYSID, SYSID_THISMAV) or another port; if it is one by two "
                "routes, keep one of them off this port"
            )
        return wanted[0] if wanted else None

    def moved(self, vehicle: VehicleIdentity, now_ns: int) -> VehicleIdentity | None:
        """Return the vehicle at its new address or with its new type; None if it has neither."""
        # One that was followed to a new address may not have sent a heartbeat from there yet.
        if now_ns - self._heard_ns.setdefault(vehicle, (now_ns, now_ns))[1] < MOVED_NS:
            return None
        for other, (_, heard_ns) in self._heard_ns.items():
            if other.source == vehicle.source and now_ns - heard_ns < SETTLE_NS:
                return other
        return None

    def describe(
        self, address: LinkAddress, waited_s: float, connection: Connection, now_ns: int
    ) -> str:
        """Describe what was heard instead of the vehicle, with advice for this kind of link."""
        if self._heard_ns and self._first_ns is None:
            heard = ", ".join(str(s) for s in sorted({v.source.system for v in self._heard_ns}))
            silent = f"system {self._target_system} is silent"
            return f"{silent}, but system {heard} was heard: correct link.target_system"
        if self._odd_ids:
            odd = sorted(self._odd_ids)
            found = " and ".join(f"{each.system}, component {each.component}" for each in odd)
            return (
                f"an autopilot was heard as system {found}, and component {AUTOPILOT_COMPONENT} of "
                "another system than 0 is flown: set MAV_SYSID, SYSID_THISMAV or MAV_SYS_ID and "
                "MAV_COMP_ID (PX4), or mend the router that changes it"
            )
        if refused := connection.obstacles(now_ns):
            return "; ".join(refused)
        if self._others and set(self._others.values()) == {connection.source}:
            return (
                "heard only what this computer sends, or another mavbridge: are TX and RX joined, "
                "or does a router send packets back?"
            )
        if self._others:
            return (
                f"heard only {', '.join(sorted(self._others))}, which is no autopilot: connect to "
                "the vehicle's own port, or have the ground station forward it"
            )
        if connection.loss:
            advice = (
                "plug it in" if isinstance(address, SerialAddress) else "is its server running?"
            )
            return f"the connection is lost ({connection.loss}): {advice}"
        amount = f"{connection.received_bytes / 1000 / max(waited_s, 0.1):.1f} kB/s came"
        if 0 < connection.received_packets == connection.radio_packets:
            return (
                "heard only this end's telemetry radio (RADIO_STATUS): is the vehicle powered, and "
                "its radio paired?"
            )
        if connection.received_packets:
            return (
                f"{amount}, MAVLink without a heartbeat of any sender: the link loses most of it, "
                "or a router filters HEARTBEAT"
            )
        return _silence(address, amount if connection.received_bytes else None)


def _silence(address: LinkAddress, amount: str | None) -> str:
    """Explain why no MAVLink was heard; ``amount``: the bytes received instead, in words."""
    match address:
        case SerialAddress(baud=baud):
            heard = (
                f"the port is silent at {baud} baud: is the vehicle powered, are TX and RX crossed"
            )
            if amount:
                heard = f"{amount}, and no MAVLink in it: is {baud} the vehicle's baud rate"
            return (
                f"{heard}, and is MAVLink on that port (SERIALn_PROTOCOL 2 on ArduPilot, "
                "MAV_n_CONFIG on PX4)?"
            )
        case _ if amount:
            return (
                f"{amount}, and no MAVLink in it: another program or service is at this address, "
                "or a bridge to a serial port with another baud rate or protocol"
            )
        case TcpAddress(port=port):
            return (
                f"connected, and not a byte came: a simulator serves one client on TCP {port}: "
                "end the other one (a ground station, MAVProxy), or use another of its ports"
            )
        case UdpAddress(listens=True, port=port):
            return (
                f"heard nothing: is the vehicle running, and does it send to port {port} of "
                "this computer? (udp: listens, udpout: calls)"
            )
        case _:
            return (
                "nobody answered: is the vehicle running, and does it listen at this address? "
                "(udpout: calls, udp: listens)"
            )


class DuplicateSystems:
    """Other senders with the chosen vehicle's system id."""

    def __init__(self) -> None:
        self._reported: dict[Address | None, int] = {}
        """Time at which each was first heard."""
        self._replaced_ns: int | None = None
        self._moved_stamps = 0

    def has_moved(
        self, sender: Address | None, now_ns: int, heard_ns: int, *, is_same_clock: bool
    ) -> bool:
        """Process another sender's attitude; return True if it is the vehicle's own.

        If the vehicle, last heard at ``heard_ns``, was heard at its old address after this sender
        appeared, the sender is another route to the vehicle, or another vehicle.
        """
        if self._reported.get(sender, heard_ns) < heard_ns:
            return False
        is_own = is_same_clock and now_ns - heard_ns > _MOVED_NS
        self._moved_stamps = self._moved_stamps + 1 if is_own else 0
        if self._moved_stamps < _MOVED_STAMPS:
            return False
        self._moved_stamps = 0
        self._reported.pop(sender, None)  # else it could not move here a second time
        return True

    def notice(
        self, vehicle: VehicleIdentity, sender: Address | None, now_ns: int, heard_ns: int
    ) -> Reason | str | None:
        """Process another sender's heartbeat; ``heard_ns``: the vehicle's last message.

        Returns:
            A reason to end the flight if the vehicle is silent, once a second; else a text for
                the user, once per sender; else None.
        """
        system = vehicle.source.system
        if now_ns - heard_ns >= _SILENT_NS:
            if self._replaced_ns is not None and now_ns - self._replaced_ns <= NS_PER_S:
                return None
            self._replaced_ns = now_ns
            return because(Code.REPLACED, before=vehicle.place, system=system, now=_place(sender))
        if sender in self._reported or len(self._reported) >= _DUPLICATE_SYSTEMS:
            return None
        self._reported[sender] = now_ns
        return (
            f"system {system} is also heard from {_place(sender)}, which is ignored: the vehicle "
            f"is at {vehicle.place}; give it another system id, or keep it off this port"
        )


def _place(address: Address | None) -> str:
    """Return the address as text; a stream has none."""
    return "this connection" if address is None else spelled(*address)
