"""The shape of a profile: all that the bridge has to know of one firmware."""

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

    ``shift`` and ``sub_shift`` say where main mode and sub-mode stand in HEARTBEAT.custom_mode, as
    numbers of eight bits; None = all of it is the mode, and there are no sub-modes. Modes that are
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
        """All modes that can be asked for, and what each is good for."""

    def name(self, custom_mode: int) -> str:
        """Name of HEARTBEAT.custom_mode, or its number if it has no name."""
        number = custom_mode if self._shift is None else custom_mode >> self._shift & 0xFF
        name = self._names.get(number, str(number))
        if name in self._sub_modes:
            sub = custom_mode >> self._sub_shift & 0xFF
            return f"{name}.{self._sub_modes[name].get(sub, sub)}"
        return name

    def command(self, name: str) -> tuple[int, int]:
        """Parameters 2 and 3 of MAV_CMD_DO_SET_MODE.

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
    """One quantity: the messages that carry it, best first."""

    messages: tuple[str, ...]
    rate_hz: float
    is_optional: bool = False
    """Nothing waits for it: a vehicle that does not grant it is flown without."""
    least_hz: float | None = None
    """It comes only when something is new, and at least so often; below this it is asked for again.
    None: it comes all the time, and a share of ``rate_hz`` decides."""
    without: str = ""
    """What does not hold, or what is done, while it stays away; the user is told once."""
    stand_in: str | None = None
    """Message that is asked for one by one while it stays away."""


def optional_stream(
    message: str,
    rate_hz: float,
    *,
    least_hz: float | None = None,
    without: str = "",
    stand_in: str | None = None,
) -> StreamGroup:
    """Group of one message that no flight waits for."""
    return StreamGroup((message,), rate_hz, True, least_hz, without, stand_in)


NO_LANDING = "a landing does not end the flight"
NO_POSITION_WORD = "the loss of its position estimate is not seen"
NO_HEALTH = "a low battery and a receiver that fails are not seen"


HOME_HEIGHT = optional_stream("GLOBAL_POSITION_INT", 20.0, least_hz=5.0)
"""Height above home, for a policy that takes it: as often as a velocity may be old, and some."""


class EventMeaning(NamedTuple):
    """What an EVENT says about the vehicle."""

    is_armed: bool | None = None
    """None: it does not say."""
    is_failsafe: bool = False
    is_stick_override: bool = False
    """Moving sticks have changed the mode."""
    text: str | None = None
    """For the user, where no STATUSTEXT says it."""


class ParamNote(NamedTuple):
    """A remark about parameters, and the flag that mends it."""

    names: tuple[str, ...]
    """Parameters that it is about; empty: none."""
    said: str
    cure: str = ""
    """Empty: no flag mends it."""
    or_else: str = ""
    """End of the sentence, after the flag."""

    @property
    def text(self) -> str:
        """The sentence for the user, with the flag."""
        is_told = not self.cure or self.cure in self.said
        return self.said if is_told else f"{self.said}: use {self.cure}{self.or_else}"


class Danger(NamedTuple):
    """A setting with which the vehicle flies, but is not safe."""

    risk: Risk
    why: Reason
    name: str | None = None
    """Parameter that it is about."""
    cure: str = ""
    """As in ``ParamNote``; ``why`` names it."""

    @property
    def accepted(self) -> ParamNote:
        """The note for a flight of which the user has accepted the risk."""
        return self._note(f"risk {self.risk} is accepted: {self.why}")

    @property
    def refused(self) -> ParamNote:
        """The note for a flight that is not begun."""
        return self._note(str(self.refusal))

    @property
    def refusal(self) -> Reason:
        """Why a flight is not begun."""
        return because(Code.RISK, risk=self.risk, why=self.why)

    def _note(self, said: str) -> ParamNote:
        return ParamNote(() if self.name is None else (self.name,), said, self.cure)


LONGEST_SETPOINT_S = 3.0
"""Longest time for which a vehicle may go on with the last setpoint of a guard that has died;
ArduPilot's default."""


def setpoint_danger(values: Mapping[str, float], name: str) -> Iterator[Danger]:
    """The danger of a vehicle whose timeout of setpoints, parameter ``name`` in s, is long."""
    time_s = values.get(name, 0.0)
    if time_s > LONGEST_SETPOINT_S:
        why = because(Code.LONG_SETPOINT, name=name, time_s=time_s)
        yield Danger("long-setpoint", why, name, f"--set {name}=0.5")


class StickSetting(NamedTuple):
    """A parameter that can give a stick another meaning than the policy's."""

    name: str
    effect: str
    is_harmless: Callable[[float], bool]
    mended: float


def stick_obstacles(
    settings: Iterable[StickSetting], values: Mapping[str, float]
) -> Iterator[ParamNote]:
    """A note for each of the settings with which sticks mean something else."""
    for name, effect, is_harmless, mended in settings:
        value = values.get(name)
        if value is not None and not is_harmless(value):
            yield ParamNote((name,), f"{name} is {value:g}: {effect}", f"--set {name}={mended:g}")


class WantedParam(NamedTuple):
    """A parameter that a flight depends on, and its value in words, for the user."""

    name: str
    should_be: str


class ParamContext(NamedTuple):
    """Circumstances in which parameters are judged."""

    output: Output | None
    """None: not chosen yet, so that only what holds for every output is judged."""
    source_system: int
    """Our MAVLink system id."""
    has_receiver: bool | None
    """As in ``VehicleStatus``."""


