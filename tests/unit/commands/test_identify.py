"""Recorded doublets of vehicles whose response is known."""

import json
import math
from collections.abc import Callable
from io import StringIO
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from rich.console import Console

from helpers.factories import make_released_tick, make_state, make_tick, make_trace
from helpers.fakes import FakeClock
from mavbridge.commands.config import IdentifyConfig
from mavbridge.commands.identify import (
    Identification,
    ResponseRecording,
    doublet_flight,
    doublet_policy,
    identify,
    identify_pushes,
    print_identification,
)
from mavbridge.config.flight import FlyConfig, LinkConfig
from mavbridge.config.policy import PolicyConfig
from mavbridge.core.clock import NS_PER_S
from mavbridge.core.errors import ExitCode, PeerError
from mavbridge.core.vehicle import ACTION_CLASSES
from policy.contract import ActionKind, Contract
from policy.motion.controllers import doublet_length_s, doublet_steps

IDENTIFY = "mavbridge.commands.identify"
START_S = 100.0
STEP_S = 0.01
LAG_S, DEAD_STEPS = 0.15, 8
MARGIN_S = 1.0

DEG = math.degrees(1.0)
TURNS = {"roll": (1, DEG), "pitch": (2, -DEG), "yaw": (3, DEG)}
ACTIONS: dict[ActionKind, dict[str, tuple[int, float]]] = {
    "sticks": {"roll": (3, 1.0), "pitch": (2, 1.0), "yaw": (1, 1.0), "climb": (0, 1.0)},
    "attitude": TURNS,
    "rates": TURNS,
    "velocity": {"roll": (1, 1.0), "pitch": (0, 1.0), "yaw": (3, DEG), "climb": (2, -1.0)},
}
"""Number of an action that moves each axis, and the factor from it to the unit of a curve."""
Curve = Callable[[str, float], float]
"""(axis, share of full stick, or motion in deg and m/s) -> motion in deg and m/s."""


def usual_sticks(axis: str, stick: float) -> float:
    """ArduCopter's defaults, written down once more."""
    full, dead = {"yaw": (202.5, 0.04), "climb": (2.5, 0.2)}.get(axis, (30.0, 0.04))
    return math.copysign(full * max(0.0, abs(stick) - dead) / (1 - dead), stick)


def recorded(
    kind: ActionKind = "sticks",
    curve: Curve = usual_sticks,
    *,
    hover: float = 0.0,
    lag_s: float = LAG_S,
    noise: float = 0.0,
    is_flown: Callable[[float], bool] = lambda _: True,
) -> ResponseRecording:
    """A doublet of this kind, flown by a vehicle of first order with a dead time, in gusts where
    there is ``noise``, a share of the full amount."""
    random = np.random.default_rng(0)
    recording = ResponseRecording()
    amounts = {"sticks": 1.0, "attitude": 20.0, "rates": 40.0, "velocity": 2.0}
    motions = dict.fromkeys(ACTIONS[kind], 0.0)
    waiting: dict[str, list[float]] = {axis: [0.0] * DEAD_STEPS for axis in motions}
    for index in range(round((doublet_length_s(kind) + 2 * MARGIN_S) / STEP_S)):
        time_s = index * STEP_S - MARGIN_S
        at_ns = round((START_S + time_s) * NS_PER_S)
        is_gust = noise > 0.0 and time_s % 7.0 < 0.1
        blown = noise * amounts[kind] * (random.normal() + 10.0 * is_gust)
        state = _state({axis: value + blown for axis, value in motions.items()}, kind, at_ns)
        pushes = [push for step in doublet_steps(kind) if (push := step.push_at(time_s))]
        action = [0.0] * 4
        if kind in ("attitude", "rates"):
            action[0] = hover
        for axis, (column, scale) in ACTIONS[kind].items():
            amount = sum(push.share for push in pushes if push.axis == axis) * amounts[kind]
            action[column] = amount / scale
            waiting[axis].append(amount)
            wanted = curve(axis, waiting[axis].pop(0))
            motions[axis] += (wanted - motions[axis]) / lag_s * STEP_S
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


def identified(recording: ResponseRecording, contract: Contract | None = None) -> Identification:
    return identify_pushes(recording, contract=contract or Contract(), program_start_s=START_S)


@pytest.mark.parametrize("kind", ["attitude", "rates", "velocity"])
def test_setpoints_are_compared_with_what_was_commanded(kind: ActionKind) -> None:
    recording = recorded(kind, lambda axis, amount: 0.8 * amount, hover=0.45)
    found = identified(recording, Contract(action=kind, hover_thrust=0.39))
    assert len(found.pushes) == (4 if kind == "velocity" else 3)
    for push in found.pushes:
        assert push.ratio == pytest.approx((0.8, 0.8), abs=0.02), push
    console = Console(file=StringIO(), width=120)
    print_identification(found, Contract(action=kind), console)
    told = (
        "hovers at a policy's thrust of 0.450, which is scaled for the vehicle; trained with 0.390"
    )
    assert (told in console.file.getvalue()) == (kind != "velocity")  # type: ignore[attr-defined]
    if kind != "velocity":
        assert found.policy_hover_thrust == pytest.approx(0.45)
    else:
        assert found.policy_hover_thrust is None


