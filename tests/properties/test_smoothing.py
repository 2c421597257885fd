"""The same sticks at 50, 100 and 200 Hz, and under 20 % timing jitter."""

import math

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from helpers.guard_facts import limits_of, stick_smoothing
from mavbridge.core.clock import NS_PER_S
from mavbridge.core.vehicle import NEUTRAL, AttitudeThrust, Sticks
from mavbridge.guard.limits import ActionSmoother, Smoothing

SLEW_PER_S = 8.0
SETTINGS = stick_smoothing(max_slew_per_s=SLEW_PER_S, tau_s=0.05)
DURATION_S = 2.0


def policy(t_s: float, amplitude: float, frequency_hz: float, offset: float) -> float:
    """What a policy might want: a swing that may exceed the stick's range."""
    return offset + amplitude * math.sin(2 * math.pi * frequency_hz * t_s)


def trace(times_s: np.ndarray, amplitude: float, frequency_hz: float, offset: float) -> np.ndarray:
    smoother = ActionSmoother(SETTINGS, NEUTRAL)
    smoother.reset(NEUTRAL)
    out = []
    for t_s in times_s:
        value = policy(float(t_s), amplitude, frequency_hz, offset)
        raw = Sticks(value, -value, value / 2, 0.0)
        out.append(smoother.step(raw, round(t_s * NS_PER_S)).smoothed)
    return np.array(out)


def at(times_s: np.ndarray, values: np.ndarray, query_s: np.ndarray) -> np.ndarray:
    return np.stack([np.interp(query_s, times_s, column) for column in values.T], axis=1)


def grid(rate_hz: int, jitter: float, seed: int) -> np.ndarray:
    times_s = np.arange(round(DURATION_S * rate_hz) + 1) / rate_hz
    wobble = np.random.default_rng(seed).uniform(-jitter, jitter, len(times_s)) / rate_hz
    wobble[0] = 0.0
    return times_s + wobble


def errors(swing: tuple[float, float, float], rate_hz: int, jitter: float, seed: int) -> np.ndarray:
    """Difference to the same filter run at 2 kHz."""
    query_s = np.arange(0.1, DURATION_S - 0.1, 0.02)
    fine_s, times_s = grid(2000, 0.0, 0), grid(rate_hz, jitter, seed)
    reference = at(fine_s, trace(fine_s, *swing), query_s)
    return np.abs(at(times_s, trace(times_s, *swing), query_s) - reference)


rates = st.sampled_from([50, 100, 200])
jitters = st.sampled_from([0.0, 0.2])
seeds = st.integers(0, 2**32 - 1)


@settings(max_examples=60, deadline=None)
@given(
    swing=st.tuples(st.floats(0, 0.6), st.floats(0.1, 2.0), st.floats(-0.3, 0.3)),
    rate_hz=rates,
    jitter=jitters,
    seed=seeds,
)
def test_output_does_not_depend_on_the_rate_or_on_jitter(
    swing: tuple[float, float, float], rate_hz: int, jitter: float, seed: int
) -> None:
    # 0.01 of a stick is 4 us of PWM, a fifth of the autopilot's default dead zone.
    assert errors(swing, rate_hz, jitter, seed).max() < 0.01


@settings(max_examples=60, deadline=None)
@given(
    swing=st.tuples(st.floats(1.0, 1.5), st.floats(0.1, 2.0), st.floats(-0.5, 0.5)),
    rate_hz=rates,
    jitter=jitters,
    seed=seeds,
)
def test_at_the_limits_the_rate_shows_by_less_than_one_tick_of_slew(
    swing: tuple[float, float, float], rate_hz: int, jitter: float, seed: int
) -> None:
    # Where between two ticks the input met the clip or the slew limit cannot be known.
    assert errors(swing, rate_hz, jitter, seed).max() < SLEW_PER_S / rate_hz


@settings(max_examples=100, deadline=None)
@given(
    wanted=st.lists(st.tuples(*[st.floats(-10, 10)] * 4), min_size=2, max_size=50),
    gaps_ms=st.lists(st.floats(0, 60), min_size=50, max_size=50),
)
def test_sticks_stay_in_range_and_under_the_slew_limit(
    wanted: list[tuple[float, float, float, float]], gaps_ms: list[float]
) -> None:
    smoother = ActionSmoother(SETTINGS, NEUTRAL)
    smoother.reset(NEUTRAL)
    now_ns, last, last_ns = 0, NEUTRAL, 0
    for raw, gap_ms in zip(wanted, gaps_ms, strict=False):
        now_ns += round(gap_ms * 1e6)
        out = smoother.step(Sticks(*raw), now_ns).smoothed
        reach = SLEW_PER_S * (now_ns - last_ns) / NS_PER_S
        for before, after in zip(last, out, strict=True):
            assert -1.0 <= after <= 1.0
            assert abs(after - before) <= reach + 1e-9
        last, last_ns = out, now_ns