class Profile(ABC):
    """One firmware. Constant: one instance serves all vehicles."""

    name: ClassVar[str]
    """As a user writes it, and in reports."""
    modes: ClassVar[ModeTable]
    outputs: ClassVar[Mapping[ActionKind, Output]]
    """The usual output of each kind of action."""
    refusals: ClassVar[Mapping[Output, str]]
    """Outputs that make no sense here, and why, in a sentence that names another one."""
    heartbeat_type: ClassVar[int] = dialect.MAV_TYPE_ONBOARD_CONTROLLER
    """MAV_TYPE of our own HEARTBEAT, once this is the vehicle's firmware."""
    is_bytewise: ClassVar[bool] = False
    """An integer parameter stands byte for byte in the float of PARAM_VALUE and PARAM_SET."""
    sends_invalid_estimates: ClassVar[bool] = False
    """LOCAL_POSITION_NED comes without a valid estimate too: the estimator's flags decide."""
    shows_rates: ClassVar[bool] = False
    """ATTITUDE_TARGET shows the body rates of a setpoint as they were sent, but not its thrust."""
    has_rc_channels_always: ClassVar[bool] = True
    """RC_CHANNELS comes without a receiver too."""
    events: ClassVar[Mapping[int, EventMeaning]] = {}
    """Meaning of those EVENTs that matter."""
    params: ClassVar[tuple[str, ...]]
    """Parameters to read first, those of other versions of the firmware included."""

    @abstractmethod
    def streams(self, *, state_hz: float, pilot_hz: float | None = None) -> tuple[StreamGroup, ...]:
        """Telemetry that every flight needs, then what is also watched; without the echo.

        ``pilot_hz`` is the rate of RC_CHANNELS, None: the usual one.
        """

    @abstractmethod
    def echo(self, output: Output) -> StreamGroup:
        """Message that shows what the vehicle does with this output.

        It may be one of ``streams``, which then carries the same rate.
        """

    def more_params(self, values: Mapping[str, float]) -> tuple[str, ...]:
        """Parameters that are read because of the values of others."""
        return ()

    def needed_params(self, values: Mapping[str, float]) -> tuple[str, ...]:
        """Parameters that are asked for again on the ground for as long as they are missing."""
        return ()

    def calibration(self, values: Mapping[str, float]) -> RcCalibration | None:
        """The radio calibration; None where sticks do not go through one.

        Raises:
            ValueError: a parameter is missing or contradicts another.
        """
        return None

    def override_switch(self, values: Mapping[str, float]) -> int | None:
        """Number of the radio channel that enables overrides, or None."""
        return None

    def ignores_receiver(self, values: Mapping[str, float]) -> bool:
        """The sticks of a receiver move nothing, even if there is one."""
        return False

    @abstractmethod
    def obstacles(self, values: Mapping[str, float], context: ParamContext) -> Iterator[ParamNote]:
        """Reasons, as far as parameters show, for which the vehicle would not do as it is told.

        Each with the command that mends it; nobody can accept them.
        """

    def follow_up(self, name: str, before: float, now: float) -> CommandRequest | None:
        """The command without which a parameter that was set for a flight has no effect."""
        return None

    @abstractmethod
    def dangers(self, values: Mapping[str, float], context: ParamContext) -> Iterator[Danger]:
        """Settings with which it flies, but not safely; accepted ones included."""

    @abstractmethod
    def advice(self, values: Mapping[str, float], context: ParamContext) -> Iterator[ParamNote]:
        """Warnings: they forbid no flight, but should be known before it."""

    def hints(self, values: Mapping[str, float], context: ParamContext) -> Iterator[ParamNote]:
        """What could be set better for a flight, with the command; said by ``mavbridge check``
        alone."""
        return iter(())

    @abstractmethod
    def wanted_params(
        self, values: Mapping[str, float], context: ParamContext
    ) -> Iterator[WantedParam]:
        """Parameters to show before a flight; whether a value will do, the methods above decide."""

    @abstractmethod
    def stick_curves(
        self, values: Mapping[str, float], mode: str, gains: StickGains | None
    ) -> StickCurves:
        """The map from a policy's sticks, which mean ``gains``, to this vehicle's in a mode.

        To be asked for again when parameters or the mode change. None: sticks stay as they are.
        """

    @abstractmethod
    def hover_thrust(self, values: Mapping[str, float]) -> float | None:
        """Collective thrust in 0..1 that hovers, by the vehicle's own estimate; None: not known."""

    def boosts_thrust(self, values: Mapping[str, float]) -> bool:
        """The vehicle divides the thrust of a setpoint by the cosine of its tilt."""
        return False

    def hand_per_s(self, values: Mapping[str, float]) -> float:
        """Speed, in full sticks a second, at which sticks leave a mode that flies by itself."""
        return math.inf

    def climb_limits(self, values: Mapping[str, float]) -> tuple[float, float]:
        """Climb and descent in m/s to which it cuts velocity setpoints, as its echo shows them."""
        return math.inf, math.inf

    @abstractmethod
    def takeoff(self, height_m: float, amsl_m: float | None) -> CommandRequest | None:
        """The command that lets the autopilot climb to a height above the ground by itself.

        ``amsl_m`` is the vehicle's present height above mean sea level, if it is known. None: it
        cannot be given without that.
        """
