"""What a scenario can do to a flight, one step after the other."""

import signal
from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any, Literal, TypeAlias, TypeVar

from pymavlink.dialects.v20 import ardupilotmega as mav

from sitl import UsageError
from sitl.faults.stage import camera
from sitl.faults.stage.relay import Message, Override, set_fields
from sitl.faults.stage.stage import ProcessName, Stage
from sitl.faults.steps.host import HOST_KINDS, HostStep
from sitl.faults.steps.link import LINK_KINDS, LinkStep
from sitl.faults.steps.vehicle import ClockStep, RadioLost, SetParam, Switch

REBOOT_IN_FLIGHT = 20190226
"""Sixth parameter of MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN with which ArduPilot reboots while armed."""


@dataclass(frozen=True, kw_only=True)
class Wait:
    """Let time pass."""

    s: float

    def perform(self, stage: Stage) -> None:
        """Wait."""
        stage.observe(self.s)


@dataclass(frozen=True, kw_only=True)
class PolicyFault:
    """Wait until the policy says that its own fault has begun."""

    def perform(self, stage: Stage) -> int:
        """Returns the moment."""
        return stage.fault_ns()


@dataclass(frozen=True, kw_only=True)
class Signal:
    """Send a signal to a process."""

    name: str
    to: ProcessName | Literal["group"] = "flight"
    """``group`` is the flight process with its children, as a terminal sends it."""

    def perform(self, stage: Stage) -> int:
        """Returns the moment."""
        number = signal.Signals[self.name]
        if self.to == "recorder":
            return stage.recorder().kill(number)
        kill = {"flight": stage.kill, "group": stage.kill_group, "guard": stage.guard.kill}[self.to]
        return kill(number)


@dataclass(frozen=True, kw_only=True)
class Messages:
    """Drop, freeze or change a message of the vehicle from now on."""

    names: list[str]
    do_with: Literal["drop", "freeze", "set", "add"] = "drop"
    field: str = ""
    value: float = 0.0

    def perform(self, stage: Stage) -> int:
        """Returns the moment."""
        frozen: dict[str, float] = {}

        def change(message: Message) -> bool:
            if message.get_type() not in self.names:
                return True
            if self.do_with == "drop":
                return False
            names = [self.field] if self.field else _measured(message)
            for name in names:
                now = getattr(message, name)
                if self.do_with == "freeze":
                    set_fields(message, **{name: frozen.setdefault(name, now)})
                else:
                    base = now if self.do_with == "add" else 0
                    set_fields(message, **{name: base + self.value})
            return True

        return stage.relay.rewrite(change)


@dataclass(frozen=True, kw_only=True)
class WholeMessages:
    """Every message of the vehicle passes as it is again."""

    def perform(self, stage: Stage) -> int:
        """Returns the moment."""
        return stage.relay.rewrite_nothing()


@dataclass(frozen=True, kw_only=True)
class Pilot:
    """Another station changes the mode, arms, disarms or reboots the vehicle."""

    act: Literal["mode", "arm", "disarm", "reboot"]
    mode: str = ""

    def perform(self, stage: Stage) -> int:
        """Returns the moment."""
        relay = stage.relay
        if self.act == "mode":
            return relay.set_mode(self.mode)
        if self.act == "reboot":
            number = mav.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN
            return relay.command(number, 1, 0, 0, 0, 0, REBOOT_IN_FLIGHT)
        return relay.arm() if self.act == "arm" else relay.disarm()


@dataclass(frozen=True, kw_only=True)
class Joystick:
    """Another program sends sticks with the bridge's own system id."""

    hz: float
    s: float
    roll_us: int = 1400

    def perform(self, stage: Stage) -> int:
        """Returns the moment of the first."""
        sticks = Override(roll=self.roll_us, pitch=1500, throttle=1500, yaw=1500)
        began_ns = stage.relay.move_joystick(sticks, is_manual=stage.is_px4)
        for _ in range(round(self.s * self.hz)):
            stage.observe(1 / self.hz)
            stage.relay.move_joystick(sticks, is_manual=stage.is_px4)
        return began_ns


@dataclass(frozen=True, kw_only=True)
class Images:
    """The camera shows something else from now on."""

    show: camera.Fault

    def perform(self, stage: Stage) -> int:
        """Returns the moment."""
        if stage.camera is None:
            raise UsageError("this flight has no camera that can be spoilt")
        return stage.camera.show(self.show)


@dataclass(frozen=True, kw_only=True)
class Terminal:
    """Nobody reads the terminal any more, and it is full."""

    def perform(self, stage: Stage) -> None:
        """Fill it."""
        stage.fill_output()


Step: TypeAlias = (
    Wait
    | PolicyFault
    | Signal
    | Messages
    | WholeMessages
    | Pilot
    | Joystick
    | Images
    | Terminal
    | ClockStep
    | SetParam
    | Switch
    | RadioLost
    | HostStep
    | LinkStep
)
KINDS: dict[str, Callable[..., Step]] = {
    "wait": Wait,
    "policy": PolicyFault,
    "signal": Signal,
    "messages": Messages,
    "whole messages": WholeMessages,
    "pilot": Pilot,
    "joystick": Joystick,
    "images": Images,
    "terminal": Terminal,
    "clock": ClockStep,
    "param": SetParam,
    "switch": Switch,
    "radio": RadioLost,
    **HOST_KINDS,
    **LINK_KINDS,
}
"""Steps by the key ``do`` of a scenario."""
Made = TypeVar("Made")


def make(kind: Callable[..., Made], table: dict[str, Any], where: str) -> Made:
    """Make a dataclass of a TOML table.

    Raises:
        UsageError: a key is unknown or missing.
    """
    known = [field.name for field in fields(kind)]  # type: ignore[arg-type]
    if unknown := sorted(set(table) - set(known)):
        raise UsageError(f"{where}: unknown {', '.join(unknown)}; known: {', '.join(known)}")
    try:
        return kind(**table)
    except TypeError as error:
        raise UsageError(f"{where}: {error}") from error


def make_step(table: dict[str, Any], where: str) -> Step:
    """One step of a scenario; ``do`` names its kind.

    Raises:
        UsageError: the kind or a key is unknown or missing.
    """
    name = str(table.get("do"))
    if name not in KINDS:
        raise UsageError(f"{where}: do = {name!r} is none of {', '.join(KINDS)}")
    return make(KINDS[name], {key: value for key, value in table.items() if key != "do"}, where)


def _measured(message: Message) -> list[str]:
    """Numbers of a message that are measurements, not its time."""
    names: list[str] = message.get_fieldnames()
    numbers = [name for name in names if isinstance(getattr(message, name), int | float)]
    return [name for name in numbers if not name.startswith("time")]
