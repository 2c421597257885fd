"""Parameters of one vehicle: known values, demands of the flight, and changes for it."""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import NamedTuple

from pymavlink.dialects.v20 import ardupilotmega as dialect

from mavbridge.core.address import serial_baud
from mavbridge.core.clock import NS_PER_MS, NS_PER_S
from mavbridge.core.link_settings import LinkSettings
from mavbridge.core.reasons import Code, Reason, because
from mavbridge.core.vehicle import AdviceText, Output, VehicleStatus
from mavbridge.mavlink.codec.calibration import RcCalibration
from mavbridge.mavlink.codec.frames import SIGNATURE_BYTES
from mavbridge.mavlink.codec.messages import (
    CommandRequest,
    ParamAbsent,
    ParamRequest,
    ParamValue,
    ParamWrite,
)
from mavbridge.mavlink.codec.readers import IDS
from mavbridge.mavlink.profiles.profile import ParamContext, ParamNote, Profile, StreamGroup
from mavbridge.mavlink.session.temporary_params import TemporaryParams

_FRAME_BYTES = 12
"""Header and checksum of MAVLink 2."""
_OVERRIDE_BYTES = 30
"""RC_CHANNELS_OVERRIDE of eight channels; MANUAL_CONTROL is shorter."""
_OTHERS_BYTES_PER_S = 500
"""Heartbeats, TIMESYNC and requests, per direction."""
_BITS_PER_BYTE = 10
"""One start bit, eight data bits, one stop bit."""
_STANDARD_BAUDS = (57600, 115200, 230400, 460800, 921600, 1500000, 3000000)


class Assessment(NamedTuple):
    """Result of checking one set of parameters."""

    context: ParamContext
    calibration: RcCalibration | None
    unusable: str | None
    """Why a calibration that the output needs is missing; None: it is not."""
    override_switch: int | None
    """Number of the channel that enables the output."""
    notes: tuple[ParamNote, ...]
    """All notes; those of kind risk are not accepted."""
    unread: tuple[str, ...]
    """Parameters with a wanted value that the vehicle has not sent."""

    @property
    def obstacles(self) -> tuple[ParamNote, ...]:
        """Reasons why the vehicle would not follow our commands."""
        return tuple(note for note in self.notes if note.kind == "obstacle")

    @property
    def risks(self) -> tuple[ParamNote, ...]:
        """Risks that the user has not accepted."""
        return tuple(note for note in self.notes if note.kind == "risk")

    def endangers(self, before: "Assessment") -> bool:
        """True if these parameters must end a flight that began with ``before``."""
        return (
            self.calibration != before.calibration
            or self.override_switch != before.override_switch
            or not {each.names for each in self.obstacles}
            <= {each.names for each in before.obstacles}
            or not {each.risk for each in self.risks} <= {each.risk for each in before.risks}
        )


def assess(profile: Profile, values: Mapping[str, float], context: ParamContext) -> Assessment:
    """Check the parameters of a vehicle of this firmware."""
    is_override = context.output == "rc-override"
    ours: RcCalibration | None = None
    unusable: str | None = None
    try:
        ours = profile.calibration(values)
    except ValueError as error:
        unusable = str(error) if is_override else None
    switch = profile.traits(values).override_switch if is_override else None
    all_notes, accepted = [*context.serial, *profile.notes(values, context)], context.accepted_risks
    wanted = [note.names[0] for note in all_notes if note.kind == "wanted"]
    if unread := tuple(name for name in wanted if name not in values):
        effect = "whether it flies as told, and what it does if this computer dies, is not known"
        said = f"the vehicle has not sent {', '.join(unread)}: {effect} (mavbridge check)"
        all_notes.append(ParamNote("advice", unread, said))
    notes = tuple(note.accepted() if note.risk in accepted else note for note in all_notes)
    return Assessment(context, ours, unusable, switch, notes, unread)


def received_bytes_per_s(streams: Iterable[StreamGroup], frame_bytes: int = _FRAME_BYTES) -> float:
    """Return the bandwidth of these streams with full-length messages, rare ones excluded."""
    streamed: float = sum(
        stream.rate_hz * (frame_bytes + dialect.mavlink_map[IDS[stream.messages[0]]].unpacker.size)
        for stream in streams
        if stream.least_hz is None
    )
    return _OTHERS_BYTES_PER_S + streamed


def serial_risks(settings: LinkSettings, streams: Iterable[StreamGroup]) -> tuple[ParamNote, ...]:
    """Return the risk of too low a baud rate: the fuller direction of the serial port decides."""
    baud = serial_baud(settings.connect)
    signature_bytes = 0 if settings.signing is None else SIGNATURE_BYTES
    sent_bytes_per_s = _OTHERS_BYTES_PER_S + settings.stick_hz * (_OVERRIDE_BYTES + signature_bytes)
    received = received_bytes_per_s(streams, _FRAME_BYTES + signature_bytes)
    needed = max(received, sent_bytes_per_s) * _BITS_PER_BYTE
    if baud is None or baud >= needed:
        return ()
    enough = next((rate for rate in _STANDARD_BAUDS if rate >= needed), needed)
    why = because(Code.SLOW_SERIAL, baud=baud, needed=needed, enough=enough)
    return (ParamNote.of_risk("slow-serial", why),)


