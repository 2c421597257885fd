import json
import math
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mavbridge.config.episodes import RACE_COURSE_SEED
from sitl import UsageError
from sitl.course import EASY, RACE, RACE_SEEDS, Gate, course_to_json, make_course


@given(st.integers(0, RACE_SEEDS - 1) | st.integers(RACE_SEEDS, 2**32))
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


def test_the_seed_decides():
    assert make_course(7) == make_course(7)
    assert make_course(7) != make_course(8)


def test_a_negative_seed_is_refused():
    with pytest.raises(UsageError, match="0 or more"):
        make_course(-1)


def test_json_holds_all_that_the_course_does():
    course = make_course(7)
    read = json.loads(course_to_json(course))
    assert read["seed"] == 7
    assert "NED" in read["frame"]
    gates = [
        Gate(**{**gate, "center_ned_m": tuple(gate["center_ned_m"])}) for gate in read["gates"]
    ]
    assert tuple(gates) == course.gates


def test_the_bridge_and_the_simulator_agree_where_races_begin() -> None:
    assert RACE_COURSE_SEED == RACE_SEEDS
