"""Checks of the parameters and of a serial port's capacity, for a flight with one output."""

from collections.abc import Iterable, Mapping
from typing import NamedTuple

from pymavlink.dialects.v20 import ardupilotmega as dialect

from mavbridge.core.address import serial_baud
from mavbridge.core.link_settings import LinkSettings
from mavbridge.core.reasons import Code, because
from mavbridge.mavlink.codec.calibration import RcCalibration
from mavbridge.mavlink.codec.frames import SIGNATURE_BYTES
from mavbridge.mavlink.codec.readers import IDS
from mavbridge.mavlink.profiles.profile import ParamContext, ParamNote, Profile, StreamGroup

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
    notes = (*context.serial, *profile.notes(values, context))
    accepted = context.accepted_risks
    return Assessment(
        context,
        ours,
        unusable,
        profile.traits(values).override_switch if is_override else None,
        tuple(note.accepted() if note.risk in accepted else note for note in notes),
    )


def received_bytes_per_s(streams: Iterable[StreamGroup], frame_bytes: int = _FRAME_BYTES) -> float:
    """Return the bandwidth of these streams with full-length messages, rare ones excluded."""
    steady = [(stream.rate_hz, stream.messages[0]) for stream in streams if stream.least_hz is None]
    streamed: float = sum(
        rate_hz * (frame_bytes + dialect.mavlink_map[IDS[name]].unpacker.size)
        for rate_hz, name in steady
    )
    return _OTHERS_BYTES_PER_S + streamed


def serial_risks(settings: LinkSettings, streams: Iterable[StreamGroup]) -> tuple[ParamNote, ...]:
    """Return the risk of a serial port's baud rate that is too low.

    A serial port carries both directions at once, so the fuller one decides.
    """
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
