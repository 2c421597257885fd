"""Scripted policy: climbs, follows a program, and plans it for the length of a chunk."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import get_args

import numpy as np

from policy.contract import ACTION_DIM, ActionKind, Contract, FloatArray
from policy.errors import PolicyError
from policy.motion.controllers import (
    CONTROLS,
    Climb,
    Measured,
    Motion,
    ThrustLoop,
    clip,
    make_program,
    measure,
)
from policy.protocol import predict_by_pair

FEATURE_DIM = 8
DEFAULT_CONTRACT = Contract()

TAKEOFF_CLIMB_MPS = 1.5
TAKEOFF_TOLERANCE_M = 0.2
HOLD_TOLERANCE_M = 0.15
"""Altitude error below which the stick is centred and the autopilot holds the altitude."""
SETTLE_S = 2.0
"""Time between reaching the altitude and the start of the program."""
CLIMB_PER_ALTITUDE = 1.0  # 1/s
AIRBORNE_M = 0.3
MOST_SINK_M = 3.0
"""A downward push ends this far below the program's altitude."""
MAX_STEP_S = 0.2
"""Longest time over which one climb-rate reading is integrated."""


class ScriptedPolicy:
    """Takes off at the first call, or the first after a reset, then flies ``program`` forever.

    The state has no position: altitude is the integral of the measured climb rate. So a late
    takeoff does no harm, and the altitude drifts like the vehicle's own velocity estimate. A state
    at rest on the ground equals that of a hover, so a flight that begins in the air must be
    declared. Used by one thread.
    """

    def __init__(
        self,
        program: str,
        now_s: Callable[[], float],
        *,
        action: ActionKind = "sticks",
        starts_in_air: bool = False,
        contract: Contract = DEFAULT_CONTRACT,
    ) -> None:
        """Prepare a program.

        Args:
            program: one of ``PROGRAM_NAMES``.
            now_s: monotonic seconds.
            action: kind of the actions; velocities are in the heading frame.
            starts_in_air: keep the initial altitude; else climb to the program's.
            contract: image and chunk; frames, kind and modes are set by the policy.
        """
        self.contract = replace(
            contract,
            state_frame="ned_frd",
            feature_dim=FEATURE_DIM,
            arrays="numpy",
            action=action,
            modes=(),  # the action kind's usual modes
            velocity_frame="heading",
        )
        self._program = make_program(program, action)
        self._control = CONTROLS[action]
        self._now_s = now_s
        self._starts_in_air = starts_in_air
        self._goal_m = 0.0 if starts_in_air else self._program.altitude_m
        self._thrust_loop = ThrustLoop(self.contract.hover_thrust)
        self._last_s: float | None = None
        self._altitude_m = 0.0
        self.program_start_s: float | None = None
        """Start, past or future, by ``now_s``; None until the altitude is reached."""

    def reset(self) -> None:
        """Begin again; the current altitude becomes the start's."""
        self._last_s = self.program_start_s = None
        self._altitude_m = 0.0
        self._thrust_loop.reset()

    def encode_visual(self, image: FloatArray) -> FloatArray:
        """Return mean and deviation of each channel of [1, 3, H, W], zero-padded: [1, 8]."""
        sparse = image[:, :, ::4, ::4]
        feature = np.zeros((image.shape[0], FEATURE_DIM), np.float32)
        feature[:, :3] = sparse.mean(axis=(2, 3))
        feature[:, 3:6] = sparse.std(axis=(2, 3))
        return feature

    predict = predict_by_pair

    def predict_fast(
        self,
        feature: FloatArray,
        state: FloatArray,
        action_history: FloatArray,
        num_diffusion_steps: int,
    ) -> FloatArray:
        """Return a chunk [1, horizon, 4] for a state [1, 13] in ``ned_frd``; ignores the rest.

        Each action is the program's motion at its own time, with the current feedback.
        """
        now_s = self._now_s()
        measured = measure(state[0])
        climb = self._follow(now_s, measured)
        chunk = np.zeros((1, self.contract.horizon, ACTION_DIM), np.float32)
        for index in range(self.contract.horizon):
            wanted = self._wanted(now_s + index * self.contract.chunk_dt_s)
            chunk[0, index] = self._control(wanted, measured, climb)
        return chunk

    def _follow(self, now_s: float, measured: Measured) -> Climb:
        """Integrate the altitude, start the program once it is reached, and demand a climb."""
        step_s = 0.0
        if self._last_s is not None:
            step_s = min(max(now_s - self._last_s, 0.0), MAX_STEP_S)
            self._altitude_m += measured.climb_mps * step_s
        self._last_s = now_s
        up = self._altitude_m > self._goal_m - TAKEOFF_TOLERANCE_M
        if up and self.program_start_s is None:
            self.program_start_s = now_s + SETTLE_S
        error_m = self._goal_m - self._altitude_m
        wanted_mps = clip(CLIMB_PER_ALTITUDE * error_m, TAKEOFF_CLIMB_MPS)
        return Climb(
            wanted_mps=wanted_mps,
            is_held=self.program_start_s is not None and abs(error_m) < HOLD_TOLERANCE_M,
            thrust=self._thrust_loop.update(
                wanted_mps - measured.climb_mps,
                step_s,
                is_airborne=self._starts_in_air or self._altitude_m > AIRBORNE_M,
            ),
        )

    def _wanted(self, time_s: float) -> Motion:
        start_s = self.program_start_s
        if start_s is None or time_s < start_s:
            return Motion()
        wanted = self._program.motion(time_s - start_s)
        is_low = self._altitude_m < self._goal_m - MOST_SINK_M
        if is_low and wanted.push is not None and wanted.push.axis == "climb":
            return Motion()
        return wanted


IN_AIR = "air"


def make_scripted(
    options: Sequence[str], now_s: Callable[[], float], *, contract: Contract
) -> ScriptedPolicy:
    """Create the policy of ``[PROGRAM][:ACTION][:air]``, already split at the colons.

    Without a program it hovers; without an action kind it moves sticks. ``air``: it begins in the
    air and keeps that altitude.
    """
    starts_in_air = options[-1:] == [IN_AIR]
    named = [*options[: len(options) - starts_in_air], "", ""]
    program, action, *rest = named[0] or "hover", named[1] or "sticks", *filter(None, named[2:])
    kind = next((kind for kind in get_args(ActionKind) if kind == action), None)
    if kind is None or rest:
        raise PolicyError(
            f"scripted:{':'.join(options)}: after the program comes one of "
            f"{', '.join(get_args(ActionKind))}, then perhaps {IN_AIR}; got {[action, *rest]}"
        )
    return ScriptedPolicy(
        program, now_s, action=kind, starts_in_air=starts_in_air, contract=contract
    )