_WINDOW = 16
"""Requests in flight at once; ArduPilot queues twenty."""
_TIMEOUT_NS = 300 * NS_PER_MS
_ATTEMPTS = 4
_AGAIN_NS = 2 * NS_PER_S
"""Time between attempts to read parameters that the vehicle did not send."""
_FOLLOW_UPS = 3
"""Number of times that a command is sent, one second apart, since one may get lost."""


class VehicleParams:
    """Reads the parameters, sets some for the flight, and tells why they forbid one.

    All relevant parameters are read at once, for any output. Later values, set by anyone, affect
    the problems at once. The calibration follows while the vehicle is disarmed; a change in flight
    that matters is an interruption.
    """

    def __init__(
        self,
        profile: Profile,
        config: LinkSettings,
        *,
        streams: tuple[StreamGroup, ...],
        old_params: dict[str, float],
        report: Callable[[str], None],
    ) -> None:
        self._profile = profile
        self._config = config
        self._report = report
        risks, port = config.accepted_risks, serial_risks(config, streams)
        self._booted: dict[str, float] = {}
        system = config.source_system
        self._context = ParamContext(None, system, None, None, risks, port, self._booted)
        self._open: dict[str, tuple[int, int]] = {}
        """Time of the last request and number of requests, by name of a parameter to read."""
        self.has_answered = False
        """True if the vehicle has answered any of the requests."""
        self._relevant: set[str] = set()
        self._kinds: dict[str, int] = {}
        """MAV_PARAM_TYPE of each relevant parameter that was received."""
        self._again_ns = self._rounds = 0
        """Next attempt to read what the vehicle did not send, and number of these attempts."""
        self.values: dict[str, float] = {}
        """Relevant parameters received from the vehicle, by name."""
        self._read((*profile.params, *(name for name, _ in config.set_params)))
        self.traits = profile.traits(self.values)
        """What these parameters make of the vehicle."""
        self.changes = TemporaryParams(config.set_params, before=old_params, report=report)
        """Parameters that are set for the flight."""
        self._follow_up: CommandRequest | None = None
        self._follow_ups_left = self._follow_up_ns = 0
        """Number of times still to send this command, and the time of the next."""
        self._advised: Assessment | None = None
        """What the user was last advised about."""
        self._assessed: Assessment | None = None
        self.is_read = False
        """True if every parameter has arrived or was given up."""
        self.calibration: RcCalibration | None = None
        """Radio calibration of the flight; None until it is read, or if it is unusable."""
        self.interruption: Reason | None = None
        """Change in flight that ends all engagements so far, or None; stays set."""

    @property
    def override_switch(self) -> int | None:
        """Number of the channel that enables the output, or None."""
        return self._assessed.override_switch if self._assessed else None

    def use_output(self, output: Output) -> None:
        """Check the parameters for this output from now on."""
        self._context = self._context._replace(output=output)

    def use_version(self, version: str) -> None:
        """Check the parameters for this version of the firmware from now on."""
        self._context = self._context._replace(version=version)

    def receive(self, param: ParamValue | ParamAbsent, status: VehicleStatus | None) -> None:
        """Process a PARAM_VALUE, requested or not, or note that a parameter does not exist."""
        if not self.has_answered:  # what was given up before may only have been lost
            self.has_answered = True
            self.is_read = self.is_read and status is not None and status.armed
            self._read(tuple(self._relevant))
        if isinstance(param, ParamAbsent):
            self._open.pop(param.name, None)
            return
        if self._profile.is_bytewise:
            param = param.from_bytes()
        if not math.isfinite(param.value):
            return
        self._open.pop(param.name, None)
        self.changes.receive(param)
        old = self.values.get(param.name)
        if param.name not in self._relevant or param.value == old:
            return
        self.values[param.name], self._kinds[param.name] = param.value, param.kind
        self._booted.setdefault(param.name, param.value)
        self.traits = self._profile.traits(self.values)
        if not self.is_read:
            return
        if (
            old is not None
            and param.name in dict(self._config.set_params)
            and (command := self._profile.follow_up(param.name, old, param.value)) is not None
        ):
            self._follow_up, self._follow_ups_left, self._follow_up_ns = command, _FOLLOW_UPS, 0
        before, self._assessed = self._assessed, None
        after = self._current(status)
        is_armed = status is not None and status.armed
        if is_armed and old is not None and before is not None and after.endangers(before):
            self.interruption = because(
                Code.PARAMETER_CHANGED, name=param.name, before=old, after=param.value
            )

    def step(
        self, now_ns: int, status: VehicleStatus | None
    ) -> Iterator[ParamRequest | ParamWrite | CommandRequest]:
        """Yield the requests that are due."""
        yield from self._read_requests(now_ns)
        if not self._open:
            self._ask_for_missing(now_ns, status)
        if not self._open:
            self._take_in(status)
            self._advise(status)
        if self.is_read:
            for request in self.changes.step(
                now_ns,
                self.values,
                is_complete=not self._open,
                is_disarmed=status is not None and not status.armed,
            ):
                if isinstance(request, ParamWrite) and self._profile.is_bytewise:
                    kind = self._kinds.get(request.name, request.kind)
                    request = request._replace(kind=kind).as_bytes()
                yield request
        if self._follow_up and self._follow_ups_left and now_ns >= self._follow_up_ns:
            self._follow_ups_left, self._follow_up_ns = self._follow_ups_left - 1, now_ns + NS_PER_S
            yield self._follow_up

    def _read(self, names: tuple[str, ...]) -> None:
        """Read these parameters if they are unknown, including ones that were given up before."""
        known = self._config.known_params
        if known is not None:
            names = tuple(name for name in names if name in known)
        missing = [name for name in names if name not in self.values]
        self._open |= {name: (0, 0) for name in missing if name not in self._open}
        self._relevant |= set(names)

    def _read_requests(self, now_ns: int) -> Iterator[ParamRequest]:
        """Yield the requests that are due: repetitions first, then new ones up to the window."""
        in_flight = sum(attempts > 0 for _, attempts in self._open.values())
        for name, (requested_ns, attempts) in list(self._open.items()):
            if attempts == 0:
                if in_flight >= _WINDOW:
                    continue
                in_flight += 1
            elif now_ns - requested_ns < _TIMEOUT_NS:
                continue
            elif attempts >= _ATTEMPTS:
                del self._open[name]
                in_flight -= 1
                continue
            self._open[name] = (now_ns, attempts + 1)
            yield ParamRequest(name)

    def _ask_for_missing(self, now_ns: int, status: VehicleStatus | None) -> None:
        """Request missing parameters, on the ground: the needed ones in every round, all in rounds
        1, 2, 4, 8 and so on. On a lossy link the vehicle may have them."""
        is_usable = self._assessed is not None and self._assessed.unusable is None
        is_flying = self.is_read and is_usable and status is not None and status.armed
        if now_ns < self._again_ns or is_flying:
            return
        self._again_ns, self._rounds = now_ns + _AGAIN_NS, self._rounds + self.is_read
        others = self._relevant if self._rounds.bit_count() == 1 else ()
        unread = self._assessed.unread if self._assessed else ()
        self._read((*self._profile.needed_params(self.values), *unread, *others))

    def _take_in(self, status: VehicleStatus | None) -> None:
        """Adopt the calibration that was read, at the start or when next disarmed."""
        self.is_read = True
        assessment = self._current(status)
        before, now = self.calibration, assessment.calibration
        is_armed = status is not None and status.armed
        if before is None or (before != now and not is_armed):
            if before is not None and now is not None:
                self._report("the vehicle's radio calibration has changed: the new one counts")
            self.calibration = now

    def _advise(self, status: VehicleStatus | None) -> None:
        before, is_armed = self._advised, status is not None and status.armed
        assessment, is_piloted = self._current(status), self._config.pilot_hz is not None
        is_same = before is not None and assessment.context == before.context
        # On the ground, values also change by --set, and back.
        is_known = assessment is before or (is_same and not is_armed)
        if assessment.context.output is None or is_known or not self.changes.is_settled:
            return
        self._advised = assessment
        for note in assessment.notes:
            if note.turns_sticks if is_piloted else note.kind == "advice":
                self._report(AdviceText(note.text))

    def output_problem(self, status: VehicleStatus | None) -> Reason | None:
        """Return why the parameters forbid a flight with the chosen output, or None."""
        output = self._context.output
        if not self.is_read or output is None:
            return None
        assessment = self._current(status)
        if assessment.obstacles:
            what = "not fly by our setpoints"
            if output in ("rc-override", "manual-control"):
                what = "ignore our sticks, or take them otherwise"
            causes = "; ".join(each.text for each in assessment.obstacles)
            return because(Code.OBSTACLE, what=what, causes=causes)
        if assessment.unusable is not None:
            return because(Code.CALIBRATION_UNUSABLE, cause=assessment.unusable)
        if output == "rc-override" and assessment.calibration != self.calibration:
            return because(Code.CALIBRATION_CHANGED)
        return assessment.risks[0].refusal if assessment.risks else None

    def assessment_with(self, values: Iterable[tuple[str, float]]) -> Assessment:
        """Return the assessment for the present output and receiver, as if these were set."""
        return assess(self._profile, self.values | dict(values), self._context)

    def _current(self, status: VehicleStatus | None) -> Assessment:
        """Return the assessment of the present values, output and receiver."""
        has_receiver = None if status is None else status.has_receiver
        if status is not None and status.armed and self._context.has_receiver is False:
            has_receiver = False  # switched on in flight: its pilot takes over, which is no fault
        if has_receiver != self._context.has_receiver:
            self._context = self._context._replace(has_receiver=has_receiver)
        if self._assessed is None or self._assessed.context is not self._context:
            self._assessed = assess(self._profile, self.values, self._context)
        return self._assessed
