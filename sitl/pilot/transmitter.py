"""Simulated transmitter: from a pilot's hand to receiver channels; and the choice of pilot."""

import os
import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Literal, NamedTuple, TypeAlias

from sitl import UsageError
from sitl.ardupilot.autopilot import ArduCopter
from sitl.ardupilot.flight_modes import Mode
from sitl.clock import NS_PER_MS, NS_PER_S, Clock
from sitl.course import Course
from sitl.pilot.course_guide import CourseGuide
from sitl.pilot.demonstrator import CENTRED, STICK_AGILITY, StickPositions, expert_sticks
from sitl.px4.autopilot import Px4
from sitl.px4.modes import Px4Mode
from sitl.simulated_vehicle import SimulatedVehicle

OFF_US = (0,) * 8  # no signal from the transmitter
PERIOD_NS = 20 * NS_PER_MS  # between two frames of a receiver
IDLE, DESCENT = (CENTRED._replace(throttle=throttle) for throttle in (-1.0, -0.8))
_SWITCH_US = {"low": 1000, "middle": 1500, "high": 2000}

Switch = Literal["low", "middle", "high"]


class Hand(NamedTuple):
    """Sticks and switch of the pilot."""

    sticks: StickPositions = CENTRED
    switch: Switch = "low"


class Transmitter(ABC):
    """Source of receiver values: converts a hand to channels at a receiver's frame rate."""

    def __init__(self, now_ns: Callable[[], int]) -> None:
        self._now_ns = now_ns
        self._start_ns = self._due_ns = now_ns()

    @abstractmethod
    def _hand(self, now_ns: int) -> Hand | None:
        """Return the pilot's hand for the next frame; None: no signal."""

    def latest(self) -> Sequence[int] | None:
        """Return the channels once for each frame: sticks, two unused, switch, unused."""
        now_ns = self._now_ns()
        if now_ns < self._due_ns:
            return None
        is_on_time = now_ns - self._due_ns < PERIOD_NS
        self._due_ns = (self._due_ns if is_on_time else now_ns) + PERIOD_NS
        if (hand := self._hand(now_ns)) is None:
            return OFF_US
        throttle, yaw, pitch, roll = hand.sticks
        sticks = (_us(roll), _us(-pitch), _us(throttle), _us(yaw))
        return (*sticks, 1500, 1500, _SWITCH_US[hand.switch], 1500)

    def close(self) -> None:
        """Stop the input device, if any."""
        return


def _us(position: float) -> int:
    """Convert a position to microseconds; less is left, nose down and descent."""
    return round(1500 + 500 * max(-1.0, min(1.0, position)))


DEAD_ZONE = 0.08
"""Share of the travel to each side that counts as centred; springs return to within 0.05."""


PadAxes: TypeAlias = dict[str, tuple[int, float]]
"""Number of each stick's axis, from 0, and its sign. A pad's vertical axes are negative upwards."""
DEFAULT_AXES = "throttle=-1,yaw=0,pitch=-4,roll=3"
"""Mode 2 on a common pad: the left stick climbs and turns, the right one leans."""


def parse_axes(text: str) -> PadAxes:
    """Parse ``throttle=-1,yaw=0,pitch=-4,roll=3``; a minus reverses the axis.

    Raises:
        UsageError: not exactly one axis number for each of the four sticks.
    """
    found = re.findall(r"(?:^|,)\s*(throttle|yaw|pitch|roll)=(-?)(\d{1,2})\s*(?=,|$)", text)
    axes = {name: (int(number), -1.0 if minus else 1.0) for name, minus, number in found}
    if len(axes) != len(StickPositions._fields) or text.count(",") != len(axes) - 1:
        raise UsageError(
            f"--pilot-axes {text}: give the axis of each stick, with a minus to reverse it, such "
            f"as {DEFAULT_AXES}"
        )
    return axes


