"""Records with sensible defaults: a vehicle that flies well at 100 Hz with 30 Hz vision.

Stamps follow from the index alone, so that a series of ticks is a plausible flight. Keywords
replace any field.
"""

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mavbridge.config.flight import FlyConfig, LinkConfig
from mavbridge.core.clock import NS_PER_MS, NS_PER_S
from mavbridge.core.reasons import Code, Reason, because
from mavbridge.core.records import Solve, Tick, VehicleState, VisionTick
from mavbridge.core.ticks import GuardTick
from mavbridge.core.vehicle import NEUTRAL, ActionTrace, Sticks
from mavbridge.flight.plan import FlightPlan, plan_flight
from mavbridge.guard.values import Phase
from policy.contract import Contract

START_NS = 1_000 * NS_PER_S
TICK_NS = 10 * NS_PER_MS
FRAME_NS = NS_PER_S // 30
_NO_IMAGE = because(Code.NO_IMAGE)
HOVER = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, -9.81)


def make_state(at_ns: int = START_NS, **changes: Any) -> VehicleState:
    """Return a level hover whose parts all arrived at ``at_ns``."""
    values = np.array(HOVER, dtype=np.float32)
    values.flags.writeable = False
    state = VehicleState(
        values=values,
        attitude_ns=at_ns,
        rate_ns=at_ns,
        velocity_ns=at_ns,
        specific_force_ns=at_ns,
    )
    return replace(state, **changes)


def make_plan(contract: Contract | None = None, **config: Any) -> FlightPlan:
    """Return the plan of a flight at two rates with the default contract and flags."""
    flags = FlyConfig(link=LinkConfig(connect="udp:127.0.0.1:14550"), **config)
    return plan_flight(flags, contract or Contract(), is_dual=True)


def make_trace(sticks: Sticks = NEUTRAL) -> ActionTrace:
    """Return the trace of an action that no stage changes."""
    return ActionTrace(raw=sticks, clipped=sticks, slewed=sticks, smoothed=sticks)


def make_tick(index: int = 0, **changes: Any) -> Tick:
    """Return tick ``index``: flying, on time, 2 ms solve; attitude 3 ms and feature 40 ms old.

    Each tick flies a new chunk.
    """
    due_ns = START_NS + index * TICK_NS
    tick = Tick(
        serial=index,
        index=index,
        due_ns=due_ns,
        woke_ns=due_ns,
        missed_slots=0,
        predict_ns=2 * NS_PER_MS,
        sent_ns=due_ns + 2 * NS_PER_MS,
        feature_frame_id=1,
        feature_captured_ns=due_ns - 38 * NS_PER_MS,
        state=make_state(due_ns - NS_PER_MS),
        trace=make_trace(),
        sent=NEUTRAL,
        release_reason=None,
        mode="ALT_HOLD",
        armed=True,
        rc_channels_us=(1500,) * 8,
        rc_sticks=NEUTRAL,
        phase="flying",
        chunk_serial=index,
        chunk_computed_ns=changes.get("woke_ns", due_ns) + 2 * NS_PER_MS,
    )
    return replace(tick, **changes)


def make_released_tick(index: int = 0, reason: Reason = _NO_IMAGE, **changes: Any) -> Tick:
    """Return tick ``index`` of a vehicle that the pilot flies."""
    released: dict[str, Any] = {
        "predict_ns": None,
        "trace": None,
        "sent": None,
        "release_reason": reason,
        "phase": "released",
        "chunk_serial": None,
        "chunk_computed_ns": None,
    }
    return make_tick(index, **(released | changes))


def make_vision_tick(frame_id: int = 1, **changes: Any) -> VisionTick:
    """Return frame ``frame_id``: taken up after 2 ms, encoded in 20 ms, no frame dropped."""
    captured_ns = START_NS + (frame_id - 1) * FRAME_NS
    rgb = np.zeros((24, 32, 3), dtype=np.uint8)
    rgb.flags.writeable = False
    vision = VisionTick(
        serial=frame_id - 1,
        frame_id=frame_id,
        captured_ns=captured_ns,
        started_ns=captured_ns + 2 * NS_PER_MS,
        ready_ns=captured_ns + 22 * NS_PER_MS,
        dropped_frames=0,
        rgb=rgb,
    )
    return replace(vision, **changes)


def make_solve(serial: int = 0, **changes: Any) -> Solve:
    """Return the solve of tick ``serial``: 8 neutral actions, 50 ms apart, after 2 ms."""
    first_ns = START_NS + serial * TICK_NS
    solve = Solve(
        serial=serial,
        started_ns=first_ns,
        computed_ns=first_ns + 2 * NS_PER_MS,
        reset_ns=0,
        state=make_state(first_ns),
        states=np.zeros((1, 13), np.float32),
        history=np.zeros((1, 4, 4), np.float32),
        frame_ids=((1,),),
        image_ns=first_ns,
        first_ns=first_ns,
        step_ns=50 * NS_PER_MS,
        actions=np.zeros((1, 8, 4), np.float32),
    )
    return replace(solve, **changes)


def about_z(angle_rad: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return rotations [B, 4] by angles [B] about the third axis."""
    zero = np.zeros_like(angle_rad)
    return np.stack([np.cos(angle_rad / 2), zero, zero, np.sin(angle_rad / 2)], axis=-1)


def make_guard_tick(at_ns: int, **changes: Any) -> GuardTick:
    """Return a slot that the guard served in time, with nothing to send."""
    tick = GuardTick(
        index=0,
        due_ns=at_ns,
        woke_ns=at_ns,
        decided_ns=at_ns,
        sent_ns=at_ns,
        missed_slots=0,
        trace=None,
        sent=None,
        phase=Phase.WAITING,
        release_reason=None,
    )
    return replace(tick, **changes)
