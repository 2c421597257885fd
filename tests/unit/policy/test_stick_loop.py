"""Sticks flown by thrust and body rates: what they mean, and that they can be read back."""

import math
from dataclasses import replace

import numpy as np
import pytest

from policy.contract import QUATERNION, SPECIFIC_FORCE, VELOCITY, Contract, FloatArray
from policy.errors import ContractError
from policy.motion.rotation import conjugate, multiply, rotate
from policy.motion.stick_loop import (
    GRAVITY_MPS2,
    MAX_TILT_RATE_RADPS,
    THRUST_GAINS,
    StickLoop,
    ThrustGain,
    by_rates,
    flown_by_rates,
    rates_contract,
)
from policy.protocol import PolicyRunner

CONTRACT = rates_contract(Contract(hover_thrust=0.5))
STICKS = by_rates(Contract(hover_thrust=0.5))
"""Of a policy by sticks: with ArduPilot's dead zones."""


def state(
    lean_deg: float = 0.0, *, towards_deg: float = 0.0, heading_deg: float = 0.0, climb: float = 0.0
) -> FloatArray:
    """[1, 13]: leaning to a side of the nose, without rates."""
    half, side = math.radians(lean_deg) / 2, math.radians(towards_deg)
    turn = math.radians(heading_deg) / 2
    # Towards the nose is nose down: a turn about minus the y axis.
    lean = (math.cos(half), math.sin(half) * math.sin(side), -math.sin(half) * math.cos(side), 0.0)
    attitude = multiply((math.cos(turn), 0.0, 0.0, math.sin(turn)), lean)
    return np.array([[0.0, 0.0, -climb, *attitude, *[0.0] * 6]], np.float32)


def first_rates(loop: StickLoop, sticks: tuple[float, ...], at: FloatArray) -> list[float]:
    chunk = np.tile(np.array(sticks, np.float32), (1, 16, 1))
    return loop.to_rates(chunk, at)[0, 0].tolist()


@pytest.mark.parametrize(
    ("sticks", "axis", "sign"),
    [
        ((0.5, 0.0, 0.0, 0.0), 0, 1),  # throttle up: more thrust
        ((-0.5, 0.0, 0.0, 0.0), 0, -1),
        ((0.0, 0.5, 0.0, 0.0), 3, 1),  # nose right
        ((0.0, 0.0, 0.5, 0.0), 2, -1),  # stick forward: nose down
        ((0.0, 0.0, 0.0, 0.5), 1, 1),  # right: roll right
    ],
)
@pytest.mark.parametrize("heading_deg", [0.0, 130.0])
def test_each_stick_moves_its_own_axis(sticks, axis, sign, heading_deg):
    still = np.array([0.5, 0.0, 0.0, 0.0])
    rates = np.array(first_rates(StickLoop(CONTRACT), sticks, state(heading_deg=heading_deg)))
    change = rates - still
    assert sign * change[axis] > 0.1
    assert np.abs(np.delete(change, axis)).max() < 1e-5


def test_yaw_and_lean_are_those_of_full_stick() -> None:
    loop = StickLoop(STICKS)
    full_turn = first_rates(loop, (0.0, 1.0, 0.0, 0.0), state())
    assert math.degrees(full_turn[3]) == pytest.approx(202.5)
    leaning = state(STICKS.full_lean_deg, towards_deg=90.0)
    assert first_rates(loop, (0.0, 0.0, 0.0, 1.0), leaning)[1] == pytest.approx(0.0, abs=1e-3)
    inside = first_rates(loop, (0.0, 0.04, 0.04, 0.04), state())
    assert inside == pytest.approx([0.5, 0.0, 0.0, 0.0], abs=1e-6)


def test_a_lean_keeps_the_height_and_a_climb_ends_at_its_speed() -> None:
    loop = StickLoop(CONTRACT)
    stick = 40.0 / CONTRACT.full_lean_deg
    leaning = first_rates(loop, (0.0, 0.0, stick, 0.0), state(40.0))
    assert leaning[0] == pytest.approx(0.5 / math.cos(math.radians(40.0)), rel=1e-3)
    assert leaning[1:] == pytest.approx([0.0, 0.0, 0.0], abs=1e-3)
    climbing = first_rates(loop, (0.5, 0.0, 0.0, 0.0), state(climb=3.0))
    assert climbing[0] == pytest.approx(0.5, rel=1e-4)


def test_rates_stay_within_limits() -> None:
    loop, random = StickLoop(CONTRACT), np.random.default_rng(0)
    for _ in range(50):
        at = state(*random.uniform(0, 170, 1), towards_deg=random.uniform(0, 360), climb=-20.0)
        rates = loop.to_rates(random.uniform(-1, 1, (1, 16, 4)).astype(np.float32), at)
        assert np.isfinite(rates).all()
        assert 0.0 < rates[..., 0].min() <= rates[..., 0].max() <= 1.0
        tilting = np.hypot(rates[0, 0, 1], rates[0, 0, 2])
        assert tilting <= MAX_TILT_RATE_RADPS + math.radians(115.0) + 1e-6


