"""The doublet flown in memory on the bundled simulator, and what is found of its parameters."""

import pytest

from mavbridge.commands.identify import doublet_policy, full_stick, identify_pushes
from mavbridge.commands.step_response import ResponseRecording
from mavbridge.simulation.flight import SimulatedFlight, SimulationSettings
from mavbridge.simulation.world import make_vehicle
from policy.contract import Contract
from policy.motion.controllers import doublet_length_s


def test_the_parameters_of_a_vehicle_are_found_in_flight() -> None:
    """ANGLE_MAX 15 deg, PILOT_Y_RATE 101 deg/s, 1.25 m/s up and down: half of the defaults."""
    settings = SimulationSettings(draw_images=False, raw_sticks=True)
    vehicle = make_vehicle(autopilot="ardupilot", gains=0.5)
    flight = SimulatedFlight(course_seed=3, seed=0, settings=settings, vehicle=vehicle)
    contract, recording = Contract(), ResponseRecording()
    policy, runner = doublet_policy(contract, flight.clock, is_in_air=False)
    flight.fly(runner, max_time_s=12.0 + doublet_length_s("sticks"), sinks=(recording,))
    assert policy.program_start_s is not None
    found = identify_pushes(recording, contract=contract, program_start_s=policy.program_start_s)
    assert found.missing == ()
    for axis, full in (("roll", 15.0), ("pitch", 15.0), ("yaw", 101.25), ("climb", 1.25)):
        pushes = [push for push in found.pushes if push.axis == axis]
        assert full_stick(pushes) == (
            *(pytest.approx(full, rel=0.04), pytest.approx(-full, rel=0.04)),
        )
        assert pushes[-1].ratio[0] == pytest.approx(0.5, rel=0.05)
        assert 0.03 < pushes[-1].dead_time_s < pushes[-1].time_63_s < 0.6
