import json
import math
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mavbridge.config.episodes import COURSE_SEEDS
from sitl import UsageError
from sitl.course import (
    EASY,
    LOOP_SEEDS,
    RACE,
    RACE_SEEDS,
    Gate,
    course_to_json,
    make_course,
    struck_gate,
)


@given(st.integers(0, RACE_SEEDS - 1) | st.integers(RACE_SEEDS, LOOP_SEEDS - 1))
def test_every_course_keeps_the_limits_of_its_family(seed):
    family = EASY if seed < RACE_SEEDS else RACE
    gates = make_course(seed).gates
    assert [gate.index for gate in gates] == list(range(family.gate_count))
    north, east, down = gates[0].center_ned_m
    assert (north, east) == (family.first_leg_m, 0.0)
    assert family.first_altitude_m[0] <= -down <= family.first_altitude_m[1]
    for here, there in pairwise(gates):
        delta = [b - a for a, b in zip(here.center_ned_m, there.center_ned_m, strict=True)]
        assert family.leg_m[0] - 1e-9 <= math.hypot(delta[0], delta[1]) <= family.leg_m[1] + 1e-9
        assert abs(delta[2]) <= family.climb_m
        heading_rad = math.atan2(delta[1], delta[0])
        for gate in (here, there):
            off_rad = math.remainder(gate.yaw_rad - heading_rad, math.tau)
            assert abs(off_rad) <= family.turn_rad / 2 + 1e-9
    for gate in gates:
        assert family.altitude_m[0] <= -gate.center_ned_m[2] <= family.altitude_m[1]


def test_json_holds_all_that_the_course_does():
    course = make_course(7)
    read = json.loads(course_to_json(course))
    assert read["seed"] == 7
    assert "NED" in read["frame"]
    gates = [
        Gate(**{**gate, "center_ned_m": tuple(gate["center_ned_m"])}) for gate in read["gates"]
    ]
    assert tuple(gates) == course.gates


def test_the_bridge_and_the_simulator_agree_where_families_begin() -> None:
    assert COURSE_SEEDS == {"easy": 0, "race": RACE_SEEDS, "loop": LOOP_SEEDS}


@given(st.integers(LOOP_SEEDS, 2**32), st.integers(1, 20))
def test_a_loop_can_be_flown_round_after_round(seed: int, laps: int) -> None:
    course = make_course(seed, laps)
    gates = course.ahead(0, course.passages)
    assert gates == course.gates * laps
    assert course.ahead(course.passages, 1) == course.gates[:1], "it never ends"
    first = course.gates[0]
    assert first.center_ned_m[:2] == pytest.approx((6.0, 0.0))
    assert first.yaw_rad == pytest.approx(0.0)
    heading_rad = 0.0
    for here, there in pairwise(course.ahead(0, 9)):
        north_m, east_m, _ = np.subtract(there.center_ned_m, here.center_ned_m)
        assert 7.0 <= math.hypot(north_m, east_m) <= 16.0
        leg_rad = math.atan2(east_m, north_m)
        for gate in (here, there):
            assert abs(math.remainder(gate.yaw_rad - leg_rad, math.tau)) < math.radians(50)
        heading_rad += math.remainder(there.yaw_rad - here.yaw_rad, math.tau)
        assert struck_gate(course, here.center_ned_m, there.center_ned_m) is None
    assert abs(heading_rad) == pytest.approx(math.tau)
    assert struck_gate(course, (0.0, 0.0, 0.0), first.center_ned_m) is None


def test_only_a_loop_has_laps() -> None:
    with pytest.raises(UsageError, match="laps"):
        make_course(7, laps=2)
