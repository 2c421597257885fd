"""The result of a simulated flight."""

from types import SimpleNamespace
from typing import Any

import pytest

from helpers.factories import START_NS, make_tick
from helpers.fakes import FakeClock
from mavbridge.simulation.referee import Referee
from sitl.course import GatePass


def test_a_result_is_that_of_the_flight_and_not_of_its_way_out() -> None:
    still, moving = (0.0, 0.0, 0.0), (2.0, 0.0, 0.0)
    body = SimpleNamespace(position_ned_m=(40.0, 1.0, -2.0), velocity_ned_mps=moving)
    log = SimpleNamespace(
        next_gate=None, gates_total=2, gates_passed=(GatePass(index=0, t_s=5.0),), distance_m=40.0
    )
    log.verdict = lambda *_: "finished" if body.position_ned_m[0] > 41.0 else None
    vehicle: Any = SimpleNamespace(log=log, ap=SimpleNamespace(truth=body, now_ns=0, armed=True))
    rest: dict[str, Any] = {"max_time_s": 60.0, "run_out_s": 1.0, "should_stop": None}
    referee = Referee(FakeClock(START_NS), vehicle, stops=False, **rest)
    referee.emit(make_tick())
    places = (((40.0, 1.0, -2.0), moving), ((41.0, 1.0, -2.0), still), ((44.0, 5.0, -2.0), moving))
    for body.position_ned_m, body.velocity_ned_mps in places:
        referee.watch()
    # While the guard gives the sticks back.
    body.position_ned_m, log.distance_m = (60.0, 1.0, -2.0), 60.0
    log.gates_passed = (*log.gates_passed, GatePass(index=1, t_s=9.0))
    result = referee.result(course_seed=0, seed=0)
    assert (result.drift_m, result.distance_m) == (pytest.approx(5.0), 40.0)
    assert result.gates_passed == 1
