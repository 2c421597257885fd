"""GUIDED on the simulated body, without a link: response times and the ground."""

import math

import pytest

from sitl.ardupilot.flight_modes import Mode
from sitl.clock import NS_PER_S
from sitl.vehicle.config import MID_RECEIVER_US, STEP_NS, VehicleConfig
from sitl.vehicle.firmware import AttitudeSetpoint
from sitl.vehicle.rotation import from_euler, to_euler

ZERO = (0.0, 0.0, 0.0)


def lean(roll_deg=0.0, thrust=0.5, rate=ZERO):
    return AttitudeSetpoint(from_euler(math.radians(roll_deg), 0.0, 0.0), rate, thrust)


def turn(x_degps=0.0, z_degps=0.0, thrust=0.5):
    return AttitudeSetpoint(None, (math.radians(x_degps), 0.0, math.radians(z_degps)), thrust)


def stream(pilot, seconds, setpoint, watch=lambda ap: None):
    """The setpoint at 50 Hz."""
    for index in range(round(seconds * NS_PER_S / STEP_NS)):
        if index % 8 == 0:
            pilot.ap.guided.follow_attitude(setpoint, pilot.ap.sensed, pilot.ap.now_ns)
        pilot.ap.step()
        watch(pilot.ap)


def step_ms(pilot, seconds, setpoint, read, final):
    """Times to 10, 50, 63 and 90 % of a step in ms, and its peak over its height."""
    start_ns, before, samples = pilot.ap.now_ns, read(pilot.ap), []
    stream(pilot, seconds, setpoint, lambda ap: samples.append((ap.now_ns, read(ap) - before)))
    times = [
        next((stamp - start_ns) / 1e6 for stamp, value in samples if value >= part * final)
        for part in (0.1, 0.5, 0.63, 0.9)
    ]
    return times, max(value for _, value in samples) / final


def roll_deg(ap):
    return math.degrees(to_euler(ap.truth.ned_from_body_wxyz)[0])


def rate_degps(axis):
    return lambda ap: math.degrees(ap.truth.rate_body_radps[axis])


@pytest.fixture
def pilot(pilot):
    """With a receiver whose sticks stay centred: overrides would only get in the way."""
    return type(pilot)(VehicleConfig(receiver_us=MID_RECEIVER_US))


def in_the_air(pilot, mode=Mode.GUIDED):
    pilot.silence(5.5)  # until it has a position
    pilot.ap.launch((0.0, 0.0, -6.0), ZERO, (1.0, 0.0, 0.0, 0.0))
    assert pilot.ap.set_mode(mode)
    pilot.silence(0.5)
    pilot.texts()


@pytest.mark.parametrize(
    ("setpoint", "axis", "measured_ms", "measured_peak"),
    [
        (turn(x_degps=40.0), 0, [33, 48, 53, 85], 1.04),
        (turn(z_degps=40.0), 2, [145, 272, 307, 392], 1.22),
    ],
)
def test_rate_steps_take_the_measured_times(pilot, setpoint, axis, measured_ms, measured_peak):
    in_the_air(pilot, Mode.GUIDED_NOGPS)
    stream(pilot, 1.0, lean())
    times, peak = step_ms(pilot, 1.0, setpoint, rate_degps(axis), 40.0)
    assert times == pytest.approx(measured_ms, abs=20)
    assert peak == pytest.approx(measured_peak, abs=0.06)


def test_angle_boost_keeps_the_thrust_of_a_leaning_vehicle_vertical(pilot):
    def climb_mps(boost):
        in_the_air(other := type(pilot)(pilot.ap.config), Mode.GUIDED_NOGPS)
        other.ap.params.set("GUID_OPTIONS", 8.0)
        other.ap.params.set("ATC_ANGLE_BOOST", boost)
        hover = other.ap.params["MOT_THST_HOVER"]
        stream(other, 1.5, lean(25.0, thrust=hover))
        assert other.ap.control.thrust == pytest.approx(hover)
        return -other.ap.truth.velocity_ned_mps[2]

    assert climb_mps(1.0) == pytest.approx(0.0, abs=0.2)
    assert climb_mps(0.0) < -0.5


def test_without_gps_guided_is_taken_on_the_ground_but_arms_only_in_nogps(pilot):
    pilot = type(pilot)(VehicleConfig(receiver_us=MID_RECEIVER_US, position_ready_s=math.inf))
    pilot.silence(6.0)
    assert pilot.ap.set_mode(Mode.GUIDED)
    assert not pilot.ap.arm(force=False)
    assert pilot.texts() == ["Arm: GPS 1: Bad fix"]
    assert pilot.ap.set_mode(Mode.GUIDED_NOGPS)
    assert pilot.ap.arm(force=False)
