"""The doublet flown in memory on the bundled simulator, and what is found of its parameters."""

import pytest

from mavbridge.commands.identify import ResponseRecording, doublet_policy, identify_pushes
from mavbridge.config.flight import FlyConfig, LinkConfig
from mavbridge.simulation.flight import SimulatedFlight, SimulationSettings
from mavbridge.simulation.world import make_vehicle
from policy.contract import Contract
from policy.motion.controllers import doublet_length_s


def test_the_parameters_of_a_vehicle_are_found_in_flight() -> None:
    """ANGLE_MAX 15 deg, PILOT_Y_RATE 101 deg/s, 1.25 m/s up and down: half of the defaults."""
    config = FlyConfig(link=LinkConfig(raw_sticks=True))
    settings = SimulationSettings(config=config, draw_images=False)
    vehicle = make_vehicle(autopilot="ardupilot", gains=0.5)
    flight = SimulatedFlight(course_seed=3, seed=0, settings=settings, vehicle=vehicle)
    contract, recording = Contract(), ResponseRecording()
    policy, runner = doublet_policy(contract, flight.clock, is_in_air=False)
    flight.fly(runner, max_time_s=12.0 + doublet_length_s("sticks"), sinks=(recording,))
    assert policy.program_start_s is not None
    found = identify_pushes(recording, contract=contract, program_start_s=policy.program_start_s)
    assert found.missing == ()
    assert [push.axis for push in found.pushes] == ["roll", "pitch", "yaw", "climb"]
    for push in found.pushes:
        assert push.ratio == pytest.approx((0.5, 0.5), rel=0.04), push
        assert 0.03 < push.dead_time_s < push.time_63_s < 0.6