def pad_sticks(axes: PadAxes, values: Sequence[float]) -> StickPositions:
    """Convert the pad's axis values to stick positions; an absent axis is 0."""
    read = {name: values[k] * sign if k < len(values) else 0.0 for name, (k, sign) in axes.items()}
    return StickPositions(**{name: past_dead_zone(value) for name, value in read.items()})


def past_dead_zone(value: float) -> float:
    """Remove the dead zone from a position in [-1, 1]; full deflection stays full."""
    beyond = max(0.0, min(1.0, abs(value)) - DEAD_ZONE) / (1.0 - DEAD_ZONE)
    return beyond if value > 0.0 else -beyond


WAIT_NS = 8 * NS_PER_S
"""Time from boot to arming: the estimator needs 3 s for the attitude and 5 s for the
position, and a recorder requests parameters and streams."""
HOVER_NS = 2 * NS_PER_S  # after the last gate, before the landing
EXPERT_MPS = 5.0


class ExpertPilot(Transmitter):
    """One flight of the expert over the course, with the switch high up to the last gate."""

    def __init__(self, vehicle: SimulatedVehicle, course: Course) -> None:
        super().__init__(lambda: vehicle.ap.now_ns)
        self._vehicle = vehicle
        self._guide = CourseGuide(course, STICK_AGILITY, EXPERT_MPS)
        self._was_armed = False
        self._over_course_ns: int | None = None

    def _hand(self, now_ns: int) -> Hand:
        ap = self._vehicle.ap
        if not ap.armed:
            if not self._was_armed and now_ns - self._start_ns >= WAIT_NS:
                ap.arm()
            return Hand(IDLE)
        self._was_armed = True
        sticks = expert_sticks(self._guide, ap.truth, now_ns / NS_PER_S)
        if self._guide.next_gate is not None:
            return Hand(sticks, switch="high")
        if self._over_course_ns is None:
            self._over_course_ns = now_ns
        if now_ns - self._over_course_ns < HOVER_NS:
            return Hand(sticks)
        if ap.landed:
            ap.disarm(force=False)
        return Hand(DESCENT)


PilotName = Literal["gamepad", "expert"]
PILOTS: tuple[PilotName, ...] = ("gamepad", "expert")


def prepare_vehicle(vehicle: SimulatedVehicle) -> None:
    """Make the vehicle fly by its receiver in ALT_HOLD or ALTCTL. Call before the flight."""
    if isinstance(vehicle.ap, ArduCopter):
        vehicle.ap.set_mode(Mode.ALT_HOLD)
    elif isinstance(vehicle.ap, Px4):
        vehicle.params.set("COM_RC_IN_MODE", 0.0)  # sticks from the receiver alone
        vehicle.ap.set_mode(Px4Mode.ALTCTL)


def make_pilot(
    name: PilotName,
    axes: str,
    *,
    vehicle: SimulatedVehicle,
    course: Course,
    clock: Clock,
) -> tuple[Transmitter, str]:
    """Return the pilot and a line about it for the user.

    ``axes`` are a gamepad's, in the format of `parse_axes`.

    Raises:
        UsageError: the pilot lacks its package, display or vehicle, or its axes cannot be read.
    """
    if name == "expert":
        if vehicle.ap.config.autopilot != "ardupilot":
            raise UsageError("--pilot expert knows the sticks of ardupilot alone")
        return ExpertPilot(vehicle, course), f"the expert flies at {EXPERT_MPS:g} m/s"
    wanted = parse_axes(axes)
    os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")  # no banner on import
    try:
        import pygame

        from sitl.pilot import gamepad
    except ModuleNotFoundError as error:
        if error.name != "pygame":
            raise
        raise UsageError("--pilot gamepad needs pygame: pip install pygame-ce") from error
    try:
        pad = gamepad.PygamePad()
    except pygame.error as error:
        raise UsageError(f"--pilot gamepad needs a display: {error}") from error
    found = pad.description or "no gamepad yet: plug one in (until then the receiver has no signal)"
    return gamepad.GamepadPilot(pad, wanted, vehicle, clock), f"{found}; {gamepad.PAD_HELP}"
