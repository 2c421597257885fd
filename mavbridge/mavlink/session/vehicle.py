"""Session with one vehicle: its set-up, its state, and reasons why it cannot be flown.

A state machine without I/O. The link steps it at every tick, so that connecting, reconnecting and a
reboot of the vehicle are handled alike, and none of them blocks the guard.
"""

from collections.abc import Callable, Iterator
from dataclasses import replace

from pymavlink.dialects.v20 import ardupilotmega as dialect

from mavbridge.core.clock import NS_PER_S
from mavbridge.core.errors import PeerError
from mavbridge.core.link_settings import LinkSettings
from mavbridge.core.reasons import Code, Reason, because
from mavbridge.core.switch import Switch
from mavbridge.core.vehicle import ModeRoles, Output, VehicleStatus, said_by_vehicle
from mavbridge.mavlink.codec.messages import (
    RESTART_STEP_US,
    Attitude,
    AutopilotVersion,
    CommandAck,
    CommandRequest,
    CurrentMode,
    Event,
    Heartbeat,
    ParamAbsent,
    ParamValue,
    RcChannels,
    ReceivedMessage,
    Request,
    StampOrder,
    StatusText,
    later_by_us,
)
from mavbridge.mavlink.profiles.ardupilot import ARDUPILOT
from mavbridge.mavlink.profiles.profile import HOME_HEIGHT, Profile, StreamGroup
from mavbridge.mavlink.profiles.px4 import PX4
from mavbridge.mavlink.session.condition import SETTLE_NS, VehicleCondition
from mavbridge.mavlink.session.discovery import VehicleIdentity
from mavbridge.mavlink.session.streams import StreamRequester
from mavbridge.mavlink.session.vehicle_params import VehicleParams

_PROFILES: dict[int, Profile] = {
    dialect.MAV_AUTOPILOT_ARDUPILOTMEGA: ARDUPILOT,
    dialect.MAV_AUTOPILOT_PX4: PX4,
}
_MULTIROTORS = (
    *(dialect.MAV_TYPE_QUADROTOR, dialect.MAV_TYPE_HEXAROTOR, dialect.MAV_TYPE_OCTOROTOR),
    *(dialect.MAV_TYPE_TRICOPTER, dialect.MAV_TYPE_COAXIAL),
    *(dialect.MAV_TYPE_DECAROTOR, dialect.MAV_TYPE_DODECAROTOR),
)


def require_profile(autopilot: int, vehicle_type: int) -> Profile:
    """Return the profile of a multirotor's firmware.

    Raises:
        PeerError: the firmware is not supported, or the vehicle is no multirotor.
    """
    if autopilot not in _PROFILES:
        raise PeerError(
            f"the vehicle's firmware is {_name('MAV_AUTOPILOT', autopilot)}, and only ArduPilot "
            "and PX4 are flown"
        )
    if vehicle_type not in _MULTIROTORS:
        name = _name("MAV_TYPE", vehicle_type)
        raise PeerError(f"the vehicle is a {name}, and only multirotors are flown")
    return _PROFILES[autopilot]


def _name(enum: str, number: int) -> str:
    entry = dialect.enums[enum].get(number)
    name = entry.name.removeprefix(f"{enum}_") if entry else "unknown"
    return f"{name} ({enum} {number})"


_WAIT_NS = NS_PER_S
"""Longest wait for a missing piece of a text."""
_GAP = "..."


class TextJoiner:
    """Joins the pieces of one text as they arrive; a missing piece becomes dots."""

    def __init__(self) -> None:
        self._text_id = self._whole_id = 0
        self._pieces: list[str] = []
        self._since_ns = 0

    def receive(self, body: StatusText, now_ns: int) -> list[str]:
        """Add a piece; return the texts that are complete, or will not become so."""
        if body.text_id == 0:
            return [body.text.rstrip()]
        if body.text_id == self._whole_id:  # a piece that came twice
            return []
        texts = [] if body.text_id == self._text_id else self._end()
        if not self._pieces:
            self._text_id, self._since_ns = body.text_id, now_ns
        missing = body.sequence - len(self._pieces)
        if missing < 0:  # a piece that came twice
            return texts
        self._pieces += [*[_GAP] * missing, body.text]
        return texts if body.is_full else texts + self._end(is_whole=True)

    def step(self, now_ns: int) -> list[str]:
        """Return the text whose missing pieces are overdue, if any."""
        return self._end() if now_ns - self._since_ns > _WAIT_NS else []

    def _end(self, *, is_whole: bool = False) -> list[str]:
        if is_whole and _GAP not in self._pieces:
            self._whole_id = self._text_id
        text, self._pieces = "".join(self._pieces), []
        return [(text if is_whole else text + _GAP).rstrip()] if text else []


