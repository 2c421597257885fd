"""Vehicle session as an output sees it, set by hand."""

from types import SimpleNamespace
from typing import cast

from helpers.wire import WireEnd
from mavbridge.core.clock import NS_PER_MS, NS_PER_S
from mavbridge.core.reasons import Reason
from mavbridge.core.vehicle import Action, VehicleStatus
from mavbridge.mavlink.codec.calibration import RcCalibration
from mavbridge.mavlink.codec.messages import Body, Endpoint
from mavbridge.mavlink.codec.packets import Codec
from mavbridge.mavlink.outputs.output import ActionOutput, Encoded
from mavbridge.mavlink.profiles.profile import Profile, Traits
from mavbridge.mavlink.session.discovery import VehicleIdentity
from mavbridge.mavlink.session.vehicle import VehicleSession


class _Params(SimpleNamespace):
    """Parameters of a profile, and what they make of the vehicle."""

    @property
    def traits(self) -> Traits:
        traits: Traits = self.profile.traits(self.values)
        return traits


class FlownVehicle:
    """The part of a ``VehicleSession`` that outputs use; in the air and in a mode for setpoints."""

    def __init__(self, profile: Profile, calibration: RcCalibration | None = None) -> None:
        self.profile = profile
        self.identity = VehicleIdentity(
            source=Endpoint(1, 1), address=None, vehicle_type=2, autopilot=3
        )
        self.params = _Params(profile=profile, is_read=True, calibration=calibration, values={})
        self.condition = SimpleNamespace(is_receiver_hidden=False, is_released=True)
        self.mode = profile.modes.roles.setpoint[0]
        self.armed = True
        self.is_landed: bool | None = False
        self.has_receiver: bool | None = False
        self.is_failsafe = False
        self.rc_channels_us: tuple[int, ...] = ()
        self.texts: list[str] = []
        self.report = self.texts.append
        self.is_known = True
        """True if it has sent a heartbeat since its session began."""

    def use_output(self, _name: str) -> None:
        """No-op: its echo comes anyway."""

    def status(self, _now_ns: int) -> VehicleStatus | None:
        if not self.is_known:
            return None
        return VehicleStatus(
            mode=self.mode,
            armed=self.armed,
            is_landed=self.is_landed,
            has_receiver=self.has_receiver,
            is_failsafe=self.is_failsafe,
            rc_channels_us=self.rc_channels_us,
        )


class Flight:
    """An output and its vehicle, whose clock is set by hand."""

    def __init__(self, output: ActionOutput, vehicle: FlownVehicle) -> None:
        self.output = output
        self.vehicle = vehicle
        self.session = cast(VehicleSession, vehicle)
        self.now_ns = 100 * NS_PER_S
        self.end = WireEnd()

    def send(self, action: Action) -> Encoded:
        """Encode an action and record it as sent, 10 ms after the last."""
        self.now_ns += 10 * NS_PER_MS
        encoded = self.output.encode(action, self.session, self.now_ns)
        assert encoded is not None
        self.output.sent(encoded, self.now_ns)
        return encoded

    def receive(self, body: Body) -> None:
        """Receive a message of the vehicle a millisecond later."""
        self.now_ns += NS_PER_MS
        self.output.receive(body, self.session, self.now_ns)

    def message(self, encoded: Encoded) -> object:
        """Parse the packet by pymavlink."""
        (message,) = self.end.read(encoded.packet)
        return message

    @property
    def status(self) -> VehicleStatus:
        """Status of the vehicle as the guard gets it."""
        status = self.output.in_policy_terms(
            self.vehicle.status(self.now_ns), self.session, self.now_ns
        )
        assert status is not None
        return status

    @property
    def problem(self) -> Reason | None:
        """Why the output counts as overruled or unheard; None: it does not."""
        return self.output.overruled(self.now_ns) or self.output.unheard(self.now_ns)

    @property
    def is_released(self) -> bool:
        """True if the vehicle acts on something other than our last packets."""
        return self.output.is_released(self.session, self.now_ns)


def codec() -> Codec:
    """Return our own end of the wire."""
    return Codec(source_system=255)
