"""Recorded doublets of vehicles whose response is known."""

import json
import math
from collections.abc import Callable
from dataclasses import replace
from io import StringIO

import numpy as np
import pytest
from rich.console import Console

from helpers.factories import make_released_tick, make_state, make_tick, make_trace
from mavbridge.commands.identify.analysis import (
    CHANNELS,
    Identification,
    Side,
    identify_pushes,
    trained_motion,
)
from mavbridge.commands.identify.fit import MAX_ROWS, ResponseRecording
from mavbridge.commands.identify.run import print_identification, to_json, verdicts
from mavbridge.core.clock import NS_PER_MS, NS_PER_S
from mavbridge.core.vehicle import ACTION_CLASSES
from policy.contract import ActionKind, Contract
from policy.scripted.programs import doublet_length_s, doublet_steps

START_S = 100.0
STEP_S = 0.01
LAG_S, DEAD_STEPS = 0.15, 8
MARGIN_S = 1.0

Curve = Callable[[str, float], float]
"""(axis, action in the unit of its channel) -> motion in the unit of its signal."""


def usual_sticks(axis: str, stick: float) -> float:
    """ArduCopter's defaults, written down once more."""
    full, dead = {"yaw": (202.5, 0.04), "climb": (2.5, 0.2)}.get(axis, (30.0, 0.04))
    return math.copysign(full * max(0.0, abs(stick) - dead) / (1 - dead), stick)


def recorded(
    kind: ActionKind = "sticks",
    curve: Curve = usual_sticks,
    *,
    hover: float = 0.0,
    is_flown: Callable[[float], bool] = lambda _: True,
) -> ResponseRecording:
    """A doublet of this kind, flown by a vehicle of first order with a dead time."""
    recording = ResponseRecording()
    amounts = {"sticks": 1.0, "attitude": 20.0, "rates": 40.0, "velocity": 2.0}
    channels = {channel.axis: channel for channel in CHANNELS[kind]}
    motions = dict.fromkeys(channels, 0.0)
    waiting: dict[str, list[float]] = {axis: [0.0] * DEAD_STEPS for axis in channels}
    for index in range(round((doublet_length_s(kind) + 2 * MARGIN_S) / STEP_S)):
        time_s = index * STEP_S - MARGIN_S
        at_ns = round((START_S + time_s) * NS_PER_S)
        state = _state(motions, kind, at_ns)
        pushes = [push for step in doublet_steps(kind) if (push := step.push_at(time_s))]
        action = [0.0] * 4
        if kind in ("attitude", "rates"):
            action[0] = hover
        for axis, channel in channels.items():
            amount = sum(push.share for push in pushes if push.axis == axis) * amounts[kind]
            action[channel.column] = amount / channel.scale
            waiting[axis].append(amount)
            wanted = curve(axis, waiting[axis].pop(0))
            motions[axis] += (wanted - motions[axis]) * STEP_S / LAG_S
        trace = make_trace(ACTION_CLASSES[kind](*action))  # type: ignore[arg-type]
        tick = make_tick(index, trace=trace, sent_ns=at_ns, state=state)
        recording.emit(tick if is_flown(time_s) else make_released_tick(index))
    return recording


def _state(motions: dict[str, float], kind: str, at_ns: int) -> object:
    values = np.array([0, 0, 0, 1, 0, 0, 0, 0, 0, 0, 0, 0, -9.81], np.float32)
    roll, pitch = math.radians(motions["roll"]), -math.radians(motions["pitch"])
    values[9] = math.radians(motions["yaw"])
    values[2] = -motions.get("climb", 0.0)
    if kind == "velocity":
        values[0], values[1] = motions["pitch"], motions["roll"]
    elif kind == "rates":
        values[7], values[8] = roll, pitch
    else:  # never both at once
        values[3] = math.cos((abs(roll) + abs(pitch)) / 2)
        values[4], values[5] = math.sin(roll / 2), math.sin(pitch / 2)
    return make_state(at_ns, values=values)


def identified(
    recording: ResponseRecording, contract: Contract | None = None
) -> tuple[Identification, Contract]:
    contract = contract or Contract()
    found = identify_pushes(recording, contract=contract, program_start_s=START_S)
    return found, contract


@pytest.fixture(scope="module")
def usual() -> Identification:
    return identified(recorded())[0]


def test_a_vehicle_as_in_training_has_every_ratio_at_one(usual: Identification) -> None:
    assert usual.missing == ()
    assert [push.axis for push in usual.pushes] == [step.axis for step in doublet_steps("sticks")]
    for push in usual.pushes:
        assert push.up.ratio == pytest.approx(1.0, abs=0.02), push
        assert push.down.ratio == pytest.approx(1.0, abs=0.02), push
        assert push.dead_time_s == pytest.approx(DEAD_STEPS * STEP_S, abs=0.02), push
        assert push.time_63_s == pytest.approx(DEAD_STEPS * STEP_S + LAG_S, abs=0.02), push
    lines = list(verdicts(usual, Contract()))
    assert lines[0] == (
        "roll: as the policy was trained with; full stick 29.9 of 30.0 deg, dead zone 4%"
    )
    assert any(line.startswith("descent: as the policy was trained with") for line in lines)
    assert lines[1].endswith("of them dead; the bundled simulator's 160 ms are about the same")