@given(
    wanted=st.lists(st.tuples(*[st.floats(-1e6, 1e6)] * 4), min_size=2, max_size=20),
    gaps_ns=st.lists(st.integers(0, 10**9), min_size=20, max_size=20),
    tau_s=st.floats(0.0, 2.0),
)
@example(wanted=[(0.0,) * 4, (0.563010758859421,) * 4], gaps_ns=[0, 10], tau_s=1.7929980275164399)
def test_rounding_carries_no_action_beyond_its_limits(
    wanted: list[tuple[float, float, float, float]], gaps_ns: list[int], tau_s: float
) -> None:
    limits = limits_of("attitude")
    start = AttitudeThrust(0.0, 0.0, 0.0, 0.0)
    smoother, now_ns = ActionSmoother(Smoothing(limits=limits, tau_s=tau_s), start), 0
    for raw, gap_ns in zip(wanted, gaps_ns, strict=False):
        now_ns += gap_ns
        out = smoother.step(AttitudeThrust(*raw), now_ns).smoothed
        assert limits.low[0] <= out.thrust <= limits.high[0]
        assert all(map(math.isfinite, out))


def test_a_step_reaches_63_percent_after_tau() -> None:
    smoother = ActionSmoother(stick_smoothing(max_slew_per_s=0.0, tau_s=0.1, max_dt_s=0.2), NEUTRAL)
    smoother.reset(NEUTRAL)
    one = Sticks(1.0, 0.0, 0.0, 0.0)
    smoother.step(one, 0)
    smoother.step(one, 1)  # the step's edge: from here on the input is 1
    after = [smoother.step(one, 1 + k * NS_PER_S // 1000).smoothed.throttle for k in range(1, 101)]
    assert after[-1] == pytest.approx(1 - math.exp(-1), abs=0.001)


def test_a_ramp_is_followed_at_a_distance_of_tau() -> None:
    smoother = ActionSmoother(stick_smoothing(max_slew_per_s=1.0, tau_s=0.1), NEUTRAL)
    for tick in range(51):
        trace = smoother.step(Sticks(1.0, 0.0, 0.0, 0.0), tick * NS_PER_S // 100)
    assert trace.slewed.throttle == pytest.approx(0.5)
    assert trace.smoothed.throttle == pytest.approx(0.4 + 0.1 * math.exp(-5))


def test_a_reset_starts_from_the_given_sticks_and_a_stall_does_not_jump() -> None:
    smoother = ActionSmoother(
        stick_smoothing(max_slew_per_s=8.0, tau_s=0.0, max_dt_s=0.03), NEUTRAL
    )
    start = Sticks(0.4, 0.0, 0.0, -0.2)
    smoother.reset(start)
    assert smoother.step(NEUTRAL, 10**9).smoothed == start
    after_stall = smoother.step(Sticks(-1.0, 0.0, 0.0, 1.0), 4 * 10**9).smoothed
    assert after_stall == pytest.approx((0.4 - 0.24, 0.0, 0.0, -0.2 + 0.24))


def test_a_reset_forgets_the_flight_before_and_the_time_since() -> None:
    smoother = ActionSmoother(SETTINGS, NEUTRAL)
    for k in range(10):
        smoother.step(Sticks(1.0, 1.0, 1.0, 1.0), k * NS_PER_S // 100)
    start = Sticks(-0.4, 0.0, 0.2, 0.1)
    smoother.reset(start)
    assert smoother.step(Sticks(1.0, 1.0, 1.0, 1.0), NS_PER_S).smoothed == start


def test_the_longest_step_is_15_periods_of_100_hz_unless_said_otherwise() -> None:
    limits = stick_smoothing(max_slew_per_s=1.0).limits
    smoother = ActionSmoother(Smoothing(limits=limits, tau_s=0.0), NEUTRAL)
    smoother.step(NEUTRAL, 0)
    after_stall = smoother.step(Sticks(1.0, 0.0, 0.0, 0.0), NS_PER_S).smoothed
    assert after_stall.throttle == pytest.approx(0.15)