@pytest.mark.parametrize("contract", [CONTRACT, STICKS])
def test_sticks_are_read_back_from_the_rates_that_flew_them(contract: Contract) -> None:
    loop, random = StickLoop(contract), np.random.default_rng(1)
    for _ in range(200):
        lean_deg, towards = random.uniform(0, 30), random.uniform(-math.pi, math.pi)
        at = state(lean_deg, towards_deg=math.degrees(towards), heading_deg=random.uniform(0, 360))
        at[0, 7:10] = random.uniform(-1, 1, 3)
        share = (lean_deg + random.uniform(-8, 8)) / contract.full_lean_deg
        lean = max(share, 0.1)
        sticks = np.array(
            [
                *random.choice([-0.24, 0.24], 1),
                random.uniform(0.1, 0.9),
                *(np.clip(lean, 0.1, 0.9) * np.array([math.cos(towards), math.sin(towards)])),
            ],
            np.float32,
        )
        beyond = np.abs(sticks) > contract.lean_dead_zone  # inside, nothing tells them apart
        rates = loop.to_rates(sticks[None, None], at)[0]
        back = loop.to_sticks(rates, at)[0]
        assert np.abs(loop.to_sticks(9 * rates, at)).max() <= 1.0
        np.testing.assert_allclose(back[beyond], sticks[beyond], atol=1e-3)
        assert np.abs(back[~beyond]).max(initial=0.0) <= contract.lean_dead_zone + 1e-3


def flown(given: list[FloatArray]) -> PolicyRunner:
    """A policy of centred sticks, flown by rates; appends what its network gets as history."""

    def act(_encoded: FloatArray, _state: FloatArray, history: FloatArray) -> FloatArray:
        given.append(history)
        return np.zeros((1, 16, 4), np.float32)

    parts = {"encode": lambda _rgb, _camera=0: np.zeros((1, 1), np.float32), "act": act}
    contract = Contract(hover_thrust=0.5)
    runner = PolicyRunner(contract=contract, name="s", engine="numpy", dual_rate=True, **parts)
    return flown_by_rates(runner)


def test_what_was_sent_are_rates_so_the_network_sees_centred_sticks() -> None:
    given: list[FloatArray] = []
    flown(given).act(np.zeros((1, 1), np.float32), state(), np.ones((1, 4, 4), "f4"))
    assert not given[0].any()


@pytest.mark.parametrize(
    ("sent", "up_mps2", "factor"),
    [
        (0.5, GRAVITY_MPS2, 1.0),
        (0.6, GRAVITY_MPS2, 1.2),  # a heavier vehicle, or an empty battery
        (0.5, 1.25 * GRAVITY_MPS2, 0.8),  # a lighter one climbs
        (0.75, 1.5 * GRAVITY_MPS2, 1.0),  # a climb that the thrust explains
        (0.9, 0.1, THRUST_GAINS[1]),  # it falls whatever is sent
        (0.0, GRAVITY_MPS2, THRUST_GAINS[0]),
    ],
)
def test_thrust_follows_the_force_that_the_sent_thrust_brought_about(
    sent: float, up_mps2: float, factor: float
) -> None:
    policy = flown([])
    history = np.full((1, 4, 4), [sent, 0.0, 0.0, 0.0], np.float32)

    def last_thrust(speed_mps: float, solves: int) -> float:
        at = state()
        at[0, VELOCITY], at[0, SPECIFIC_FORCE] = (speed_mps, 0.0, 0.0), (0.0, 0.0, -up_mps2)
        for _ in range(solves):
            rates = policy.act(np.zeros((1, 1), np.float32), at, history)[0, 0]
        return float(rates[0])

    assert last_thrust(0.9, 300) == pytest.approx(0.5), "it may still stand on the ground"
    for _ in range(2):
        assert last_thrust(2.0, 1) == pytest.approx(0.5, rel=0.05)
        assert last_thrust(0.0, 600) == pytest.approx(0.5 * factor, rel=0.01), "it has stopped"
        policy.reset()


@pytest.mark.parametrize("weight", [1.0, 1.2])
def test_drag_through_the_rotors_is_not_taken_for_weight(weight: float) -> None:
    gain, at = ThrustGain(0.5), state(40.0)[0]
    at[VELOCITY] = velocity = np.array([9.0, 0.0, 1.0])
    velocity_body = rotate(conjugate(tuple(at[QUATERNION])), tuple(velocity))
    at[SPECIFIC_FORCE] = -0.7 * np.array(velocity_body) - [0.0, 0.0, 1.3 * GRAVITY_MPS2 / weight]
    for _ in range(600):
        gain.update(0.65, at)
    assert gain.value == pytest.approx(weight, rel=1e-3)


def test_thrust_that_the_link_refused_is_not_taken_for_motors_off() -> None:
    loop, at = StickLoop(CONTRACT), np.tile(state(), (200, 1))
    at[:, VELOCITY] = 3.0
    sent = np.repeat(np.linspace(0.4, 0.6, 100), 2)
    kept = loop.thrust_gains(sent, at)
    sent[1::2] = np.nan  # as refused; the ones before fly on
    np.testing.assert_array_equal(loop.thrust_gains(sent, at), kept)


def test_other_axes_are_refused() -> None:
    with pytest.raises(ContractError, match="not in enu_flu"):
        StickLoop(replace(CONTRACT, state_frame="enu_flu"))
