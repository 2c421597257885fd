"""The place of a vehicle that a policy has brought to a stop."""

import numpy as np
import pytest

from helpers.factories import START_NS, make_state
from mavbridge.core.clock import NS_PER_S
from mavbridge.core.records import FloatArray
from mavbridge.flight.station import MAX_DISPLACEMENT_M, StationKeeper
from policy.contract import VELOCITY

DT_NS = NS_PER_S // 100


def told(keeper: StationKeeper, velocity_mps: tuple[float, float, float], at_ns: int) -> FloatArray:
    """Return the velocity that the policy is told at a true one."""
    values = make_state().values.copy()
    values[VELOCITY] = velocity_mps
    state = make_state(at_ns, values=values)
    return keeper.corrected(state, values[None])[0, VELOCITY]


def flown(bias_mps2: float, begin_mps: float, *, keeps: bool) -> list[float]:
    """Fly two minutes by a policy that brakes, with an error of its own; return its places."""
    keeper, speed_mps, place_m, places_m = StationKeeper(), begin_mps, 0.0, []
    for step in range(12_000):
        velocity = (speed_mps, 0.0, 0.0)
        seen = told(keeper, velocity, START_NS + step * DT_NS) if keeps else velocity
        speed_mps += (bias_mps2 - 1.2 * float(seen[0])) * 0.01
        place_m += speed_mps * 0.01
        places_m.append(place_m)
    return places_m


@pytest.mark.parametrize("bias_mps2", [-0.3, -0.05, 0.1, 0.5])
def test_a_policy_that_brakes_stays_where_it_stopped(bias_mps2: float) -> None:
    place_m = flown(bias_mps2, 6.0, keeps=True)
    stopped_m = next(place_m[i] for i in range(len(place_m)) if place_m[i + 1] - place_m[i] < 0.005)
    assert abs(place_m[-1] - stopped_m) < 1.0 + abs(bias_mps2)
    assert abs(place_m[-1] - place_m[-3000]) < 0.01, "it has come to rest"
    drifted_m = flown(bias_mps2, 6.0, keeps=False)
    assert abs(drifted_m[-1] - drifted_m[-3000]) > 1.0, "which it does not do alone"


def test_a_moving_vehicle_and_a_short_stop_change_nothing() -> None:
    keeper = StationKeeper()
    for step in range(1000):
        velocity = (0.2, 0.1, 0.0) if step % 200 < 90 else (3.0, 0.0, -1.0)
        seen = told(keeper, velocity, START_NS + step * DT_NS)
        assert seen == pytest.approx(velocity)


def test_a_place_is_given_up_by_flying_on_and_by_a_gap() -> None:
    for leave in ((2.0, 0.0, 0.0), None):
        keeper, now_ns = StationKeeper(), START_NS
        for _ in range(400):
            now_ns += DT_NS
            seen = told(keeper, (0.4, 0.0, 0.0), now_ns)
        assert seen[0] > 0.8
        if leave is None:
            now_ns += 2 * NS_PER_S
        else:
            told(keeper, leave, now_ns + DT_NS)
        assert told(keeper, (0.4, 0.0, 0.0), now_ns + 2 * DT_NS)[0] == pytest.approx(0.4)


def test_the_displacement_that_counts_is_bounded() -> None:
    keeper = StationKeeper()
    for step in range(3000):
        seen = told(keeper, (0.3, -0.3, 0.0), START_NS + step * DT_NS)
    assert seen[:2] == pytest.approx(np.array([1.0, -1.0]) * (0.3 + MAX_DISPLACEMENT_M / 2))
