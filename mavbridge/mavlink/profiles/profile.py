"""Interface of a firmware profile."""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from typing import ClassVar, NamedTuple

from pymavlink.dialects.v20 import ardupilotmega as dialect

from mavbridge.core.errors import UserError
from mavbridge.core.reasons import Code, Reason, because
from mavbridge.core.vehicle import ActionKind, ModeRoles, Output, Risk, StickGains
from mavbridge.mavlink.codec.calibration import RcCalibration
from mavbridge.mavlink.codec.messages import CommandRequest
from mavbridge.mavlink.profiles.sticks import StickCurves


class ModeTable:
    """Names and numbers of flight modes; a main mode with sub-modes has one name for each.

    ``shift`` and ``sub_shift`` give the position of the 8-bit numbers of main mode and sub-mode in
    HEARTBEAT.custom_mode; None: the whole number is the mode, without sub-modes. Modes in
    ``never_commanded`` have only a name.
    """

    def __init__(
        self,
        names: dict[int, str],
        *,
        roles: ModeRoles,
        shift: int | None = None,
        sub_shift: int = 0,
        sub_modes: dict[str, dict[int, str]] | None = None,
        never_commanded: tuple[str, ...] = (),
    ) -> None:
        self._names = names
        self._shift, self._sub_shift = shift, sub_shift
        self._sub_modes = sub_modes or {}
        self._commands: dict[str, tuple[int, int]] = {}
        for number, name in names.items():
            if name in self._sub_modes:
                subs = self._sub_modes[name].items()
                self._commands |= {f"{name}.{sub}": (number, code) for code, sub in subs}
            elif name not in never_commanded:
                self._commands[name] = (number, 0)
        self.roles = replace(roles, names=tuple(self._commands))
        """Roles of the modes, and the names of all that can be requested."""

    def name(self, custom_mode: int) -> str:
        """Return the name of HEARTBEAT.custom_mode, or its number if it has none."""
        number = custom_mode if self._shift is None else custom_mode >> self._shift & 0xFF
        name = self._names.get(number, str(number))
        if name in self._sub_modes:
            sub = custom_mode >> self._sub_shift & 0xFF
            return f"{name}.{self._sub_modes[name].get(sub, sub)}"
        return name

    def command(self, name: str) -> tuple[int, int]:
        """Return parameters 2 and 3 of MAV_CMD_DO_SET_MODE.

        Raises:
            UserError: the vehicle has no such mode.
        """
        numbers = self._commands.get(name.upper())
        if numbers is None:
            raise UserError(
                f"this vehicle has no mode {name!r}; it has {', '.join(sorted(self._commands))}"
            )
        return numbers


class StreamGroup(NamedTuple):
    """One quantity, and the messages that carry it, best first."""

    messages: tuple[str, ...]
    stream: int | None
    """MAV_DATA_STREAM of REQUEST_DATA_STREAM; None where the firmware has none, or it would also
    set other messages."""
    rate_hz: float
    is_optional: bool = False
    """True if nothing waits for it: a vehicle that does not grant it is flown without."""
    least_hz: float | None = None
    """Lowest rate of a message that is sent only on change; below it, it is requested again. None:
    the message is periodic, and a fraction of ``rate_hz`` decides."""
    without: str = ""
    """Effect of its absence, for the user; told once."""
    stand_in: str | None = None
    """Message to request one at a time during its absence."""


def optional_stream(
    message: str,
    rate_hz: float,
    *,
    least_hz: float | None = None,
    without: str = "",
    stand_in: str | None = None,
) -> StreamGroup:
    """Return the group of one message that no flight waits for."""
    return StreamGroup((message,), None, rate_hz, True, least_hz, without, stand_in)


NO_LANDING = "a landing does not end the flight"
NO_POSITION_WORD = "the loss of its position estimate is not seen"
NO_HEALTH = "a low battery and a receiver that fails are not seen"


HOME_HEIGHT = optional_stream("GLOBAL_POSITION_INT", 20.0, least_hz=5.0)
"""Height above home, for policies that take it; fresher than the age limit of a velocity."""


