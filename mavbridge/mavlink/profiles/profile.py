"""Interface of a firmware profile."""

import math
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from types import MappingProxyType
from typing import ClassVar, Literal, NamedTuple, TypeAlias

from pymavlink.dialects.v20 import ardupilotmega as dialect

from mavbridge.core.errors import UserError
from mavbridge.core.reasons import Code, Reason, because
from mavbridge.core.vehicle import ActionKind, ModeRoles, Output, Risk, StickGains
from mavbridge.mavlink.codec.calibration import RcCalibration
from mavbridge.mavlink.codec.messages import CommandRequest
from mavbridge.mavlink.profiles.sticks import StickCurves


class ModeTable(NamedTuple):
    """Names and numbers of flight modes."""

    names: Mapping[int, str]
    """Name of each HEARTBEAT.custom_mode."""
    commands: Mapping[str, tuple[int, int]]
    """Parameters 2 and 3 of MAV_CMD_DO_SET_MODE, by name."""
    roles: ModeRoles
    main_mask: int = -1
    """Bits without the sub-mode; a sub-mode without a name has that of its main mode."""

    def name(self, custom_mode: int) -> str:
        """Return the name of HEARTBEAT.custom_mode, or its number if it has none."""
        main = self.names.get(custom_mode & self.main_mask, str(custom_mode))
        return self.names.get(custom_mode, main)

    def command(self, name: str) -> CommandRequest:
        """Return the request for a mode.

        Raises:
            UserError: the vehicle has no such mode.
        """
        numbers = self.commands.get(name.upper())
        if numbers is None:
            known = ", ".join(sorted(self.commands))
            raise UserError(f"this vehicle has no mode {name!r}; it has {known}")
        flag = dialect.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
        return CommandRequest(dialect.MAV_CMD_DO_SET_MODE, (flag, *numbers))


class StreamGroup(NamedTuple):
    """One quantity, and the messages that carry it, best first."""

    messages: tuple[str, ...]
    rate_hz: float
    is_needed: bool = False
    """False if nothing waits for it: a vehicle that does not grant it is flown without."""
    least_hz: float | None = None
    """Rate of a message that is sent only on change, at or below which it is requested again; 0: if
    it stays away. None: the message is periodic, and a fraction of ``rate_hz`` decides."""
    without: str = ""
    """Effect of its absence or rareness, for the user; told once."""
    stand_in: str | None = None
    """Message to request one at a time during its absence."""


def condition_streams(estimator: str) -> tuple[StreamGroup, ...]:
    """Return the streams of health, landing and estimator, which a flight can do without."""
    health = "a low battery and a receiver that fails are not seen"
    position = "the loss of its position estimate is not seen"
    air = "neither a landing nor a frozen image ends the flight"
    return (
        StreamGroup(("SYS_STATUS",), 2.0, without=health),
        StreamGroup(("EXTENDED_SYS_STATE",), 5.0, without=air),
        StreamGroup((estimator,), 5.0, without=position),
    )


HOME_HEIGHT = StreamGroup(("GLOBAL_POSITION_INT",), 20.0, least_hz=5.0)
"""Height above home, for policies that take it; fresher than the age limit of a velocity."""


class EventMeaning(NamedTuple):
    """Meaning of an EVENT."""

    is_armed: bool | None = None
    """None: the EVENT does not tell."""
    is_failsafe: bool = False
    is_stick_override: bool = False
    """True if moving sticks have changed the mode."""
    is_stick_loss: bool = False
    text: str | None = None
    """Text for the user, if no STATUSTEXT reports it."""


NoteKind: TypeAlias = Literal["obstacle", "risk", "advice", "hint", "wanted"]
"""obstacle: the vehicle would not follow our commands, which the user cannot accept. risk: it would
fly, but not safely. advice: a warning. hint: an improvement. wanted: the value that a parameter
should have, in words. Hints and wanted values are shown by ``mavbridge check`` alone."""


