"""Parameters that are set for one flight: confirmed, logged, put back."""

from typing import Any

import pytest

from helpers.parameters import ParamVehicle, lossy
from mavbridge.core.reasons import Code, because

WANTED = (("RC_OVERRIDE_TIME", 0.5),)
SET = [("RC_OVERRIDE_TIME", 0.5)]


def start(*, time_s: float = 3.0, **more: Any) -> ParamVehicle:
    flags: dict[str, Any] = {"set_params": WANTED} | more
    return ParamVehicle({"RC_OVERRIDE_TIME": time_s}, **flags)


def end(vehicle: ParamVehicle, *, within_s: float = 5.0) -> None:
    vehicle.params.changes.restore()
    vehicle.run(within_s)
    assert vehicle.params.changes.restore()


def told(vehicle: ParamVehicle, text: str) -> bool:
    return any(text in line for line in vehicle.texts)


def test_a_parameter_is_set_before_the_flight_and_put_back_after_it() -> None:
    early = start()
    early.run(0.1)
    assert early.params.changes.restore()
    early.run(6.0)
    assert early.writes == []  # the end came before anything was set
    vehicle = start(old_params={"RC_OVERRIDE_TIME": 7.0})  # of an earlier session
    assert vehicle.problem() is not None
    vehicle.run(6.0)
    assert vehicle.problem() is None
    assert vehicle.values["RC_OVERRIDE_TIME"] == 0.5
    assert vehicle.writes == SET
    assert told(vehicle, "RC_OVERRIDE_TIME set from 3 to 0.5 for this flight")
    assert not told(vehicle, "last sticks for that many seconds")  # it is mended
    end(vehicle, within_s=0.1)
    assert vehicle.values["RC_OVERRIDE_TIME"] == 3.0
    assert told(vehicle, "RC_OVERRIDE_TIME put back to 3")


@pytest.mark.parametrize("seed", range(3))
def test_setting_and_putting_back_survive_losses(seed: int) -> None:
    vehicle = start(loses=lossy(0.3, seed))
    vehicle.run(15.0)
    assert vehicle.problem() is None
    assert vehicle.values["RC_OVERRIDE_TIME"] == 0.5
    end(vehicle)
    assert vehicle.values["RC_OVERRIDE_TIME"] == 3.0


def test_a_value_that_the_vehicle_does_not_take_forbids_the_flight() -> None:
    vehicle = start()
    vehicle.refuses.add("RC_OVERRIDE_TIME")
    vehicle.run(10.0)
    refused = because(Code.SET_REFUSED, name="RC_OVERRIDE_TIME", value=0.5, stays=3.0)
    assert vehicle.problem() == refused
    assert len(vehicle.writes) == 6
    vehicle.set_by_pilot("RC_OVERRIDE_TIME", 0.5)
    assert vehicle.problem() is None
    end(vehicle)
    assert vehicle.values["RC_OVERRIDE_TIME"] == 0.5  # the pilot's doing, not ours


def test_a_value_that_the_vehicle_rounds_forbids_the_flight_and_is_put_back() -> None:
    vehicle = start(set_params=(("RC_OVERRIDE_TIME", 1.5),))
    vehicle.rounds.add("RC_OVERRIDE_TIME")
    vehicle.run(10.0)
    refused = because(Code.SET_REFUSED, name="RC_OVERRIDE_TIME", value=1.5, stays=2.0)
    assert vehicle.problem() == refused
    end(vehicle)
    assert vehicle.values["RC_OVERRIDE_TIME"] == 3.0
    assert not told(vehicle, "another station")


def test_a_vehicle_that_does_not_answer_forbids_the_flight() -> None:
    vehicle = start()
    while not vehicle.writes:
        vehicle.step()
    vehicle.fall_silent()
    vehicle.run(5.0)
    assert vehicle.problem() == because(Code.SET_UNANSWERED, name="RC_OVERRIDE_TIME", value=0.5)


def test_a_parameter_that_does_not_exist_forbids_the_flight() -> None:
    vehicle = ParamVehicle(set_params=(("RC_OVERIDE_TIME", 0.5),))
    vehicle.run(6.0)
    assert vehicle.problem() == because(Code.SET_ABSENT, name="RC_OVERIDE_TIME", value=0.5)
    assert vehicle.writes == []


def test_a_parameter_whose_value_comes_late_is_set_then() -> None:
    vehicle = start(set_params=(*WANTED, ("PILOT_Y_RATE", 90.0)))
    vehicle.run(2.0)
    told_first = because(Code.SET_ABSENT, name="PILOT_Y_RATE", value=90.0)
    assert vehicle.problem() == told_first
    vehicle.values["PILOT_Y_RATE"] = 120.0  # its answers were lost
    vehicle.run(6.0)
    assert vehicle.problem() is None
    assert vehicle.values["PILOT_Y_RATE"] == 90.0
    end(vehicle)
    assert (vehicle.values["PILOT_Y_RATE"], vehicle.values["RC_OVERRIDE_TIME"]) == (120.0, 3.0)


def test_nothing_is_set_or_put_back_while_armed() -> None:
    vehicle = start()
    vehicle.armed = True
    vehicle.run(6.0)
    assert vehicle.problem() == because(Code.SET_NEEDS_DISARMING)
    assert vehicle.writes == []
    vehicle.armed = False
    vehicle.run(2.0)  # what it did not send is asked for once more
    assert vehicle.problem() is None
    vehicle.armed = True
    vehicle.run(1.0)
    end(vehicle, within_s=0.1)
    assert vehicle.writes == SET
    assert told(vehicle, "still armed, so what was set for the flight stays: RC_OVERRIDE_TIME (it")


def test_arming_while_something_is_put_back_stops_that() -> None:
    vehicle = start()
    vehicle.run(6.0)
    vehicle.refuses.add("RC_OVERRIDE_TIME")
    vehicle.params.changes.restore()
    vehicle.run(0.7)
    vehicle.armed = True
    count = len(vehicle.writes)
    vehicle.run(5.0)
    assert vehicle.params.changes.restore()
    assert len(vehicle.writes) == count
    assert told(vehicle, "still armed")


def test_a_vehicle_that_is_gone_at_the_end_is_told() -> None:
    vehicle = start()
    vehicle.run(6.0)
    vehicle.fall_silent()
    end(vehicle)
    assert told(vehicle, "RC_OVERRIDE_TIME could not be put back to 3")


def test_an_end_while_a_write_is_on_its_way_puts_back() -> None:
    vehicle = start()
    while not vehicle.writes:
        vehicle.step()
    end(vehicle)  # without having heard the confirmation
    assert vehicle.values["RC_OVERRIDE_TIME"] == 3.0


def test_what_another_station_has_set_meanwhile_is_left() -> None:
    vehicle = start()
    vehicle.run(6.0)
    vehicle.set_by_pilot("RC_OVERRIDE_TIME", 0.8)
    assert vehicle.problem() is None
    end(vehicle)
    assert vehicle.values["RC_OVERRIDE_TIME"] == 0.8