def test_other_gains_are_said_in_words() -> None:
    def other(axis: str, stick: float) -> float:
        """Yaw with PX4's dead zone and expo; a descent at half of the climb; 35 deg of lean."""
        if axis == "yaw":
            beyond = max(0.0, abs(stick) - 0.1) / 0.9
            return math.copysign(144 * (0.4 * beyond + 0.6 * beyond**3), stick)
        factor = 0.5 if axis == "climb" and stick < 0 else 35 / 30
        return factor * usual_sticks(axis, stick)

    found, contract = identified(recorded(curve=other))
    lines = list(verdicts(found, contract))
    assert "roll: 1.2 times what the policy was trained with; full stick 34.9 of 30.0" in lines[0]
    yaw = next(line for line in lines if line.startswith("yaw"))
    assert yaw == (
        "yaw: 0.7 times what the policy was trained with (at 50% 0.3 times); "
        "full stick 144.0 of 202.5 deg/s"  # a curve has no dead zone that a line could tell
    )
    assert any("descent: 0.5 times" in line for line in lines)
    assert any("climb: 1.2 times" in line for line in lines)


@pytest.mark.parametrize("kind", ["attitude", "rates", "velocity"])
def test_setpoints_are_compared_with_what_was_commanded(kind: ActionKind) -> None:
    recording = recorded(kind, lambda axis, amount: 0.8 * amount, hover=0.45)
    found, contract = identified(recording, Contract(action=kind, hover_thrust=0.39))
    assert len(found.pushes) == (8 if kind == "velocity" else 6)
    for push in found.pushes:
        assert push.up.ratio == pytest.approx(0.8, abs=0.02), push
        assert push.down.ratio == pytest.approx(0.8, abs=0.02), push
    lines = list(verdicts(found, contract))
    assert lines[0] == "roll: 0.8 times what was commanded"
    is_thrust = kind != "velocity"
    assert (found.hover_thrust == pytest.approx(0.45)) if is_thrust else found.hover_thrust is None
    said = "thrust: hovers at 0.450, 1.2 times what the policy was trained with"
    assert (said in lines) is is_thrust


def test_what_the_policy_did_not_fly_is_missing_with_its_reason() -> None:
    yaw = next(step for step in doublet_steps("sticks") if step.axis == "yaw")
    recording = recorded(is_flown=lambda time_s: time_s < yaw.begin_s + 1.0)
    found, contract = identified(recording)
    assert {push.axis for push in found.pushes} == {"roll", "pitch"}
    assert found.missing[0] == "yaw at 50%: the policy did not fly all of it"
    assert len(found.missing) == 4
    console = Console(file=StringIO(), width=120)
    print_identification(found, contract, console)
    text = console.file.getvalue()  # type: ignore[attr-defined]
    assert "not measured: climb at 100%" in text
    assert "+8.1" in text


def test_a_vehicle_that_does_not_follow_is_not_measured() -> None:
    def deaf(axis: str, stick: float) -> float:
        return 0.0 if axis == "yaw" else usual_sticks(axis, stick)

    found, _ = identified(recorded(curve=deaf))
    assert "yaw at 100%: the motion does not follow the action" in found.missing


def test_json_holds_every_figure(usual: Identification) -> None:
    document = json.loads(to_json(usual, Contract(), policy="toge", is_mapped=False))
    assert len(document["pushes"]) == 8
    first = document["pushes"][0]
    assert first["up"]["reached"] == pytest.approx(8.1, abs=0.2)
    assert first["ratio_up"] == pytest.approx(1.0, abs=0.02)
    assert document["verdicts"][0].startswith("roll: ")
    assert (document["policy"], document["action"], document["hover_thrust"]) == (
        *("toge", "sticks"),
        None,
    )


def test_what_a_policy_expects_follows_from_its_contract() -> None:
    contract = Contract(full_lean_deg=20.0, full_climb_mps=3.0, full_descent_mps=1.0)
    assert trained_motion(contract, "roll", 1.0) == 20.0
    assert trained_motion(contract, "roll", -0.52) == pytest.approx(-10.0)
    assert trained_motion(contract, "climb", 0.6) == pytest.approx(1.5)
    assert trained_motion(contract, "climb", -1.0) == -1.0
    assert trained_motion(contract, "yaw", 0.03) == 0.0
    assert trained_motion(replace(contract, action="rates", modes=()), "roll", 7.0) == 7.0
    assert Side(amount=0.1, reached=1.0, trained=0.0).ratio == math.inf


def test_the_recording_is_bounded_and_keeps_each_state_once() -> None:
    recording = ResponseRecording()
    state = make_state()
    for index in range(MAX_ROWS + 10):
        recording.emit(make_tick(0, sent_ns=index * NS_PER_MS, state=state))
    times, _ = recording.inputs(0)
    assert len(times) == MAX_ROWS
    assert times[-1] == pytest.approx((MAX_ROWS + 9) / 1000)
    assert len(recording.outputs(lambda _: 0.0, lambda s: s.attitude_ns)[0]) == 1