class ParamNote(NamedTuple):
    """Remark about parameters or the port, and the flag that fixes it."""

    kind: NoteKind
    names: tuple[str, ...]
    """Parameters concerned; may be empty."""
    said: str
    cure: str = ""
    """Flag that fixes it; empty: none."""
    or_else: str = ""
    """End of the sentence, after the flag."""
    risk: Risk | None = None
    """Name by which the user accepts a note of kind risk."""
    refusal: Reason | None = None
    """Reason for which a risk that is not accepted forbids a flight."""
    turns_sticks: bool = False
    """True if it changes what the sticks of a pilot mean, too."""

    @classmethod
    def of(
        cls,
        kind: NoteKind,
        name: str,
        value: float,
        effect: str,
        mended: float | None = None,
        or_else: str = "",
    ) -> "ParamNote":
        """Return a remark about one value; ``mended``: the value that fixes it."""
        cure = "" if mended is None else f"--set {name}={mended:g}"
        return cls(kind, (name,), f"{name} is {value:g}{effect}", cure, or_else)

    @classmethod
    def of_risk(cls, risk: Risk, why: Reason, name: str = "", cure: str = "") -> "ParamNote":
        """Return the refusal of a risk; ``why`` names the flag that fixes it."""
        refusal, names = because(Code.RISK, risk=risk, why=why), (name,) if name else ()
        return cls("risk", names, str(why), cure, risk=risk, refusal=refusal)

    def accepted(self) -> "ParamNote":
        """Return the advice that replaces a risk once the user has accepted it."""
        said = f"risk {self.risk} is accepted: {self.said}"
        return ParamNote("advice", self.names, said, self.cure)

    @property
    def text(self) -> str:
        """Sentence for the user, with the flag."""
        if self.refusal is not None:
            return str(self.refusal)
        is_complete = self.cure in self.said
        return self.said if is_complete else f"{self.said}: use {self.cure}{self.or_else}"


LONGEST_S = 1.0
"""Longest useful timeout; a longer one leaves the vehicle uncontrolled longer than necessary."""
SHORTEST_S = 0.3
"""Shortest safe timeout: a guard on a busy computer may be late by a tenth of it, and a link may
lose a few packets in a row."""
_LONGEST_SETPOINT_S = 3.0
"""Longest time to follow the last setpoint of a dead guard; ArduPilot's default."""


def timeout_notes(
    values: Mapping[str, float], name: str, does: str, *, is_setpoint: bool = False
) -> Iterator[ParamNote]:
    """Yield the wanted time, and a note if the vehicle would go on for too long after the death of
    the guard, or would not wait for packets that are late."""
    yield ParamNote("wanted", (name,), f"0.5; {SHORTEST_S:g} to {LONGEST_S:g} s")
    time_s = values.get(name, LONGEST_S)
    if is_setpoint and time_s > _LONGEST_SETPOINT_S:
        why = because(Code.LONG_SETPOINT, name=name, time_s=time_s)
        yield ParamNote.of_risk("long-setpoint", why, name, f"--set {name}=0.5")
    if time_s > LONGEST_S:
        effect = f": if this computer died, the vehicle would {does} for that many seconds"
        yield ParamNote.of("advice", name, time_s, effect, 0.5)
    if 0.0 <= time_s < SHORTEST_S:
        effect = ": a pause of our packets as short as that counts as their end"
        yield ParamNote.of("advice", name, time_s, effect, 0.5)


def clipped_note(values: Mapping[str, float], limit: str, full: str) -> Iterator[ParamNote]:
    """Yield a note if a limit of the vehicle is below its motion at full stick."""
    most, wanted = values.get(limit, 0.0), values.get(full, 0.0)
    if 0.0 < most < wanted:
        effect = f": it clips the motion of a stick, which is {wanted:g} at its end ({full})"
        yield ParamNote.of("advice", limit, most, effect, wanted)


class ParamContext(NamedTuple):
    """Conditions for judging parameters."""

    output: Output | None
    """None: not chosen yet; only rules for all outputs apply."""
    source_system: int
    """Our MAVLink system id."""
    has_receiver: bool | None
    """As in ``VehicleStatus``."""
    version: str | None = None
    """Version of the firmware, like 1.18.0; None: unknown."""
    accepted_risks: tuple[Risk, ...] = ()
    serial: tuple[ParamNote, ...] = ()
    """Risks of the serial port."""
    booted: Mapping[str, float] = MappingProxyType({})
    """First value of each parameter in this session, which counts until the vehicle's next boot for
    parameters that are read at boot alone."""


class Traits(NamedTuple):
    """Properties of a vehicle that follow from its parameters."""

    override_switch: int | None = None
    """Number of the radio channel that enables overrides."""
    ignores_receiver: bool = False
    """True if it ignores the sticks of a receiver, even if there is one."""
    falls_back: bool = False
    """True if a receiver's sticks count again once ours have ended, without a failsafe."""
    keeps_sticks: bool = False
    """True if overrides that have ended are shown for ever, as from a healthy receiver."""
    boosts_thrust: bool = False
    """True if it divides a setpoint's thrust by the cosine of its tilt."""
    hand_per_s: float = math.inf
    """Stick speed that ends an autonomous mode [full sticks/s]."""
    climb_limits_mps: tuple[float, float] = (math.inf, math.inf)
    """Climb and descent to which it clips velocity setpoints and their echo."""


