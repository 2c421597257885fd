"""Flights in simulated time with any kind of action on any firmware, and the vehicle's own record.

The policy is a scripted one, so that every kind of action flies equal programs.
"""

import math
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, Self

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as dialect

from helpers.guard_flights import MS, GuardFlight
from mavbridge.config.flight import FlyConfig, LinkConfig
from mavbridge.core.clock import NS_PER_S
from mavbridge.core.reasons import Code
from mavbridge.guard.values import Phase
from mavbridge.simulation.world import NOMINAL_VEHICLE
from policy.contract import ActionKind, FloatArray
from policy.motion.controllers import Motion, Program, Push, make_program
from policy.motion.scripted import ScriptedPolicy
from policy.protocol import PolicyRunner
from sitl.ardupilot.autopilot import ArduCopter
from sitl.ardupilot.flight_modes import Mode as ArduMode
from sitl.ardupilot.guided import Submode
from sitl.course import AirborneStart
from sitl.px4.autopilot import Px4
from sitl.px4.modes import Px4Mode
from sitl.vehicle.config import MID_RECEIVER_US, AutopilotName, VehicleConfig
from sitl.vehicle.firmware import VelocitySetpoint
from sitl.vehicle.rotation import Quat, cos_tilt

ALOFT = AirborneStart(position_ned_m=(0.0, 0.0, -10.0))
SOLVE_NS = 3 * MS
LEANING = Program(motion=lambda _: Motion(push=Push("roll", 0.5)))
"""Lean 15 degrees to the right, or fly 2 m/s to the right: far from neutral in every record."""
HOVERING = make_program("hover", "sticks")

FLIGHT_MODES: dict[tuple[AutopilotName, ActionKind], str] = {
    ("ardupilot", "sticks"): "ALT_HOLD",
    ("ardupilot", "attitude"): "GUIDED_NOGPS",
    ("ardupilot", "rates"): "GUIDED_NOGPS",
    ("ardupilot", "velocity"): "GUIDED",
    ("px4", "sticks"): "ALTCTL",
    ("px4", "attitude"): "OFFBOARD",
    ("px4", "rates"): "OFFBOARD",
    ("px4", "velocity"): "OFFBOARD",
}
"""Default mode for each kind of action."""
COMBINATIONS = tuple(FLIGHT_MODES)
CENTRED_US = 12
"""Sticks this close to the middle count as neutral: the dither of the echo check is smaller."""
NEUTRAL_TILT_RAD, NEUTRAL_RATE_RADPS = math.radians(1.0), math.radians(1.5)
NEUTRAL_MPS = 0.1


class Sample(NamedTuple):
    """State of the vehicle after one of its own control steps."""

    t_s: float
    """Time since boot."""
    mode: str
    armed: bool
    failsafe: bool
    is_neutral: bool
    """True if the last command is level or at rest."""
    lean_deg: float
    position_ned_m: tuple[float, float, float]


@dataclass(frozen=True, kw_only=True)
class Aftermath:
    """Reaction of the vehicle after a given time, in ms from then; None: never."""

    neutral_ms: float | None
    """Time until a command was level or at rest, another mode took over, or it was disarmed."""
    lean_held_ms: float
    """Time for which it kept nine tenths of its initial lean."""
    flew_again: bool
    """True if, after it was neutral, it got other commands in the mode of the flight."""
    final_mode: str