@pytest.mark.parametrize(("lag_s", "noise"), [(0.15, 0.02), (0.7, 0.0)])
def test_each_side_has_its_gain_in_gusts_too_and_if_it_settles_late(
    lag_s: float, noise: float
) -> None:
    recording = recorded(
        "velocity",
        lambda axis, amount: amount * (1.0 if amount > 0.0 else 0.7),
        lag_s=lag_s,
        noise=noise,
    )
    found = identified(recording, Contract(action="velocity"))
    assert len(found.pushes) == 4
    for push in found.pushes:
        assert push.ratio == pytest.approx((1.0, 0.7), abs=0.05), push
        assert push.time_63_s == pytest.approx(DEAD_STEPS * STEP_S + lag_s, abs=0.04), push


def test_what_could_not_be_measured_is_told_beside_every_figure() -> None:
    def deaf(axis: str, stick: float) -> float:
        return 0.0 if axis == "yaw" else usual_sticks(axis, stick)

    climb = next(step for step in doublet_steps("sticks") if step.axis == "climb")
    recording = recorded(curve=deaf, is_flown=lambda time_s: time_s < climb.begin_s + 1.0)
    found = identified(recording)
    reasons = ("the motion does not follow the action", "the policy did not fly all of it")
    assert found.missing == (f"yaw: {reasons[0]}", f"climb: {reasons[1]}")
    console = Console(file=StringIO(), width=120)
    print_identification(found, Contract(), console)
    text = console.file.getvalue()  # type: ignore[attr-defined]
    assert "not measured: climb" in text
    assert "+17.5" in text
    assert [push.axis for push in found.pushes] == ["roll", "pitch"]
    assert found.pushes[0].measured[0] == pytest.approx(17.5, abs=0.2)
    assert found.pushes[0].ratio == pytest.approx((1.0, 1.0), abs=0.02)


# --- the flight


def test_the_flight_is_the_users_with_the_doublet_in_place_of_the_policy() -> None:
    link = LinkConfig(connect="udp:127.0.0.1:1")
    asked = FlyConfig(link=link, arm=True, takeoff=10.0, policy=PolicyConfig(policy="toge"))
    flight = doublet_flight(IdentifyConfig(flight=asked), Contract(action="velocity"))
    assert flight.policy.policy == "scripted:doublet:velocity"
    assert flight.camera.sources == ("none",)
    assert flight.link.raw_sticks
    assert flight.takeoff == 10.0
    assert flight.duration > doublet_length_s("velocity") + 8.0


def test_the_doublet_means_by_its_sticks_what_the_policy_means() -> None:
    trained = Contract(full_lean_deg=20.0, yaw_dead_zone=0.1, image_height=96, image_width=96)
    policy, runner = doublet_policy(trained, FakeClock(), is_in_air=True)
    assert runner.contract.full_lean_deg == 20.0
    assert runner.contract.yaw_dead_zone == 0.1
    assert runner.dual_rate
    assert policy.program_start_s is None


@pytest.mark.parametrize("begins", [True, False])
def test_the_exit_status_is_that_of_the_flight_whatever_was_measured(
    begins: bool, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    flown = recorded("sticks", usual_sticks)

    def crash(*_args: object, sinks: tuple[object, ...], **_kwargs: object) -> int:
        vars(sinks[0]).update(vars(flown))
        return ExitCode.CRASHED

    _, runner = doublet_policy(Contract(), FakeClock(), is_in_air=True)
    policy = SimpleNamespace(program_start_s=START_S if begins else None)
    monkeypatch.setattr(IDENTIFY + ".doublet_policy", lambda *_args, **_kwargs: (policy, runner))
    monkeypatch.setattr(IDENTIFY + ".fly_policy", crash)
    asked = FlyConfig(link=LinkConfig(connect="udp:127.0.0.1:1"))
    if begins:
        written = tmp_path / "figures.json"
        assert identify(IdentifyConfig(flight=asked, json=written)) == ExitCode.CRASHED
        document = json.loads(written.read_text())
        assert (document["policy"], document["action"]) == ("toge", "sticks")
        assert [push["axis"] for push in document["pushes"]] == ["roll", "pitch", "yaw", "climb"]
        assert (document["policy_hover_thrust"], document["missing"]) == (None, [])
    else:
        with pytest.raises(PeerError, match="ended before the doublet") as told:
            identify(IdentifyConfig(flight=asked))
        assert told.value.exit_code == ExitCode.CRASHED