class Profile(ABC):
    """Properties of one firmware; immutable, one instance serves all vehicles."""

    name: ClassVar[str]
    """Name in settings and reports."""
    modes: ClassVar[ModeTable]
    stick_output: ClassVar[Output]
    refusal: ClassVar[str]
    """Sentence that says why the other output for sticks is unsupported and names this one."""
    heartbeat_type: ClassVar[int] = dialect.MAV_TYPE_ONBOARD_CONTROLLER
    """MAV_TYPE of our HEARTBEAT to a vehicle of this firmware."""
    is_bytewise: ClassVar[bool] = False
    """True if PARAM_VALUE and PARAM_SET carry an integer in the bytes of their float."""
    sends_invalid_estimates: ClassVar[bool] = False
    """True if LOCAL_POSITION_NED also comes without a valid estimate: see the estimator's flags."""
    shows_rates: ClassVar[bool] = False
    """True if ATTITUDE_TARGET shows body rates as sent, but not their thrust."""
    target_hz: ClassVar[float]
    """Rate of ATTITUDE_TARGET and POSITION_TARGET_LOCAL_NED for the echo check."""
    stick_echo: ClassVar[StreamGroup]
    """Message that shows the sticks that the vehicle acts on."""
    hover_param: ClassVar[str]
    """Parameter of the hover thrust in [0, 1], by the vehicle's own estimate."""
    has_rc_channels_always: ClassVar[bool] = True
    """True if RC_CHANNELS also comes without a receiver."""
    events: ClassVar[Mapping[int, EventMeaning]] = {}
    """Meaning of the relevant EVENTs."""
    params: ClassVar[tuple[str, ...]]
    """Parameters to read first, including those of other firmware versions."""

    @abstractmethod
    def streams(self, *, state_hz: float, pilot_hz: float | None = None) -> tuple[StreamGroup, ...]:
        """Return the streams that every flight needs, then optional ones; without the echo.

        ``pilot_hz``: rate of RC_CHANNELS; None: the default.
        """

    def usual_output(self, kind: ActionKind) -> Output:
        """Return the default output of an action kind; setpoints have one of the same name."""
        return self.stick_output if kind == "sticks" else kind

    def echo(self, output: Output) -> StreamGroup:
        """Return the message that shows the echo of this output.

        It may be one of ``streams``, with the same rate.
        """
        if output in ("attitude", "rates"):
            return StreamGroup(("ATTITUDE_TARGET",), self.target_hz)
        if output == "velocity":
            return StreamGroup(("POSITION_TARGET_LOCAL_NED",), self.target_hz, least_hz=0.0)
        return self.stick_echo

    def needed_params(self, values: Mapping[str, float]) -> tuple[str, ...]:
        """Return parameters, by values of others, to ask for on the ground until they come, as for
        those with a wanted value."""
        return (self.hover_param,)

    def calibration(self, values: Mapping[str, float]) -> RcCalibration | None:
        """Return the radio calibration; None if sticks do not pass through one.

        Raises:
            ValueError: a parameter is missing or contradicts another.
        """
        return None

    @abstractmethod
    def traits(self, values: Mapping[str, float]) -> Traits:
        """Return what these parameters make of the vehicle."""

    def follow_up(self, name: str, before: float, now: float) -> CommandRequest | None:
        """Return the command that a parameter change for a flight needs to take effect, or None."""
        return None

    @abstractmethod
    def notes(self, values: Mapping[str, float], context: ParamContext) -> Iterator[ParamNote]:
        """Yield settings that prevent, endanger, weaken or change a flight, each with its remedy.

        Includes risks that the user has accepted, and what each parameter should be.
        """

    @abstractmethod
    def stick_curves(
        self, values: Mapping[str, float], mode: str, gains: StickGains | None
    ) -> StickCurves:
        """Return the map from a policy's sticks, which mean ``gains``, to this vehicle's in a mode.

        Request it again when parameters or the mode change. ``gains`` None: sticks stay unchanged.
        """

    @abstractmethod
    def takeoff(self, height_m: float, amsl_m: float | None) -> CommandRequest | None:
        """Return the command for an autonomous takeoff to a height above ground.

        ``amsl_m``: the vehicle's present height above mean sea level, if known. Return None if the
        command needs it and it is unknown.
        """