class OutputFlight(GuardFlight):
    """One flight of one kind of action on one firmware."""

    def __init__(
        self,
        autopilot: AutopilotName,
        kind: ActionKind,
        program: Program = LEANING,
        *,
        in_air: bool = True,
        has_receiver: bool = True,
        params: dict[str, float] | None = None,
        vehicle: VehicleConfig = NOMINAL_VEHICLE,
        **config: Any,
    ) -> None:
        """``config`` are fields of ``FlyConfig``. PX4 has no receiver, ArduPilot's is centred."""
        self.autopilot, self.kind, self.is_px4 = autopilot, kind, autopilot == "px4"
        self.mode = FLIGHT_MODES[autopilot, kind]
        self.samples: list[Sample] = []
        self._in_air = in_air
        self.program = program
        self._nan_from_ns: int | None = None
        receiver_us = MID_RECEIVER_US if has_receiver and not self.is_px4 else None
        super().__init__(
            replace(vehicle, autopilot=autopilot, receiver_us=receiver_us),
            ({} if self.is_px4 else {"GUID_OPTIONS": 8.0}) | (params or {}),
            FlyConfig(link=LinkConfig(connect="memory"), **config),
        )
        self._boot_ns = self.vehicle.ap.now_ns

    # --- the policy

    def _runner(self) -> PolicyRunner:
        self.scripted = ScriptedPolicy(
            "hover",
            lambda: self.clock.now_ns() / NS_PER_S,
            action=self.kind,
            starts_in_air=self._in_air,
        )
        self.scripted._program = Program(motion=lambda time_s: self.program.motion(time_s))
        return PolicyRunner(
            contract=self.scripted.contract,
            name="test",
            engine="numpy",
            dual_rate=True,
            encode=lambda rgb, camera=0: np.zeros((1, 1), np.float32),
            act=self._act,
            reset=self.scripted.reset,
        )

    def _act(self, encoded: FloatArray, state: FloatArray, history: FloatArray) -> FloatArray:
        self._policy_clock.ahead_ns += SOLVE_NS
        chunk = self.scripted.predict_fast(encoded, state, history, 1)
        if self._nan_from_ns is not None and self.clock.now_ns() >= self._nan_from_ns:
            chunk[:, :, 1] = np.nan
        return chunk

    def return_nan(self) -> None:
        self._nan_from_ns = self.clock.now_ns()

    # --- into the air

    def launch(self) -> Self:
        """Hover armed under the pilot, with the link ready and the policy fresh."""
        self.put_in_air()
        self.until(lambda: self.codes == (Code.NOT_ENGAGED,), within_s=10)
        return self

    def fly(self, seconds: float = 1.5) -> Self:
        """Launch, engage by the key, and let the policy fly long enough for the echo."""
        self.launch()
        self.act("engage")
        self.until(lambda: self.phase is Phase.FLYING, within_s=1.5)
        self.begin_program()
        self.run(seconds)
        assert self.phase is Phase.FLYING, self.describe()
        return self

    def put_in_air(self) -> None:
        """Hover armed under the pilot, from any state of the vehicle."""
        self.vehicle.launch(ALOFT)
        self.run(0.6)  # its estimator has a position by then
        if not self.is_px4:
            assert self.ardupilot.set_mode(ArduMode[self.mode])
        elif self.kind != "sticks":
            self.forget_sticks()

    def forget_sticks(self) -> None:
        """Reset PX4 to a vehicle that was armed without sticks, none of which has ever moved."""
        self.px4.set_mode(Px4Mode.AUTO_LOITER)
        self.px4.stick_input.valid = self.px4.stick_input._never_ages = False
        self.px4.start_motors(ignores_sticks=True)

    def begin_program(self) -> None:
        self.run(0.05)  # the policy is reset when a flight begins
        self.scripted.program_start_s = 0.0

    # --- the vehicle

    @property
    def ardupilot(self) -> ArduCopter:
        assert isinstance(self.vehicle.ap, ArduCopter)
        return self.vehicle.ap

    @property
    def px4(self) -> Px4:
        assert isinstance(self.vehicle.ap, Px4)
        return self.vehicle.ap

    @property
    def now_s(self) -> float:
        return self.clock.now_ns() / NS_PER_S

    @property
    def position_ned_m(self) -> tuple[float, float, float]:
        return self.vehicle.ap.truth.position_ned_m

    def describe(self) -> str:
        return f"{self.autopilot} {self.kind}: {super().describe()}"

    def pilot_changes_mode(self) -> str:
        """Take over as a pilot at a ground station, in a mode that holds; return its name."""
        main, sub = (4, 3) if self.is_px4 else (ArduMode.LOITER.value, 0)
        self.command(dialect.MAV_CMD_DO_SET_MODE, 1, main, sub)
        return "AUTO.LOITER" if self.is_px4 else "LOITER"

    def lose_position(self) -> None:
        (self.px4 if self.is_px4 else self.ardupilot).position_lost = True

    # --- the record

    @property
    def t_s(self) -> float:
        """Seconds since boot: the time of the record."""
        return self.samples[-1].t_s

    def _after_step(self) -> None:
        super()._after_step()
        ap = self.vehicle.ap
        body, t_s = ap.truth, (ap.now_ns - self._boot_ns) / NS_PER_S
        if self.samples and self.samples[-1].t_s == t_s:  # PX4 steps every 4 ms
            return
        sample = Sample(
            t_s=t_s,
            mode=ap.mode_name,
            armed=ap.armed,
            failsafe=ap.in_failsafe,
            is_neutral=self._is_neutral(),
            lean_deg=math.degrees(_tilt_rad(body.ned_from_body_wxyz)),
            position_ned_m=body.position_ned_m,
        )
        self.samples.append(sample)

    def _is_neutral(self) -> bool:
        if self.kind == "sticks":
            return all(abs(us - 1500) <= CENTRED_US for us in self.vehicle.ap.sticks_us)
        return self._is_setpoint_neutral()

    def _is_setpoint_neutral(self) -> bool:
        if self.is_px4:
            setpoint: Any = self.px4.setpoint
            if isinstance(setpoint, VelocitySetpoint):
                return math.hypot(*setpoint.velocity_ned_mps) < NEUTRAL_MPS
            attitude = setpoint.ned_from_body_wxyz if setpoint is not None else None
            return attitude is not None and _tilt_rad(attitude) < NEUTRAL_TILT_RAD
        guided = self.ardupilot.guided
        if guided is None or guided.submode is not Submode.ATTITUDE:
            return guided is None or math.hypot(*guided.velocity[0]) < NEUTRAL_MPS
        setpoint = guided._setpoint
        if setpoint is None:
            return True
        attitude, rates = setpoint.ned_from_body_wxyz, setpoint.rate_body_radps
        return (
            attitude is not None
            and _tilt_rad(attitude) < NEUTRAL_TILT_RAD
            and math.hypot(*rates) < NEUTRAL_RATE_RADPS
        )

    def aftermath(self, since_s: float) -> Aftermath:
        """Read the record from a time on at which the policy flew."""
        before = [s for s in self.samples if s.t_s <= since_s][-1]
        after = [s for s in self.samples if s.t_s > since_s]
        assert before.mode == self.mode, before

        def first_ms(matches: Any) -> float | None:
            return next(((s.t_s - since_s) * 1e3 for s in after if matches(s)), None)

        neutral_ms = first_ms(lambda s: s.is_neutral or s.mode != self.mode or not s.armed)
        flew_again = neutral_ms is not None and any(
            s.mode == self.mode and s.armed and not s.is_neutral
            for s in after
            if (s.t_s - since_s) * 1e3 > neutral_ms
        )
        lean_ms = first_ms(lambda s: s.lean_deg < 0.9 * before.lean_deg)
        return Aftermath(
            neutral_ms=neutral_ms,
            lean_held_ms=(after[-1].t_s - since_s) * 1e3 if lean_ms is None else lean_ms,
            flew_again=flew_again,
            final_mode=after[-1].mode,
        )


def _tilt_rad(ned_from_body_wxyz: Quat) -> float:
    return math.acos(max(-1.0, min(1.0, cos_tilt(ned_from_body_wxyz))))
