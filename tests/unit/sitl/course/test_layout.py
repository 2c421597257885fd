import json
import math
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sitl import UsageError
from sitl.course.layout import (
    ALTITUDE_M,
    CLIMB_M,
    FIRST_LEG_M,
    GATE_COUNT,
    LEG_M,
    TURN_RAD,
    Gate,
    course_to_json,
    make_course,
)


@given(st.integers(0, 2**32))
def test_every_course_is_flyable(seed):
    gates = make_course(seed).gates
    assert [gate.index for gate in gates] == list(range(GATE_COUNT))
    north, east, down = gates[0].center_ned_m
    assert (north, east) == (FIRST_LEG_M, 0.0)
    assert 2.0 <= -down <= 3.0
    for here, there in pairwise(gates):
        delta = [b - a for a, b in zip(here.center_ned_m, there.center_ned_m, strict=True)]
        assert LEG_M[0] - 1e-9 <= math.hypot(delta[0], delta[1]) <= LEG_M[1] + 1e-9
        assert abs(delta[2]) <= CLIMB_M
        heading_rad = math.atan2(delta[1], delta[0])
        for gate in (here, there):
            off_rad = math.remainder(gate.yaw_rad - heading_rad, math.tau)
            assert abs(off_rad) <= TURN_RAD / 2 + 1e-9
    for gate in gates:
        assert ALTITUDE_M[0] <= -gate.center_ned_m[2] <= ALTITUDE_M[1]


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