RECEIVER_WAIT_NS = 2 * NS_PER_S
"""Longest wait, after the streams are granted, for RC_CHANNELS and SYS_STATUS to show a receiver.
SYS_STATUS comes at 2 Hz, and some firmware sends RC_CHANNELS only with a receiver."""
HEARTBEAT_TIMEOUT_NS = 3 * NS_PER_S
"""Three missed heartbeats at 1 Hz mean that the vehicle is lost."""
_UPSET_NS = NS_PER_S
_FASTEST_CLOCK, _BOOT_SLACK_NS = 10, NS_PER_S
"""Bounds for a reboot: the new uptime must not exceed the silence, times the pace of the fastest
simulator clock, plus a margin."""
_VERSION_NS = NS_PER_S
"""Time between two requests for the version, until it comes."""


class VehicleSession:
    """One vehicle from its first heartbeat to its next reboot.

    Reads its version and its parameters, then requests its streams and keeps them coming.

    Raises:
        PeerError: the vehicle cannot be flown.
    """

    def __init__(
        self,
        identity: VehicleIdentity,
        config: LinkSettings,
        *,
        old_params: dict[str, float],
        report: Callable[[str], None],
        has_slow_clock: Callable[[], bool] = lambda: False,
    ) -> None:
        """``old_params``: receives the values from before ``--set``, by name."""
        self.profile = require_profile(identity.autopilot, identity.vehicle_type)
        self.identity = identity
        self.report = report
        """Shows a text to the user."""
        self._texts = TextJoiner()
        self.version: str | None = None
        self._version_due_ns = 0
        streams = self.profile.streams(state_hz=config.state_hz, pilot_hz=config.pilot_hz)
        self._streams = StreamRequester(streams, report=report, has_slow_clock=has_slow_clock)
        self._echo: StreamGroup | None = None
        """Echo of the output; None until it is chosen."""
        self._pilot_due_ns: int | None = None
        """Deadline for the pilot's sticks to be shown; None until everything else is ready."""
        self.params = VehicleParams(
            self.profile, config, streams=streams, old_params=old_params, report=report
        )
        self.condition = VehicleCondition(
            self.profile, self.params, min_battery_percent=config.min_battery_percent
        )
        self._switch = Switch()
        """Override switch; between high and low it keeps its state, as in the vehicle."""
        self._boot_order, self._stamped_ns = StampOrder(), 0
        self.has_rebooted = False
        """True if the vehicle's clock has restarted since it was last heard."""
        self._upset: tuple[int, Reason] | None = None
        self._mode_sequence, self._mode_ns = 0, -SETTLE_NS
        """Sequence number and arrival of the last HEARTBEAT or CURRENT_MODE."""
        self._event_sequence: int | None = None

    def use_output(self, output: Output) -> None:
        """Fly with this output from now on: request its echo, check its demands."""
        self.params.use_output(output)
        self._echo = self.profile.echo(output)
        self._streams.add(self._echo)

    def watch_home_height(self) -> None:
        """Request the height above home, often enough to fly by."""
        self._streams.add(HOME_HEIGHT)

    def receive(self, message: ReceivedMessage, arrived_ns: int) -> None:
        """Process one message from this vehicle."""
        self._streams.receive(message.name, arrived_ns)
        body = message.body
        if isinstance(body, Heartbeat | CurrentMode) and self._is_overtaken(message, arrived_ns):
            return
        if isinstance(body, Event) and self._is_old(body):
            return
        self.condition.receive(body, arrived_ns)
        match body:
            case Attitude():
                self._watch_boot(body.boot_us, arrived_ns)
            case RcChannels(channels_us) if (switch := self.params.override_switch) is not None:
                in_range = switch <= len(channels_us)
                self._switch.read(channels_us[switch - 1] if in_range else 0, arrived_ns)
            case CommandAck():
                self._streams.receive_ack(body)
            case ParamValue() | ParamAbsent():
                self.params.receive(body, self.status(arrived_ns))
            case AutopilotVersion(version):
                self.version = version
                self.params.use_version(version)
            case StatusText():
                self._show(*self._texts.receive(body, arrived_ns))
            case Event(event_id) if (meaning := self.profile.events.get(event_id)) is not None:
                self._show(*([meaning.text] if meaning.text else []))

    def _is_overtaken(self, message: ReceivedMessage, arrived_ns: int) -> bool:
        """True if a later report of the mode has arrived within the last 100 ms.

        The old mode would look like a pilot's change back to it.
        """
        is_behind = (message.sequence - self._mode_sequence) % 256 > 128
        if is_behind and arrived_ns - self._mode_ns < SETTLE_NS:
            return True
        self._mode_sequence, self._mode_ns = message.sequence, arrived_ns
        return False

    def _is_old(self, event: Event) -> bool:
        """True for a late or doubled EVENT, and for one that another station has asked for again.

        It would disarm an armed vehicle, or put it into a failsafe that is over.
        """
        before = self._event_sequence
        if before is not None and not 0 < (event.sequence - before) % 65536 < 32768:
            return True
        self._event_sequence = event.sequence
        return False

    def _show(self, *texts: str) -> None:
        for text in texts:
            self.report(said_by_vehicle(text))

    def _watch_boot(self, boot_us: int, arrived_ns: int) -> None:
        before_us = self._boot_order.newest_us
        if boot_us == 0 or not self._boot_order.accepts(boot_us):
            return
        silent_ns, self._stamped_ns = arrived_ns - self._stamped_ns, arrived_ns
        back_us = -later_by_us(boot_us, before_us)
        if back_us <= RESTART_STEP_US:
            return
        if 1000 * boot_us > _FASTEST_CLOCK * silent_ns + _BOOT_SLACK_NS:  # its clock was set back
            reason = because(Code.CLOCK_SET_BACK, back_s=back_us / 1_000_000)
            self.end_engagement(reason, arrived_ns)
        else:
            self.has_rebooted = True

    def step(self, now_ns: int) -> Iterator[Request]:
        """Yield the requests that are due."""
        self._show(*self._texts.step(now_ns))
        if self.version is None and now_ns >= self._version_due_ns:
            self._version_due_ns = now_ns + _VERSION_NS
            number = float(dialect.MAVLINK_MSG_ID_AUTOPILOT_VERSION)
            yield CommandRequest(dialect.MAV_CMD_REQUEST_MESSAGE, (number,))
        # Parameters first: a vehicle slows its streams down while it sends parameters.
        yield from self.params.step(now_ns, self.status(now_ns))
        if not self.params.is_read:
            return
        if (request := self._streams.step(now_ns)) is not None:
            yield request
        yield from self._streams.stand_ins(now_ns)
        if self.condition.receiver_due_ns is None and self._streams.is_settled:
            self.condition.receiver_due_ns = now_ns + RECEIVER_WAIT_NS

    def unfinished(self, now_ns: int) -> Reason | None:
        """Return the unfinished step of the set-up, or None."""
        if not self.params.is_read:
            return because(Code.READING_PARAMETERS)
        has_echo = self._echo is None or self._streams.has_settled(self._echo)
        if not has_echo or (not self._streams.is_settled and self._streams.renewals == 0):
            return because(Code.REQUESTING_TELEMETRY)
        if not self.condition.is_receiver_settled(now_ns):
            return because(Code.LOOKING_FOR_RECEIVER)
        return None

    def status(self, now_ns: int) -> VehicleStatus | None:
        """Return the vehicle's status; None before its first heartbeat."""
        return self.condition.status(now_ns)

    def roles(self, status: VehicleStatus | None) -> ModeRoles:
        """Return the modes' roles; a receiver may follow our sticks without a failsafe."""
        roles = self.profile.modes.roles
        has_receiver = status is not None and status.has_receiver is True
        if has_receiver and self.params.traits.falls_back:
            return replace(roles, is_silence_failsafe=False)
        return roles

    def problem(self, now_ns: int) -> Reason | None:
        """Return why the vehicle cannot be flown now with any output, or None."""
        if self.condition.heartbeat is None:
            return because(Code.NO_HEARTBEAT)
        if now_ns - self.condition.heartbeat[0] > HEARTBEAT_TIMEOUT_NS:
            return because(Code.HEARTBEAT_LOST)
        if self._upset is not None and now_ns - self._upset[0] < _UPSET_NS:
            return self._upset[1]
        return self.unfinished(now_ns) or self.params.changes.problem()

    def end_engagement(self, reason: Reason, now_ns: int) -> None:
        """Make ``problem`` return this reason, for long enough to end an engagement in order."""
        self._upset = now_ns, reason

    def output_problem(self, now_ns: int) -> Reason | None:
        """Return why the vehicle cannot be flown now with the chosen output, or None."""
        problem = self.params.output_problem(self.status(now_ns)) or self.switch_problem
        if problem is None and self._is_pilot_awaited(now_ns):
            return because(Code.LOOKING_FOR_RECEIVER)
        return problem

    def _is_pilot_awaited(self, now_ns: int) -> bool:
        """True until the vehicle has shown the sticks that it would get back, or 2 s have passed.

        Ours hide them from the first packet on.
        """
        echo, falls_back = self.profile.stick_echo, self.params.traits.falls_back
        if self._echo is not echo or not falls_back or not self.condition.has_receiver:
            return False
        if self._streams.has_come(echo.messages[0]):
            return False
        if self._pilot_due_ns is None:
            self._pilot_due_ns = now_ns + RECEIVER_WAIT_NS
        return now_ns < self._pilot_due_ns

    @property
    def switch_problem(self) -> Reason | None:
        """Why the override switch blocks our sticks, or None."""
        switch = self.params.override_switch
        if switch is not None and not self._switch.is_on:
            return because(Code.OVERRIDE_SWITCH_NOT_ON, channel=switch)
        return None

    @property
    def is_switched_off(self) -> bool:
        """True if the pilot's override switch is low, so that the vehicle ignores our sticks."""
        return self.params.override_switch is not None and self._switch.is_off