class EventMeaning(NamedTuple):
    """Meaning of an EVENT."""

    is_armed: bool | None = None
    """None: the EVENT does not tell."""
    is_failsafe: bool = False
    is_stick_override: bool = False
    """True if moving sticks have changed the mode."""
    text: str | None = None
    """Text for the user, if no STATUSTEXT reports it."""


class ParamNote(NamedTuple):
    """Remark about parameters, and the flag that fixes it."""

    names: tuple[str, ...]
    """Parameters concerned; may be empty."""
    said: str
    cure: str = ""
    """Flag that fixes it; empty: none."""
    or_else: str = ""
    """End of the sentence, after the flag."""
    names_cure: bool = False
    """True if ``said`` already names the flag."""

    @property
    def text(self) -> str:
        """Sentence for the user, with the flag."""
        is_complete = self.names_cure or not self.cure
        return self.said if is_complete else f"{self.said}: use {self.cure}{self.or_else}"


class Danger(NamedTuple):
    """Setting with which the vehicle flies, but not safely."""

    risk: Risk
    why: Reason
    name: str | None = None
    """Parameter concerned."""
    cure: str = ""
    """Flag that fixes it, named in ``why``."""

    @property
    def accepted(self) -> ParamNote:
        """Note for a flight whose risk the user has accepted."""
        return self._note(f"risk {self.risk} is accepted: {self.why}")

    @property
    def refused(self) -> ParamNote:
        """Note for a refused flight."""
        return self._note(str(self.refusal))

    @property
    def refusal(self) -> Reason:
        """Reason to refuse a flight."""
        return because(Code.RISK, risk=self.risk, why=self.why)

    def _note(self, said: str) -> ParamNote:
        names = () if self.name is None else (self.name,)
        return ParamNote(names, said, self.cure, names_cure=True)


LONGEST_SETPOINT_S = 3.0
"""Longest time to follow the last setpoint of a dead guard; ArduPilot's default."""


def setpoint_danger(values: Mapping[str, float], name: str) -> Iterator[Danger]:
    """Yield a danger if the vehicle's setpoint timeout, parameter ``name`` [s], is long."""
    time_s = values.get(name, 0.0)
    if time_s > LONGEST_SETPOINT_S:
        why = because(Code.LONG_SETPOINT, name=name, time_s=time_s)
        yield Danger("long-setpoint", why, name, f"--set {name}=0.5")


class StickSetting(NamedTuple):
    """Parameter that can change the meaning of a stick."""

    name: str
    effect: str
    is_harmless: Callable[[float], bool]
    mended: float


def stick_obstacles(
    settings: Iterable[StickSetting], values: Mapping[str, float]
) -> Iterator[ParamNote]:
    """Yield a note for each setting that changes the meaning of a stick."""
    for name, effect, is_harmless, mended in settings:
        value = values.get(name)
        if value is not None and not is_harmless(value):
            yield ParamNote((name,), f"{name} is {value:g}: {effect}", f"--set {name}={mended:g}")


class WantedParam(NamedTuple):
    """Parameter that a flight depends on, and its required value in words, for the user."""

    name: str
    should_be: str


class ParamContext(NamedTuple):
    """Conditions for judging parameters."""

    output: Output | None
    """None: not chosen yet; only rules for all outputs apply."""
    source_system: int
    """Our MAVLink system id."""
    has_receiver: bool | None
    """As in ``VehicleStatus``."""


