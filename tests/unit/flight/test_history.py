from dataclasses import replace

import numpy as np
import pytest

from helpers.factories import make_plan
from helpers.guard_facts import make_chunk
from mavbridge.core.clock import NS_PER_MS
from mavbridge.core.vehicle import IDLE, NEUTRAL, AttitudeThrust, BodyRates, Sticks, Velocity
from mavbridge.flight.history import SentHistory
from mavbridge.guard.limits import ActionSmoother
from policy.contract import Contract


def stick(value: float) -> Sticks:
    return Sticks(throttle=value, yaw=0.0, pitch=0.0, roll=0.0)


@pytest.mark.parametrize("tick_ms", [5, 10, 20])
def test_history_is_the_same_at_any_rate(tick_ms: int) -> None:
    history = SentHistory(Contract(history_len=3, history_dt_s=0.02))
    for at_ms in range(0, 200 + 1, tick_ms):
        history.append(stick(at_ms / 1000), at_ms * NS_PER_MS)
    now = history.resample(200 * NS_PER_MS)
    assert now.shape == (1, 3, 4)
    assert now[0, :, 0] == pytest.approx([0.14, 0.16, 0.18])


def test_what_was_never_sent_and_what_was_released_is_neutral() -> None:
    history = SentHistory(Contract(history_len=4, history_dt_s=0.01))
    assert not history.resample(0).any()
    history.append(stick(0.5), 0)
    history.append(None, 15 * NS_PER_MS)
    history.append(stick(0.7), 25 * NS_PER_MS)
    assert history.resample(36 * NS_PER_MS)[0, :, 0] == pytest.approx([0, 0.5, 0, 0.7])
    assert history.resample(36 * NS_PER_MS)[0, 2] == pytest.approx(NEUTRAL)


def test_what_was_sent_comes_back_in_the_policys_own_axes_and_kind() -> None:
    own_terms = Contract(action="rates", state_frame="enu_flu", hover_thrust=0.5)
    history = SentHistory(replace(own_terms, history_len=4, history_dt_s=0.01))
    neutral = [0.5, 0, 0, 0]
    assert history.resample(0)[0].tolist() == [neutral] * 4
    history.append(BodyRates(0.25, 1.0, 2.0, -3.0), 0)
    history.append(AttitudeThrust(0.4, 0.1, 0.1, 0.1), 10 * NS_PER_MS)  # the guard's own levelling
    history.append(None, 20 * NS_PER_MS)
    history.append(IDLE, 30 * NS_PER_MS)
    own = [0.25, 1, -2, 3]
    assert history.resample(40 * NS_PER_MS)[0].tolist() == [own, neutral, neutral, neutral]


def test_what_is_foreseen_is_what_the_guard_will_send_and_what_was_sent_stays() -> None:
    """Neither the 12 m/s of the plan, nor without the limit on its change."""
    guard = make_plan(Contract(action="velocity")).guard
    history = SentHistory(Contract(action="velocity", history_len=4, history_dt_s=0.05))
    history.append(Velocity(1.0, 0.0, 0.0, 0.0), 0)
    plan = make_chunk(1, 0, first_ns=0, actions=(Velocity(12.0, 0.0, 0.0, 0.0),))
    smoother, sent = ActionSmoother(guard.smoothing, Velocity(1.0, 0.0, 0.0, 0.0)), []
    for at_ns in range(0, 1500 * NS_PER_MS, 10 * NS_PER_MS):
        sent.append(smoother.step(plan.actions[0], at_ns).smoothed)
        if at_ns <= 200 * NS_PER_MS:
            history.append(sent[-1], at_ns)
    ahead = history.foreseen(plan, guard, 205 * NS_PER_MS, 1500 * NS_PER_MS)
    flown = [ahead.at(k * 10 * NS_PER_MS).x_mps for k in range(150)]
    real = [action.x_mps for action in sent]
    assert flown[:20] == real[:20]
    assert np.abs(np.subtract(flown, real)).max() < 0.3
    assert max(flown) <= 8.0


def test_history_forgets_what_no_resample_can_reach() -> None:
    history = SentHistory(Contract(history_len=4, history_dt_s=0.05))
    for tick in range(100_000):
        history.append(stick(0.0), tick * 10 * NS_PER_MS)
    assert len(history._sent) <= 27
