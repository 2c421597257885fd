"""Derive the settings of link and guard from the flags and the policy's contract."""

import math
import os
from dataclasses import replace
from pathlib import Path

from mavbridge.config.flight import EnvelopeConfig, FlyConfig, Limits, LinkConfig
from mavbridge.config.policy import LoopRates
from mavbridge.core.clock import NS_PER_S
from mavbridge.core.errors import UserError
from mavbridge.core.link_settings import LinkSettings, SigningFiles
from mavbridge.core.vehicle import ActionMeaning, StickGains
from mavbridge.guard.chunks import FreshnessLimits
from mavbridge.guard.envelope import EnvelopeLimits
from mavbridge.guard.limits import ActionLimits
from mavbridge.guard.values import EngagementSettings
from policy.contract import ActionKind, Contract

TAU_S: dict[ActionKind, float] = {"sticks": 0.05, "rates": 0.01, "attitude": 0.05, "velocity": 0.05}
"""Default time constants of the low-pass filter. A policy of body rates closes the attitude loop,
which tolerates no lag of 50 ms."""


def require_goal(config: FlyConfig, contract: Contract) -> None:
    """Raise UserError unless --goal is given exactly when the policy takes a goal."""
    if "goal" in contract.state_extras and config.goal is None:
        raise UserError(
            "this policy flies to a goal: give --goal NORTH,EAST,DOWN, in metres from the "
            "estimator's origin (evaluate has none)"
        )
    if "goal" not in contract.state_extras and config.goal is not None:
        raise UserError(
            f"--goal {config.goal}: this policy takes no goal (state_extras of its contract): "
            "leave it out"
        )


def action_limits(config: FlyConfig, kind: ActionKind) -> ActionLimits:
    """Return the limits of sent actions of one kind."""
    bounds, free = config.setpoints, math.inf
    lean, rate = math.radians(bounds.setpoint_lean), math.radians(bounds.setpoint_rate)
    yaw, thrust = math.radians(bounds.setpoint_yaw_rate), bounds.setpoint_thrust
    match kind:
        case "sticks":
            slew = config.limits.max_slew or free
            return ActionLimits(low=(-1.0,) * 4, high=(1.0,) * 4, change_per_s=(slew,) * 4)
        case "rates":
            return ActionLimits(
                low=(0.0, -rate, -rate, -yaw),
                high=(thrust, rate, rate, yaw),
                change_per_s=(free,) * 4,
            )
        case "attitude":
            return ActionLimits(
                low=(0.0, -lean, -lean, -yaw),
                high=(thrust, lean, lean, yaw),
                change_per_s=(free, rate, rate, free),
                pair=(1, 2),
            )
        case "velocity":
            speed, climb, accel = (
                bounds.setpoint_speed,
                bounds.setpoint_climb,
                bounds.setpoint_accel,
            )
            return ActionLimits(
                low=(-speed, -speed, -climb, -yaw),
                high=(speed, speed, climb, yaw),
                change_per_s=(accel, accel, accel, free),
                pair=(0, 1),
            )


def engagement_settings(config: FlyConfig, contract: Contract) -> EngagementSettings:
    """Return how the policy may engage; raise UserError for a mode that its contract does not
    name."""
    mode = config.mode.upper() if config.mode else None
    if mode is not None and mode not in contract.modes:
        raise UserError(
            f"--mode {mode}: this policy flies in {' or '.join(contract.modes)} only, since its "
            "actions mean something else, or nothing, in other modes"
        )
    return EngagementSettings(
        modes=contract.modes,
        mode=mode,
        is_setpoint=contract.action != "sticks",
        arm=config.arm,
        takeoff_m=config.takeoff,
        engage_channel=config.engage_channel,
        engage_on_arm=config.engage_on_arm,
        readonly=config.link.readonly,
        duration_ns=None if config.duration is None else round(config.duration * NS_PER_S),
        on_fault=config.on_fault,
        then=config.then,
        keeps_place=contract.stops_at_end,
    )


def state_folder() -> Path:
    """Return the folder of persistent state, by the XDG base directory specification."""
    root = Path(os.environ.get("XDG_STATE_HOME", ""))
    if not root.is_absolute():  # the specification says to ignore such a value
        root = Path.home() / ".local" / "state"
    return root / "mavbridge"