class Profile(ABC):
    """Properties of one firmware; immutable, one instance serves all vehicles."""

    name: ClassVar[str]
    """Name in settings and reports."""
    modes: ClassVar[ModeTable]
    outputs: ClassVar[Mapping[ActionKind, Output]]
    """Default output of each action kind."""
    refusals: ClassVar[Mapping[Output, str]]
    """Unsupported outputs, each with a sentence that says why and names an alternative."""
    heartbeat_type: ClassVar[int] = dialect.MAV_TYPE_ONBOARD_CONTROLLER
    """MAV_TYPE of our HEARTBEAT to a vehicle of this firmware."""
    is_bytewise: ClassVar[bool] = False
    """True if PARAM_VALUE and PARAM_SET carry an integer in the bytes of their float."""
    sends_invalid_estimates: ClassVar[bool] = False
    """True if LOCAL_POSITION_NED also comes without a valid estimate: see the estimator's flags."""
    shows_rates: ClassVar[bool] = False
    """True if ATTITUDE_TARGET shows body rates as sent, but not their thrust."""
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

    @abstractmethod
    def echo(self, output: Output) -> StreamGroup:
        """Return the message that shows the echo of this output.

        It may be one of ``streams``, with the same rate.
        """

    def more_params(self, values: Mapping[str, float]) -> tuple[str, ...]:
        """Return parameters to read because of the values of others."""
        return ()

    def needed_params(self, values: Mapping[str, float]) -> tuple[str, ...]:
        """Return parameters that are requested on the ground until they arrive."""
        return ()

    def calibration(self, values: Mapping[str, float]) -> RcCalibration | None:
        """Return the radio calibration; None if sticks do not pass through one.

        Raises:
            ValueError: a parameter is missing or contradicts another.
        """
        return None

    def override_switch(self, values: Mapping[str, float]) -> int | None:
        """Return the number of the radio channel that enables overrides, or None."""
        return None

    def ignores_receiver(self, values: Mapping[str, float]) -> bool:
        """True if the vehicle ignores the sticks of a receiver, even if there is one."""
        return False

    @abstractmethod
    def obstacles(self, values: Mapping[str, float], context: ParamContext) -> Iterator[ParamNote]:
        """Yield settings under which the vehicle would not follow our commands.

        Each comes with the command that fixes it; the user cannot accept them.
        """

    def follow_up(self, name: str, before: float, now: float) -> CommandRequest | None:
        """Return the command that a parameter change for a flight needs to take effect, or None."""
        return None

    @abstractmethod
    def dangers(self, values: Mapping[str, float], context: ParamContext) -> Iterator[Danger]:
        """Yield settings with which it flies, but not safely, including accepted ones."""

    @abstractmethod
    def advice(self, values: Mapping[str, float], context: ParamContext) -> Iterator[ParamNote]:
        """Yield warnings that do not forbid a flight."""

    def hints(self, values: Mapping[str, float], context: ParamContext) -> Iterator[ParamNote]:
        """Yield possible improvements with their commands; shown only by ``mavbridge check``."""
        return iter(())

    @abstractmethod
    def wanted_params(
        self, values: Mapping[str, float], context: ParamContext
    ) -> Iterator[WantedParam]:
        """Yield the parameters to show before a flight; the methods above judge the values."""

    @abstractmethod
    def stick_curves(
        self, values: Mapping[str, float], mode: str, gains: StickGains | None
    ) -> StickCurves:
        """Return the map from a policy's sticks, which mean ``gains``, to this vehicle's in a mode.

        Request it again when parameters or the mode change. ``gains`` None: sticks stay unchanged.
        """

    @abstractmethod
    def hover_thrust(self, values: Mapping[str, float]) -> float | None:
        """Return the hover thrust in [0, 1] by the vehicle's own estimate; None: unknown."""

    def boosts_thrust(self, values: Mapping[str, float]) -> bool:
        """True if the vehicle divides a setpoint's thrust by the cosine of its tilt."""
        return False

    def hand_per_s(self, values: Mapping[str, float]) -> float:
        """Return the stick speed that ends an autonomous mode [full sticks/s]."""
        return math.inf

    def climb_limits(self, values: Mapping[str, float]) -> tuple[float, float]:
        """Return climb and descent [m/s] to which it clips velocity setpoints and their echo."""
        return math.inf, math.inf

    @abstractmethod
    def takeoff(self, height_m: float, amsl_m: float | None) -> CommandRequest | None:
        """Return the command for an autonomous takeoff to a height above ground.

        ``amsl_m``: the vehicle's present height above mean sea level, if known. Return None if the
        command needs it and it is unknown.
        """
