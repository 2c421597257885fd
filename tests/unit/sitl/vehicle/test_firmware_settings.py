"""Firmware settings and stream timing that conditions change."""

import math
from dataclasses import replace

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mav

from sitl.clock import NS_PER_MS, NS_PER_S
from sitl.course import AirborneStart
from sitl.simulated_vehicle import SimulatedVehicle
from sitl.vehicle.conditions import NOMINAL
from sitl.vehicle.config import STEP_NS, VehicleConfig
from sitl.vehicle.rotation import to_euler

ALOFT = AirborneStart(position_ned_m=(0.0, 0.0, -30.0))
ATTITUDE = mav.MAVLINK_MSG_ID_ATTITUDE


def lean_deg(seconds, **conditions):
    """Return the lean after full right stick for a time, from a hover."""
    config = VehicleConfig(conditions=replace(NOMINAL, **conditions))
    vehicle = SimulatedVehicle(links=1, boot_ns=0, config=config)
    vehicle.launch(ALOFT)
    for now_ns in range(STEP_NS, round(seconds * NS_PER_S), STEP_NS):
        vehicle.ap.rc.override([2000, 1500, 1500, 1500, *[65535] * 4], now_ns)
        vehicle.step(now_ns)
    return math.degrees(to_euler(vehicle.ap.truth.ned_from_body_wxyz)[0])


@pytest.mark.parametrize(
    "slower",
    [{"input_time_s": 0.3}, {"lean_rate_max_degps": 40.0}, {"lean_accel_max_cdegps2": 30_000.0}],
)
def test_a_softer_attitude_response_leans_later(slower):
    assert lean_deg(0.25, **slower) < 0.8 * lean_deg(0.25)
    assert lean_deg(2.0, **slower) == pytest.approx(30.0, abs=1.5)


def sent_ms(seed=0, seconds=1, interval_us=10_000, **conditions):
    """Times at which ATTITUDE leaves a link of a vehicle with these conditions."""
    config = VehicleConfig(conditions=replace(NOMINAL, seed=seed, **conditions))
    vehicle = SimulatedVehicle(links=1, boot_ns=0, config=config)
    link, parser, sent = vehicle.server.links[0], mav.MAVLink(None), []
    assert link.set_interval(ATTITUDE, interval_us)
    for now_ns in range(STEP_NS, seconds * NS_PER_S, STEP_NS):
        vehicle.step(now_ns)
        messages = parser.parse_buffer(vehicle.take_outgoing(0)) or ()
        sent += [now_ns / NS_PER_MS for m in messages if m.get_type() == "ATTITUDE"]
    return sent


def test_jitter_delays_messages_and_loses_none():
    sent = np.array(sent_ms(stream_jitter_ms=5.0))
    late_ms = sent - 10.0 * np.arange(1, len(sent) + 1)
    assert len(sent) == pytest.approx(99, abs=1)
    assert set(late_ms) == {0.0, 2.5, 5.0}


def test_phases_differ_from_vehicle_to_vehicle_and_follow_from_the_seed():
    firsts = [sent_ms(seed, interval_us=40_000, stream_phase_spread=1.0)[0] for seed in range(9)]
    assert len(set(firsts)) > 4
    assert 0.0 < min(firsts) <= max(firsts) <= 40.0
    assert sent_ms(3, stream_phase_spread=1.0) == sent_ms(3, stream_phase_spread=1.0)