def link_settings(config: FlyConfig, loops: LoopRates | None = None) -> LinkSettings:
    """Return the settings of the link. Chunks are sent between slots, too.

    ``loops`` None: the rates that a flight asks for before its policy is known.
    """
    loops = loops or config.rates.loops(is_dual=config.policy.dual_rate is not False)
    link, signing = config.link, None
    if link.signing_key_file is not None:
        signing = SigningFiles(key_file=link.signing_key_file, state_folder=state_folder())
    return LinkSettings(
        connect=link.connect,
        source_system=link.source_system,
        target_system=link.target_system,
        connect_timeout_s=link.connect_timeout,
        readonly=link.readonly,
        state_hz=loops.state_hz,
        min_battery_percent=config.envelope.min_battery,
        stick_hz=config.rates.stick_rate + loops.action_hz,
        set_params=link.set_params,
        accepted_risks=link.accept_risk,
        signing=signing,
    )


def action_meaning(contract: Contract, config: LinkConfig) -> ActionMeaning:
    """Return the meaning of the policy's actions; with ``link.raw_sticks``, sticks without
    gains."""
    gains = StickGains(
        lean_deg=contract.full_lean_deg,
        yaw_rate_degps=contract.full_yaw_rate_degps,
        climb_mps=contract.full_climb_mps,
        descent_mps=contract.full_descent_mps,
        lean_dead_zone=contract.lean_dead_zone,
        yaw_dead_zone=contract.yaw_dead_zone,
        throttle_dead_zone=contract.throttle_dead_zone,
    )
    return ActionMeaning(
        kind=contract.action,
        stick_gains=None if config.raw_sticks or contract.action != "sticks" else gains,
        hover_thrust=contract.hover_thrust,
        is_heading_frame=contract.velocity_frame == "heading",
    )


def envelope_limits(config: EnvelopeConfig, contract: Contract) -> EnvelopeLimits:
    """Return the defaults widened to the policy's needs, overridden by the flags."""

    def limit(default: float, needed: float | None, asked: float | None) -> float:
        return max(default, needed or 0.0) if asked is None else asked

    usual = EnvelopeLimits()
    return EnvelopeLimits(
        tilt_deg=limit(usual.tilt_deg, contract.max_tilt_deg, config.max_tilt),
        height_m=limit(usual.height_m, contract.max_height_m, config.max_height),
        speed_mps=limit(usual.speed_mps, contract.max_speed_mps, config.max_speed),
        distance_m=limit(usual.distance_m, contract.max_distance_m, config.max_distance),
    )


AGES = {
    "state_ns": ("max_state_age_s", "max_attitude_age"),
    "velocity_ns": ("max_velocity_age_s", "max_velocity_age"),
    "feature_ns": ("max_feature_age_s", "max_feature_age"),
    "chunk_ns": ("max_chunk_age_s", "max_chunk_age"),
    "stall_ns": ("max_stall_s", "max_stall"),
}
"""Fields of ``FreshnessLimits``, of the contract and of ``Limits``."""


def effective_freshness(contract: Contract, limits: Limits) -> FreshnessLimits:
    """Return the maximum input ages: the flag's if given, else the contract's.

    Raises:
        UserError: a flag would loosen a limit of the contract.
    """
    ages_ns: dict[str, int] = {}
    for name, (own, flag) in AGES.items():
        allowed_s, asked_s = getattr(contract, own), getattr(limits, flag)
        if asked_s is not None and asked_s > allowed_s:
            raise UserError(
                f"limits.{flag.removeprefix('max_')}={asked_s:g} is looser than the {allowed_s:g} "
                "s of this policy's contract: give less, or leave it out"
            )
        ages_ns[name] = round((allowed_s if asked_s is None else asked_s) * NS_PER_S)
    return FreshnessLimits(**ages_ns)


def contract_with_ages(contract: Contract, limits: Limits) -> Contract:
    """Return the contract with the ages of the flags, which may be looser.

    For simulated flights only, which measure the effect of an age on a policy.
    """
    asked_s = {own: getattr(limits, flag) for own, flag in AGES.values()}
    return replace(contract, **{own: s for own, s in asked_s.items() if s is not None})
