"""The table of the engagement, row by row: docs/safety.md shows it to pilots."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import pytest

from benchmarks.safety_table import PAGE, with_table
from helpers.guard_facts import (
    AIRBORNE,
    DEATH,
    IDLE_RECEIVER,
    NO_RECEIVER,
    ON_GROUND,
    PX4_MODES,
    Stepped,
    altered,
    codes,
    flying,
)
from mavbridge.core.clock import NS_PER_S
from mavbridge.core.reasons import Code, Reason, because
from mavbridge.guard import engagement
from mavbridge.guard.memory import not_engaged
from mavbridge.guard.table import PROGRESS, TABLE, Transition
from mavbridge.guard.values import ControlSource, EndRequest, EngagementOutput, Phase

IDLE, POLICY, NEUTRAL, LEVEL, RELEASE = ControlSource
WAITING, PREPARING, FLYING, LEAVING, HOLDING, RELEASING, RELEASED, ENDED = Phase
NO_CHUNK, NO_IMAGE, LOST = because(Code.NO_CHUNK), because(Code.NO_IMAGE), Code.HEARTBEAT_LOST
TILT = because(Code.BEYOND, quantity="tilt", value=70.0, limit=60.0, unit="deg")
OVERRULED = because(Code.OVERRULED, quantity="sticks", cause="a joystick")
GONE = because(Code.CONNECTION_LOST)
REBOOT = {"interruption": because(Code.REBOOTED)}
RADIO_FAILSAFE = {"is_failsafe": True, "mode": "RTL"}
KEPT = {"is_failsafe": True}
"""A failsafe that leaves the mode as it is: of ArduPilot, for example BATT_FS_LOW_ACT 0."""
SIGNAL = EndRequest(because(Code.SIGNAL))
SWITCH_LOW = {"rc_channels_us": (1500,) * 6 + (1000, 1500)}
UNDRIVEN, NO_CHANNELS = {"rc_channels_us": (1500,) * 6 + (0, 1500)}, {"rc_channels_us": ()}
IN_LOITER: dict[str, Any] = {"mode": "LOITER", "is_armed": True, "is_echoed": True}
LANDS: dict[str, Any] = {"on_fault": "rtl", "then": "land"}
OFFBOARD = altered(AIRBORNE, mode="OFFBOARD", modes=PX4_MODES)
HAND = altered(AIRBORNE, mode="ALTCTL", modes=replace(PX4_MODES, is_silence_failsafe=False))
"""PX4 whose receiver takes over when our sticks end."""
SETPOINTS: dict[str, Any] = {
    "is_setpoint": True,
    "modes": ("OFFBOARD",),
    "on_fault": "land",
    "then": "rtl",
    "engage_channel": 7,
}


def waiting(facts: Any = AIRBORNE, **settings: Any) -> Stepped:
    stepped = Stepped(facts, **settings)
    stepped.step()
    return stepped


def arming(**settings: Any) -> Stepped:
    """By ``--arm``, still disarmed."""
    stepped = Stepped(ON_GROUND, arm=True, **LANDS, **settings)
    stepped.run(0.1, echo_confirmed=True)
    return stepped


def armed(**settings: Any) -> Stepped:
    """By ``--arm``; the policy is late."""
    stepped = arming(**settings)
    stepped.step(armed=True, chunk_problem=NO_IMAGE)
    return stepped


def asked() -> Stepped:
    """For ALT_HOLD, by an act in the air; the pilot has the sticks."""
    facts = altered(AIRBORNE, mode="LOITER", is_released=True)
    stepped = waiting(facts, mode="ALT_HOLD", engage_channel=7)
    stepped.step("engage")
    return stepped


def flowing() -> Stepped:
    """OFFBOARD was asked for, by an act in the air."""
    stepped = waiting(altered(OFFBOARD, mode="AUTO.LOITER", is_released=True), **SETPOINTS)
    stepped.step("engage")
    stepped.run(0.12)
    return stepped


def entering() -> Stepped:
    """OFFBOARD has come; the policy is late."""
    stepped = flowing()
    stepped.step(mode="OFFBOARD", chunk_problem=NO_IMAGE)
    return stepped


def leaving(facts: Any = NO_RECEIVER, **settings: Any) -> Stepped:
    stepped = flying(facts, **LANDS, **settings)
    stepped.step(chunk_fault=NO_CHUNK)
    return stepped


def holding(**settings: Any) -> Stepped:
    stepped = leaving(**settings)
    stepped.run(0.2, mode="RTL", chunk_fault=None)
    return stepped


def landing(stop: EndRequest | None) -> Stepped:
    """By the key, without a receiver; a stop has come since."""
    stepped = flying(NO_RECEIVER)
    stepped.step("release")
    stepped.run(0.2, mode="LAND")
    stepped.step(stop=stop)
    return stepped


def held_by_px4(mode: str) -> Stepped:
    """In this mode, after a fault without a receiver; ``on_fault`` has asked for it."""
    facts = altered(NO_RECEIVER, mode="ALTCTL", modes=PX4_MODES)
    stepped = flying(facts, on_fault="land" if mode == "AUTO.LAND" else "hold")
    stepped.run(1.5, chunk_fault=NO_CHUNK)
    stepped.run(1.5, mode=mode, chunk_fault=None)
    return stepped


def refused() -> Stepped:
    """BRAKE was asked for 10 ms ago and refused: now LAND is asked for."""
    stepped = flying(NO_RECEIVER)
    stepped.step(chunk_fault=NO_CHUNK)
    stepped.step(refused_mode="BRAKE", chunk_fault=None)
    return stepped


def releasing(facts: Any = AIRBORNE, **settings: Any) -> Stepped:
    stepped = flying(facts, **settings)
    stepped.step(mode="LOITER")
    return stepped


def released(**settings: Any) -> Stepped:
    stepped = releasing(**settings)
    stepped.step(is_released=True, mode="ALT_HOLD")
    return stepped


def after(start: Callable[[], Stepped], seconds: float, **changes: Any) -> Stepped:
    stepped = start()
    stepped.run(seconds, **changes)
    return stepped


class Case(NamedTuple):
    """What one step makes of a situation."""

    start: Callable[[], Stepped]
    changes: dict[str, Any]
    """What happens in the step: of the facts, an ``act``, or to ``stop``."""
    phase: Phase
    control: ControlSource | None = None
    mode: str | None = None
    why: Code | None = None
    """The last code of the reason for not flying."""
    refusal: Code | None = None
    """The last code of what is said."""


ACT, KEY = {"act": "engage"}, {"act": "release"}
in_offboard = partial(flying, OFFBOARD, **SETPOINTS)
in_guided = partial(
    flying,
    altered(AIRBORNE, mode="GUIDED_NOGPS"),
    is_setpoint=True,
    modes=("GUIDED_NOGPS",),
    **LANDS,
)
silent = {"heard_ns": 0}
# fmt: off
CASES = {
    # WAITING and RELEASED
    "somebody arms": Case(partial(waiting, ON_GROUND), {"armed": True}, WAITING),
    "found armed": Case(Stepped, {}, WAITING, why=Code.NOT_ENGAGED),
    "it says what it waits for": Case(waiting, {"problem": because(LOST), "chunk_problem":
        NO_IMAGE}, WAITING, why=LOST),
    "no image": Case(waiting, {"chunk_problem": NO_IMAGE}, WAITING, why=Code.NO_IMAGE),
    "end before a flight": Case(waiting, {"stop": SIGNAL}, ENDED),
    "end before --arm": Case(partial(Stepped, ON_GROUND, arm=True), {"stop": SIGNAL}, ENDED),
    "end after a flight": Case(released, {"stop": SIGNAL}, ENDED),
    "duration over after a takeover": Case(lambda: after(partial(released, duration_ns=NS_PER_S),
        0.97), {}, ENDED),
    "--arm waits for the link": Case(partial(waiting, altered(ON_GROUND,
        problem=because(LOST)), arm=True), {}, WAITING),
    "key while --arm waits": Case(partial(waiting, altered(ON_GROUND, problem=because(LOST)),
        arm=True), KEY, WAITING, refusal=Code.OPERATOR),
    "--arm was called off": Case(lambda: after(partial(waiting, altered(ON_GROUND,
        problem=because(LOST)), arm=True), 0.01, act="release"), {"problem": None}, WAITING),
    "--arm, a parameter refused": Case(partial(waiting, altered(ON_GROUND,
        problem=because(LOST)), arm=True), {"problem": because(Code.SET_REFUSED)}, ENDED),
    "a parameter refused, no --arm": Case(waiting, {"problem": because(Code.SET_REFUSED)},
        WAITING, why=Code.SET_REFUSED),
    "--arm": Case(partial(Stepped, ON_GROUND, arm=True), {}, PREPARING, IDLE,
        why=Code.WAITING_FOR_ARMING),
    "--arm counts once": Case(lambda: after(lambda: after(arming, 0.01, is_switched_off=True), 0.1,
        is_released=True), {"is_switched_off": False}, RELEASED, why=Code.OVERRIDE_SWITCH_OFF),
    "act": Case(waiting, ACT, FLYING, POLICY),
    "act after a takeover": Case(released, ACT, FLYING, POLICY),
    "act, the policy not reset": Case(waiting, {**ACT, "is_policy_reset": False}, PREPARING,
        why=Code.FIRST_CHUNK),
    "act, another mode wanted": Case(partial(waiting, altered(AIRBORNE, mode="LOITER"),
        mode="ALT_HOLD"), ACT, PREPARING, mode="ALT_HOLD"),
    "act in a step with the key": Case(partial(waiting, ON_GROUND, engage_on_arm=True), {**KEY,
        "armed": True}, WAITING),
    **{
        f"act refused: {code.value}": Case(waiting, {**ACT, **changes}, WAITING, refusal=code)
        for code, changes in (
            (Code.NOT_ARMED, {"armed": False}),
            (Code.WRONG_MODE, {"mode": "LOITER"}),
            (Code.NO_IMAGE, {"chunk_problem": NO_IMAGE}),
            (LOST, {"problem": because(LOST), "chunk_problem": NO_IMAGE}),
            (Code.FAILSAFE, {"is_failsafe": True, "envelope_problem": TILT}),
            (Code.BEYOND, {"envelope_problem": TILT, "chunk_problem": NO_IMAGE}),
        )
    },
    "act refused: the switch is low": Case(partial(waiting, altered(AIRBORNE, **SWITCH_LOW),
        engage_channel=7), {**ACT, "envelope_problem": TILT}, WAITING,
        refusal=Code.ENGAGE_SWITCH_OFF),
    "the switch is not seen": Case(partial(waiting, altered(AIRBORNE, **UNDRIVEN),
        engage_channel=7), {}, WAITING, why=Code.ENGAGE_SWITCH_UNSEEN),
    "act refused: the switch is not seen": Case(partial(waiting, altered(AIRBORNE, **NO_CHANNELS),
        engage_channel=7), ACT, WAITING, refusal=Code.ENGAGE_SWITCH_UNSEEN),
    "act refused after a takeover": Case(released, {**ACT, "chunk_problem": NO_IMAGE}, RELEASED,
        refusal=Code.NO_IMAGE),
    # PREPARING
    "key, not armed yet": Case(arming, KEY, RELEASING, RELEASE, why=Code.OPERATOR),
    "key, armed by us": Case(armed, KEY, LEAVING, NEUTRAL, "LAND", Code.OPERATOR),
    "death, armed by us": Case(armed, {"stop": DEATH}, LEAVING, NEUTRAL, "RTL", DEATH.reason.code),
    "key, the pilot has the sticks": Case(asked, KEY, RELEASED, why=Code.OPERATOR),
    "key, the vehicle shows ours": Case(asked, {**KEY, "is_released": False}, RELEASING, RELEASE,
        why=Code.OPERATOR),
    "key, in our OFFBOARD": Case(entering, KEY, LEAVING, NEUTRAL, "AUTO.RTL", Code.OPERATOR),
    "key, in our OFFBOARD for long": Case(lambda: after(flowing, 1.5, mode="OFFBOARD",
        is_policy_reset=False), KEY, LEAVING, NEUTRAL, "AUTO.RTL", Code.OPERATOR),
    "key, as our OFFBOARD comes": Case(flowing, {**KEY, "mode": "OFFBOARD"}, LEAVING, NEUTRAL,
        "AUTO.RTL", Code.OPERATOR),
    "key, in an OFFBOARD of another's": Case(lambda: after(partial(waiting, OFFBOARD, **SETPOINTS),
        0.01, act="engage", is_policy_reset=False), KEY, RELEASING, RELEASE, why=Code.OPERATOR),
    "another allowed mode on the way in": Case(lambda: after(waiting, 0.01, act="engage",
        is_policy_reset=False), {"mode": "ALTCTL"}, RELEASING, RELEASE, why=Code.MODE_CHANGED),
    "key, idle sticks not seen yet": Case(arming, {**KEY, "is_released": True}, RELEASING, RELEASE,
        why=Code.OPERATOR),
    "link lost on the way in": Case(asked, {"problem": because(LOST)}, PREPARING, why=LOST),
    "pilot's mode": Case(asked, {"mode": "STABILIZE"}, RELEASED, why=Code.MODE_CHANGED),
    "switch low after an act": Case(asked, SWITCH_LOW, RELEASED, why=Code.ENGAGE_SWITCH_OFF),
    "switch low with --arm": Case(partial(arming, engage_channel=7), SWITCH_LOW, PREPARING, IDLE),
    "another mode on the ground": Case(arming, {"mode": "LOITER"}, RELEASING, RELEASE,
        why=Code.MODE_CHANGED),
    "another mode before ours is there": Case(partial(waiting, altered(ON_GROUND, mode="STABILIZE"),
        arm=True), {"mode": "LOITER"}, PREPARING, IDLE),
    "another mode before ours is there, and armed in it": Case(lambda: after(partial(waiting,
        altered(ON_GROUND, mode="STABILIZE", chunk_problem=NO_IMAGE), arm=True), 1.0,
        mode="GUIDED"), {"armed": True}, RELEASING, RELEASE, why=Code.WRONG_MODE),
    "armed in our mode as it comes": Case(partial(waiting, altered(ON_GROUND, mode="STABILIZE",
        echo_confirmed=True), arm=True, mode="ALT_HOLD"), {"mode": "ALT_HOLD", "armed": True},
        FLYING, POLICY),
    "a hand on the ground on the way in, PX4": Case(lambda: after(partial(waiting, altered(OFFBOARD,
        mode="AUTO.LAND", is_landed=True, is_released=True), mode="ALTCTL"), 0.01, act="engage"),
        {"mode": "POSCTL"}, RELEASED, why=Code.MODE_CHANGED),
    "failsafe on the ground, then its mode in the air": Case(lambda: after(arming, 0.01,
        is_failsafe=True), {"armed": True, **RADIO_FAILSAFE}, RELEASING, RELEASE,
        why=Code.FAILSAFE),
    "failsafe on the ground": Case(arming, {"is_failsafe": True}, PREPARING, IDLE),
    "failsafe": Case(armed, RADIO_FAILSAFE, RELEASING, RELEASE, why=Code.FAILSAFE),
    "failsafe that keeps the mode": Case(armed, KEPT, LEAVING, NEUTRAL, "RTL", Code.FAILSAFE),
    "failsafe, the pilot has the sticks": Case(asked, KEPT, RELEASED, why=Code.FAILSAFE,
        refusal=Code.FAILSAFE),
    "disarmed": Case(armed, {"armed": False}, RELEASING, RELEASE, why=Code.DISARMED),
    "reboot": Case(armed, {**REBOOT, "armed": False}, RELEASING, RELEASE, why=Code.REBOOTED),
    "parameter, in our OFFBOARD": Case(entering, REBOOT, LEAVING, NEUTRAL, "AUTO.LAND",
        Code.REBOOTED),
    "no such mode": Case(partial(Stepped, ON_GROUND, arm=True, mode="ALTCTL"), {}, RELEASING,
        RELEASE, why=Code.NO_SUCH_MODE),
    "too slow": Case(arming, {"slowness": because(Code.HANGS, name="x", idle_s=1.0)}, RELEASING,
        RELEASE, why=Code.HANGS),
    "late, not armed": Case(lambda: after(arming, 89.91), {}, RELEASING, RELEASE,
        why=Code.NOT_READY),
    "not late yet": Case(lambda: after(arming, 89.9), {}, PREPARING, IDLE),
    "late, armed": Case(lambda: after(armed, 89.9), {}, LEAVING, NEUTRAL, "RTL", Code.NO_IMAGE),
    "late for a climb": Case(lambda: after(partial(arming, takeoff_m=10.0), 99.91), {}, RELEASING,
        RELEASE, why=Code.NOT_READY),
    "not late for a climb yet": Case(lambda: after(partial(arming, takeoff_m=10.0), 99.9), {},
        PREPARING, IDLE, "GUIDED"),
    "late, and the switch is not seen": Case(lambda: after(partial(arming, engage_channel=7), 89.91,
        **NO_CHANNELS), {}, RELEASING, RELEASE, why=Code.ENGAGE_SWITCH_UNSEEN),
    "late for an act": Case(lambda: after(asked, 3.0), {}, RELEASED, why=Code.NOT_READY,
        refusal=Code.NOT_READY),
    "late in our OFFBOARD": Case(lambda: after(entering, 2.87), {}, LEAVING, NEUTRAL, "AUTO.LAND",
        Code.NO_IMAGE, Code.NO_IMAGE),
    "no chunk since the reset": Case(lambda: after(lambda: after(waiting, 0.01, act="engage",
        is_policy_reset=False, is_released=True), 3.0, act=None), {}, RELEASED, why=Code.NO_CHUNK,
        refusal=Code.NO_CHUNK),
    "no fresh chunk after the reset": Case(lambda: after(waiting, 0.01, act="engage",
        is_policy_reset=False), {"is_policy_reset": True, "chunk_problem": NO_IMAGE}, PREPARING,
        why=Code.FIRST_CHUNK),
    "too slow since the reset": Case(lambda: after(waiting, 0.01, act="engage",
        is_policy_reset=False), {"act": None, "slowness": because(Code.TOO_SLOW)}, RELEASING,
        RELEASE, why=Code.TOO_SLOW, refusal=Code.TOO_SLOW),
    "no image since the reset": Case(lambda: after(lambda: after(waiting, 0.01, act="engage",
        is_policy_reset=False), 3.0, act=None), {"chunk_problem": NO_IMAGE}, RELEASING, RELEASE,
        why=Code.NO_IMAGE, refusal=Code.NO_IMAGE),
    "ready": Case(armed, {"chunk_problem": None}, FLYING, POLICY),
    "ready in our OFFBOARD": Case(entering, {"chunk_problem": None}, FLYING, POLICY),
    # FLYING
    **{
        f"takeover: {code.value}": Case(flying, changes, RELEASING, RELEASE, why=code)
        for code, changes in (
            (Code.REBOOTED, {**REBOOT, "overruled": OVERRULED}),
            (Code.OVERRULED, {"overruled": OVERRULED, "problem": GONE, "is_switched_off": True}),
            (Code.OVERRIDE_SWITCH_OFF, {"is_switched_off": True, "armed": False}),
            (Code.DISARMED, {"armed": False, "is_failsafe": True, "mode": "LOITER"}),
            (Code.FAILSAFE, RADIO_FAILSAFE),
            (
                Code.MODE_CHANGED,
                {"mode": "LOITER", "chunk_fault": NO_CHUNK, "envelope_problem": TILT},
            ),
        )
    },
    "takeover: switch low": Case(partial(flying, engage_channel=7), {**SWITCH_LOW, "armed": False},
        RELEASING, RELEASE, why=Code.ENGAGE_SWITCH_OFF),
    "takeover: a mode that was asked for before": Case(lambda: after(lambda: after(lambda: after(
        refused, 0.01, mode="LOITER"), 0.02, is_released=True, mode="ALT_HOLD"), 0.01,
        act="engage"), {"mode": "BRAKE"}, RELEASING, RELEASE, why=Code.MODE_CHANGED,
        refusal=Code.ENTERED_LATE),
    "setpoints, takeover that leaves the mode": Case(in_offboard, REBOOT, LEAVING, NEUTRAL,
        "AUTO.LAND", Code.REBOOTED),
    "setpoints, switch low": Case(in_offboard, SWITCH_LOW, LEAVING, NEUTRAL, "AUTO.LAND",
        Code.ENGAGE_SWITCH_OFF),
    **{
        f"setpoints, takeover: {code.value}": Case(
            in_offboard, changes, RELEASING, RELEASE, why=code
        )
        for code, changes in (
            (Code.MODE_CHANGED, {"mode": "AUTO.LOITER"}),
            (Code.DISARMED, {"armed": False}),
            (Code.FAILSAFE, {"is_failsafe": True}),
            (Code.OVERRULED, {"overruled": OVERRULED}),
        )
    },
    "setpoints, failsafe that keeps the mode": Case(in_guided, KEPT, LEAVING, NEUTRAL, "RTL",
        Code.FAILSAFE),
    "setpoints, takeover in it": Case(in_guided, {**KEPT, **REBOOT}, LEAVING, NEUTRAL, "RTL",
        Code.REBOOTED),
    "setpoints, failsafe that changes it": Case(in_guided, RADIO_FAILSAFE, RELEASING, RELEASE,
        why=Code.FAILSAFE),
    "setpoints, another mode of setpoints": Case(in_guided, {"mode": "GUIDED"}, RELEASING, RELEASE,
        why=Code.MODE_CHANGED),
    "setpoints in a mode of sticks": Case(partial(flying, altered(OFFBOARD, mode="POSCTL"),
        **{**SETPOINTS, "modes": ("POSCTL",)}), REBOOT, RELEASING, RELEASE),
    "sticks in a mode of setpoints": Case(partial(flying, altered(AIRBORNE, mode="GUIDED"),
        modes=("GUIDED",)), REBOOT, RELEASING, RELEASE),
    "key": Case(partial(flying, **LANDS), KEY, LEAVING, NEUTRAL, "LAND", Code.OPERATOR),
    "signal": Case(partial(flying, **LANDS), {"stop": SIGNAL, **KEY}, LEAVING, NEUTRAL,
        "LAND", Code.SIGNAL),
    "death": Case(partial(flying, **LANDS), {"stop": DEATH}, LEAVING, NEUTRAL, "RTL",
        DEATH.reason.code),
    "duration": Case(lambda: after(partial(flying, **LANDS, duration_ns=NS_PER_S), 0.99),
        {"landing": because(Code.LANDED)}, LEAVING, NEUTRAL, "LAND", Code.DURATION),
    "not the duration yet": Case(lambda: after(partial(flying, duration_ns=NS_PER_S), 0.98), {},
        FLYING, POLICY),
    "landed": Case(partial(flying, **LANDS), {"landing": because(Code.LANDED),
        "chunk_fault": NO_CHUNK}, LEAVING, NEUTRAL, "LAND", Code.LANDED),
    **{
        f"fault: {code.value}": Case(
            partial(flying, **LANDS), changes, LEAVING, NEUTRAL, "RTL", code
        )
        for code, changes in (
            (LOST, {"problem": because(LOST), "chunk_fault": NO_CHUNK}),
            (Code.NO_CHUNK, {"chunk_fault": NO_CHUNK, "envelope_problem": TILT}),
            (Code.BEYOND, {"envelope_problem": TILT}),
            (Code.FAILSAFE, KEPT),
        )
    },
    "switch not seen for 1 s": Case(lambda: after(partial(flying, **LANDS, engage_channel=7), 0.99,
        **UNDRIVEN), {}, FLYING, POLICY),
    "switch not seen for longer": Case(lambda: after(partial(flying, **LANDS, engage_channel=7),
        1.0, **UNDRIVEN), {}, LEAVING, NEUTRAL, "RTL", Code.ENGAGE_SWITCH_UNSEEN),
    "setpoints, switch not seen for longer": Case(lambda: after(in_offboard, 1.0, **NO_CHANNELS),
        {}, LEAVING, NEUTRAL, "AUTO.LAND", Code.ENGAGE_SWITCH_UNSEEN),
    "a stale chunk alone": Case(flying, {"chunk_problem": NO_IMAGE}, FLYING, POLICY),
    # LEAVING and HOLDING
    "act while leaving": Case(leaving, ACT, LEAVING, NEUTRAL, refusal=Code.STILL_ENDING),
    "key while leaving": Case(leaving, KEY, LEAVING, NEUTRAL, why=Code.NO_CHUNK),
    "signal while leaving": Case(leaving, {"stop": SIGNAL}, LEAVING, NEUTRAL, why=Code.NO_CHUNK),
    "switch low while leaving": Case(partial(leaving, IDLE_RECEIVER, engage_channel=7), SWITCH_LOW,
        LEAVING, NEUTRAL),
    "switch low while leaving, PX4": Case(partial(leaving, HAND, engage_channel=7), SWITCH_LOW,
        RELEASING, RELEASE, why=Code.ENGAGE_SWITCH_OFF),
    "switch low while leaving, PX4 without a hand": Case(partial(leaving, altered(HAND,
        modes=PX4_MODES), engage_channel=7), SWITCH_LOW, LEAVING, NEUTRAL, "AUTO.RTL"),
    "switch low while leaving by setpoints": Case(partial(leaving, altered(HAND, mode="OFFBOARD"),
        engage_channel=7, is_setpoint=True, modes=("OFFBOARD",)), SWITCH_LOW, LEAVING, NEUTRAL),
    "switch low before leaving, PX4": Case(lambda: after(lambda: after(partial(Stepped, altered(
        HAND, armed=False, **SWITCH_LOW), arm=True, engage_channel=7), 0.02), 0.01, act="release",
        armed=True), {}, LEAVING, NEUTRAL),
    "takeover while leaving": Case(leaving, {"mode": "LOITER"}, RELEASING, RELEASE,
        why=Code.MODE_CHANGED),
    "our mode while leaving": Case(leaving, {"mode": "RTL"}, LEAVING, NEUTRAL),
    "the mode before comes late": Case(lambda: after(refused, 1.48), {"mode": "BRAKE"}, LEAVING,
        NEUTRAL, "LAND"),
    "the mode before has come late": Case(lambda: after(refused, 2.0, mode="BRAKE"), {}, LEAVING,
        NEUTRAL),
    "the mode before comes too late to be ours": Case(lambda: after(refused, 1.49),
        {"mode": "BRAKE"}, RELEASING, RELEASE, why=Code.MODE_CHANGED),
    "the failsafe lasts while leaving": Case(lambda: after(leaving, 0.1, **KEPT), {"mode": "RTL"},
        HOLDING, NEUTRAL),
    "the mode before comes late in it": Case(lambda: after(refused, 1.48, **KEPT),
        {"mode": "BRAKE"}, LEAVING, NEUTRAL, "LAND"),
    "failsafe's mode while leaving": Case(leaving, {**KEPT, "mode": "LAND"}, RELEASING, RELEASE,
        why=Code.FAILSAFE),
    "30 s without a word": Case(lambda: after(leaving, 30.21, heard_ns=0), {}, RELEASING, RELEASE,
        why=Code.VEHICLE_LOST),
    "not 30 s yet": Case(lambda: after(leaving, 30.2, heard_ns=0), {}, LEAVING, NEUTRAL),
    "confirmed, a hand holds it": Case(lambda: after(partial(leaving, AIRBORNE), 0.04, mode="RTL"),
        {}, RELEASING, RELEASE),
    "neutral for 50 ms first": Case(lambda: after(partial(leaving, AIRBORNE), 0.03, mode="RTL"), {},
        LEAVING, NEUTRAL),
    "confirmed, no hand": Case(lambda: after(leaving, 0.04, mode="RTL"), {}, HOLDING, NEUTRAL),
    "not confirmed, no hand": Case(lambda: after(leaving, 2.99), {}, HOLDING, NEUTRAL, "RTL",
        refusal=Code.MODE_NOT_CONFIRMED),
    "not confirmed, setpoints": Case(lambda: after(partial(leaving, altered(AIRBORNE,
        mode="GUIDED"), is_setpoint=True, modes=("GUIDED",)), 2.99), {}, HOLDING, NEUTRAL, "RTL",
        refusal=Code.MODE_NOT_CONFIRMED),
    "confirmed late, setpoints": Case(lambda: after(partial(leaving, altered(AIRBORNE,
        mode="GUIDED"), is_setpoint=True, modes=("GUIDED",)), 5.0), {"mode": "RTL"}, RELEASING,
        RELEASE),
    "not confirmed, setpoints, PX4": Case(lambda: after(partial(leaving, OFFBOARD,
        is_setpoint=True, modes=("OFFBOARD",)), 2.99), {}, RELEASING, RELEASE,
        refusal=Code.MODE_NOT_CONFIRMED),
    "confirmed late, a hand holds it": Case(lambda: after(partial(leaving, IDLE_RECEIVER), 3.0),
        {"mode": "RTL"}, RELEASING, RELEASE),
    "30 s count from the way out": Case(lambda: after(lambda: after(lambda: after(partial(flying,
        NO_RECEIVER), 10.0, heard_ns=0), 0.01, chunk_fault=NO_CHUNK), 29.9), {}, LEAVING, NEUTRAL),
    "no mode wanted, a hand holds it": Case(lambda: after(lambda: after(flying, 0.01,
        chunk_fault=NO_CHUNK), 0.04), {}, RELEASING, RELEASE),
    "key and reboot while holding": Case(holding, {**KEY, **REBOOT}, RELEASING, RELEASE,
        why=Code.REBOOTED),
    "act while holding": Case(holding, ACT, HOLDING, NEUTRAL, refusal=Code.STILL_ENDING),
    "key while holding": Case(holding, KEY, LEAVING, NEUTRAL, "LAND", Code.OPERATOR),
    "first stop while holding": Case(holding, {"stop": SIGNAL}, LEAVING, NEUTRAL, "LAND",
        Code.SIGNAL),
    "death while it lands": Case(partial(landing, DEATH), {}, HOLDING, NEUTRAL, why=Code.OPERATOR),
    "key after a death while it lands": Case(partial(landing, DEATH), KEY, LEAVING, NEUTRAL,
        why=Code.OPERATOR),
    "signal while it lands": Case(partial(landing, None), {"stop": SIGNAL}, LEAVING, NEUTRAL,
        why=Code.SIGNAL),
    "death while it hovers after a stop": Case(lambda: after(lambda: after(partial(flying,
        NO_RECEIVER, then="hold", on_fault="land"), 0.01, act="release"), 0.2, mode="BRAKE",
        act=None), {"stop": DEATH}, LEAVING, NEUTRAL, "LAND", DEATH.reason.code),
    "second stop while holding": Case(lambda: after(lambda: after(partial(flying, NO_RECEIVER),
        0.01, stop=DEATH), 0.2, mode="BRAKE"), {"stop": SIGNAL}, HOLDING, NEUTRAL,
        why=DEATH.reason.code),
    "signal after the duration": Case(lambda: after(lambda: after(partial(flying, NO_RECEIVER,
        duration_ns=NS_PER_S), 1.0), 0.2, mode="LAND"), {"stop": SIGNAL}, HOLDING, NEUTRAL,
        why=Code.DURATION),
    "takeover while holding": Case(holding, {"mode": "ALT_HOLD"}, RELEASING, RELEASE,
        why=Code.MODE_CHANGED),
    "the failsafe lasts while holding": Case(lambda: after(holding, 9.0, **KEPT), {}, HOLDING,
        NEUTRAL),
    "the pilot's mode after a failsafe that kept ours": Case(lambda: after(lambda: after(partial(
        flying, **LANDS), 0.01, **KEPT), 0.04, mode="RTL"), {"mode": "LOITER"}, RELEASING, RELEASE,
        why=Code.MODE_CHANGED),
    "failsafe's mode while holding": Case(holding, {**KEPT, "mode": "LAND"}, RELEASING, RELEASE,
        why=Code.FAILSAFE),
    "landed while holding": Case(partial(held_by_px4, "AUTO.LAND"), {"mode": "ALTCTL",
        "is_landed": True}, RELEASING, RELEASE, why=Code.LANDED),
    "a hand after the landing, ArduPilot": Case(holding, {"mode": "LOITER", "is_landed": True},
        RELEASING, RELEASE, why=Code.MODE_CHANGED),
    "a hand before the landing, PX4": Case(partial(held_by_px4, "AUTO.LAND"), {"mode": "ALTCTL"},
        RELEASING, RELEASE, why=Code.MODE_CHANGED),
    "a hand on the ground, PX4": Case(partial(held_by_px4, "AUTO.LOITER"), {"mode": "ALTCTL",
        "is_landed": True}, RELEASING, RELEASE, why=Code.MODE_CHANGED),
    "disarmed while holding": Case(holding, {"armed": False}, RELEASING, RELEASE,
        why=Code.DISARMED),
    "held where a throttle at rest would end the mode, PX4": Case(lambda: after(partial(leaving,
        altered(HAND, pilot_sticks=IDLE_RECEIVER.status.pilot_sticks)), 0.2, mode="AUTO.RTL"), {},
        HOLDING, NEUTRAL),
    "held for long": Case(lambda: after(holding, 60.0), {}, HOLDING, NEUTRAL),
    "held, and not heard": Case(lambda: after(holding, 30.01, heard_ns=0), {}, RELEASING, RELEASE,
        why=Code.VEHICLE_LOST),
    # RELEASING
    "act while releasing": Case(releasing, ACT, RELEASING, RELEASE, refusal=Code.STILL_ENDING),
    "our mode comes while releasing": Case(lambda: after(asked, 0.02, act="release",
        is_released=False), {"mode": "ALT_HOLD"}, RELEASING, RELEASE, refusal=Code.ENTERED_LATE),
    "a failsafe's mode that we asked for comes while releasing": Case(lambda: after(asked, 0.02,
        act="release", is_released=False), {"mode": "ALT_HOLD", "is_failsafe": True}, RELEASING,
        RELEASE),
    "our mode comes after the release": Case(lambda: after(asked, 0.02, act="release"),
        {"mode": "ALT_HOLD"}, RELEASED, refusal=Code.ENTERED_LATE),
    "stop while releasing": Case(releasing, {"stop": SIGNAL}, RELEASING, RELEASE),
    "release seen": Case(releasing, {"is_released": True}, RELEASED, why=Code.MODE_CHANGED),
    "released although nothing was held": Case(flying, {**REBOOT, "is_released": True}, RELEASING,
        RELEASE),
    "release not seen": Case(lambda: after(releasing, 0.99), {}, RELEASED,
        refusal=Code.RELEASE_NOT_SEEN),
    "release after the way out not seen yet": Case(lambda: after(lambda: after(lambda: after(flying,
        2.0), 0.01, chunk_fault=NO_CHUNK), 0.5), {}, RELEASING, RELEASE),
    "the pilot's BRAKE soon after ours": Case(lambda: after(lambda: after(refused, 0.01,
        mode="BRAKE"), 0.01, mode="LOITER"), {"mode": "BRAKE"}, RELEASING, RELEASE),
    "release not seen yet": Case(lambda: after(releasing, 0.98), {}, RELEASING, RELEASE),
    "release perhaps not heard": Case(lambda: after(releasing, 29.99, shows_last=False), {},
        RELEASED, refusal=Code.RELEASE_NOT_SEEN),
    "release perhaps not heard yet": Case(lambda: after(releasing, 29.98, shows_last=False), {},
        RELEASING, RELEASE),
    "release without a receiver": Case(lambda: after(partial(releasing, NO_RECEIVER), 3.99,
        shows_last=False), {}, RELEASED, refusal=Code.RELEASE_NOT_SEEN),
    "release without a receiver goes on": Case(lambda: after(partial(releasing, NO_RECEIVER), 3.98,
        shows_last=False), {}, RELEASING, RELEASE),
    "release of a lost vehicle": Case(lambda: after(leaving, 31.21, heard_ns=0, shows_last=False),
        {}, RELEASED, refusal=Code.RELEASE_NOT_SEEN),
    "release of a lost vehicle goes on": Case(lambda: after(leaving, 31.2, heard_ns=0,
        shows_last=False), {}, RELEASING, RELEASE),
    "ended": Case(lambda: after(waiting, 0.01, stop=SIGNAL), {**ACT, "mode": "LOITER"}, ENDED),
}
# fmt: on


def take(case: Case) -> tuple[Stepped, EngagementOutput]:
    stepped = case.start()
    stepped.engagement.refusal = None
    before, actions = stepped.phase, stepped.step(**case.changes)
    assert before is not FLYING or Code.THEN not in stepped.codes, "at once"
    return stepped, actions


@pytest.mark.parametrize("name", CASES)
def test_rows(name: str) -> None:
    case = CASES[name]
    stepped, actions = take(case)
    assert (stepped.phase, actions.control, actions.mode) == (case.phase, case.control, case.mode)
    if case.why is not None:
        assert stepped.codes[-1:] == (case.why,)
    assert codes(stepped.engagement.refusal)[-1:] == (
        () if case.refusal is None else (case.refusal,)
    )
    assert (stepped.engagement.reason is None) == (case.phase is FLYING)


def test_a_vehicle_that_disarms_itself_for_want_of_images_does_not_hide_that() -> None:
    stepped = after(armed, 9.0, chunk_problem=NO_CHUNK)
    stepped.step(armed=False)
    disarmed = because(Code.DISARMED)
    assert stepped.engagement.reason == because(Code.THEN, first=NO_CHUNK, then=disarmed)
    stepped = after(armed, 9.0, chunk_problem=NO_CHUNK)
    stepped.step(mode="LOITER")
    assert stepped.codes == (Code.MODE_CHANGED,)


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("act while leaving", not_engaged(because(Code.STILL_ENDING, phase="leaving"))),
        ("act refused: failsafe", not_engaged(because(Code.FAILSAFE, mode="ALT_HOLD"))),
        (
            "act refused: wrong_mode",
            not_engaged(because(Code.WRONG_MODE, mode="LOITER", allowed="ALT_HOLD or ALTCTL")),
        ),
        (
            "no chunk since the reset",
            not_engaged(because(Code.NO_CHUNK_SINCE_RESET, why=NO_CHUNK)),
        ),
        (
            "late for an act",
            not_engaged(because(Code.NOT_READY, after_s=3, **IN_LOITER, inputs="fine")),
        ),
        ("our mode comes after the release", because(Code.ENTERED_LATE, mode="ALT_HOLD")),
        (
            "another mode before ours is there, and armed in it",
            because(Code.WRONG_MODE, mode="GUIDED", allowed="ALT_HOLD or ALTCTL"),
        ),
        ("takeover: failsafe", because(Code.FAILSAFE, mode="RTL")),
        ("takeover: switch low", because(Code.ENGAGE_SWITCH_OFF, channel=7)),
        ("takeover: mode_changed", because(Code.MODE_CHANGED, before="ALT_HOLD", after="LOITER")),
        ("switch not seen for longer", because(Code.ENGAGE_SWITCH_UNSEEN, channel=7, limit_s=1.0)),
    ],
)
def test_the_figures_of_what_is_told(name: str, told: Reason) -> None:
    engagement = take(CASES[name])[0].engagement
    assert (engagement.refusal or engagement.reason) == told


def test_every_row_has_a_case(monkeypatch: pytest.MonkeyPatch) -> None:
    taken: set[tuple[Transition, Phase]] = set()

    def noting(row: Transition) -> Transition:
        def does(memory: Any, now: Any, cause: Any) -> None:
            taken.add((row, memory.phase))
            row.does(memory, now, cause)

        return row._replace(does=does)

    for name, rows in (("TABLE", TABLE), ("PROGRESS", PROGRESS)):
        monkeypatch.setattr(engagement, name, tuple(noting(row) for row in rows))
    for case in CASES.values():
        take(case)
    missing = {(row, phase) for row in (*TABLE, *PROGRESS) for phase in row.states} - taken
    assert not {(row.event.__name__, phase) for row, phase in missing}


def test_the_page_for_pilots_shows_this_table() -> None:
    page = PAGE.read_text()
    assert with_table(page) == page, "run: python -m benchmarks.safety_table"
