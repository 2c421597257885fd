"""Attitudes, body rates and velocities: what leaves, what the echo tells, how they are released."""

import math
from typing import Any

import pytest

from helpers.flown_vehicle import Flight, FlownVehicle, codec
from mavbridge.core.clock import NS_PER_MS, NS_PER_S
from mavbridge.core.reasons import Code
from mavbridge.core.rotation import heading_rad, quaternion_from_euler
from mavbridge.core.vehicle import (
    NEUTRAL,
    ActionMeaning,
    AdviceText,
    AttitudeThrust,
    BodyRates,
    Velocity,
)
from mavbridge.mavlink.codec.messages import Attitude, AttitudeTarget, SpecificForce, VelocityTarget
from mavbridge.mavlink.codec.packets import CommandRefusedError
from mavbridge.mavlink.outputs.setpoints import (
    HELD_NS,
    MOST_LEAD_RAD,
    AttitudeOutput,
    VelocityOutput,
)
from mavbridge.mavlink.profiles.ardupilot import ARDUPILOT
from mavbridge.mavlink.profiles.profile import Profile
from mavbridge.mavlink.profiles.px4 import PX4

MS, S = NS_PER_MS, NS_PER_S
BOTH = pytest.mark.parametrize("profile", [ARDUPILOT, PX4], ids=lambda profile: profile.name)
LEVEL = AttitudeThrust(0.39, 0.0, 0.0, 0.0)


def attitude_flight(
    profile: Profile, *, is_rates: bool = False, hover: float = 0.39, yaw_rad: float = 1.0
) -> Flight:
    meaning = ActionMeaning(kind="rates" if is_rates else "attitude", hover_thrust=hover)
    name = "rates" if is_rates else "attitude"
    flight = Flight(AttitudeOutput(codec(), meaning, profile, name), FlownVehicle(profile))
    turn_to(flight, yaw_rad)
    return flight


def velocity_flight(profile: Profile, *, is_heading_frame: bool = False) -> Flight:
    meaning = ActionMeaning(kind="velocity", is_heading_frame=is_heading_frame)
    return Flight(VelocityOutput(codec(), meaning), FlownVehicle(profile))


def turn_to(flight: Flight, yaw_rad: float) -> None:
    quaternion = quaternion_from_euler(0.0, 0.0, yaw_rad)
    flight.receive(Attitude(True, 0, quaternion, (0.0, 0.0, 0.0)))


def target(thrust: float, rates: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> AttitudeTarget:
    return AttitudeTarget(rates, thrust)


# --- attitude and rates


@pytest.mark.parametrize(
    ("profile", "boost", "factor"), [(ARDUPILOT, 1.0, 0.5), (ARDUPILOT, 0.0, 1.0), (PX4, 1.0, 1.0)]
)
def test_the_thrust_of_body_rates_is_along_the_body_whatever_the_autopilot_adds(
    profile: Profile, boost: float, factor: float
) -> None:
    flight = attitude_flight(profile, is_rates=True)
    flight.vehicle.params.values["ATC_ANGLE_BOOST"] = boost
    leaning = quaternion_from_euler(math.radians(60.0), 0.0, 0.0)
    flight.receive(Attitude(True, 0, leaning, (0.0, 0.0, 0.0)))
    encoded = flight.send(BodyRates(0.6, 0.1, 0.2, 0.3))
    message: Any = flight.message(encoded)
    assert message.thrust == pytest.approx(factor * 0.6, abs=1e-4)
    assert encoded.action.thrust == pytest.approx(0.6, abs=1e-4)  # what the policy's history holds


def test_an_attitude_keeps_the_vehicles_own_heading_until_it_turns() -> None:
    flight = attitude_flight(PX4, yaw_rad=1.0)
    unknown = AttitudeOutput(codec(), ActionMeaning(kind="attitude"), PX4, "attitude")
    assert unknown.encode(LEVEL, flight.session, flight.now_ns) is None
    message: Any = flight.message(flight.send(AttitudeThrust(0.5, 0.2, -0.1, 0.0)))
    assert tuple(message.q) == pytest.approx(quaternion_from_euler(0.2, -0.1, 1.0), abs=1e-6)
    assert message.type_mask == 7
    for _ in range(50):
        message = flight.message(flight.send(AttitudeThrust(0.5, 0.2, -0.1, 0.4)))
    assert heading_rad(tuple(message.q)) == pytest.approx(1.0 + 0.4 * 0.5, abs=0.01)


@pytest.mark.parametrize("yaw_rate", [4.0, -4.0])
def test_the_heading_that_is_asked_for_never_runs_far_ahead(yaw_rate: float) -> None:
    flight, turning = attitude_flight(PX4, yaw_rad=3.0), LEVEL._replace(yaw_rate_radps=yaw_rate)
    for _ in range(200):
        message: Any = flight.message(flight.send(turning))
    ahead = math.remainder(heading_rad(tuple(message.q)) - 3.0, math.tau)
    assert ahead == pytest.approx(math.copysign(MOST_LEAD_RAD, yaw_rate), abs=1e-6)
    flight.now_ns += 600 * MS  # after a pause: afresh
    message = flight.message(flight.send(LEVEL))
    assert heading_rad(tuple(message.q)) == pytest.approx(3.0, abs=1e-6)


def test_before_another_mode_is_left_the_heading_follows_the_vehicles() -> None:
    flight = attitude_flight(PX4)
    flight.vehicle.mode = "ALTCTL"
    flight.send(LEVEL)
    turn_to(flight, 3.0)
    message: Any = flight.message(flight.send(LEVEL))
    assert heading_rad(tuple(message.q)) == pytest.approx(3.0, abs=1e-6)


@BOTH
def test_thrust_that_hovered_in_training_hovers_here(profile: Profile) -> None:
    flight = attitude_flight(profile, hover=0.4)
    name = "MOT_THST_HOVER" if profile is ARDUPILOT else "MPC_THR_HOVER"
    flight.vehicle.params.values = {name: 0.5}
    encoded = flight.send(AttitudeThrust(0.4, 0.0, 0.0, 0.0))
    message: Any = flight.message(encoded)
    assert message.thrust == pytest.approx(0.5, abs=1e-4)
    assert encoded.action.thrust == pytest.approx(0.4, abs=1e-4)
    message = flight.message(flight.send(AttitudeThrust(1.0, 0.0, 0.0, 0.0)))
    assert 0.999 < message.thrust <= 1.0


def fly_by_itself(flight: Flight, thrust: float, up_mps2: float, seconds: float = 2.0) -> None:
    for _ in range(round(seconds * 50)):
        flight.now_ns += 18 * MS
        flight.receive(SpecificForce("RAW_IMU", 0, (0.0, 0.0, -up_mps2)))
        flight.receive(target(thrust))


def test_the_hover_that_was_seen_counts_more_than_the_parameter() -> None:
    for up_mps2 in (9.80665, 11.0):  # climbing faster and faster, at more thrust
        flight = attitude_flight(ARDUPILOT, hover=0.4)
        flight.vehicle.params.values = {"MOT_THST_HOVER": 0.39}
        fly_by_itself(flight, 0.364 * up_mps2 / 9.80665, up_mps2)
        message: Any = flight.message(flight.send(AttitudeThrust(0.4, 0.0, 0.0, 0.0)))
        assert message.thrust == pytest.approx(0.364, abs=1e-3)


@pytest.mark.parametrize("why", ["on the ground", "too short", "leaning", "falling"])
def test_thrust_that_is_no_hover_is_not_learnt(why: str) -> None:
    flight = attitude_flight(ARDUPILOT, hover=0.4)
    flight.vehicle.params.values = {"MOT_THST_HOVER": 0.4}
    flight.vehicle.is_landed = why == "on the ground"
    if why == "leaning":
        quaternion = quaternion_from_euler(0.5, 0.0, 0.0)
        flight.receive(Attitude(True, 0, quaternion, (0.0, 0.0, 0.0)))
    seconds, up_mps2 = (0.5 if why == "too short" else 2.0), (3.0 if why == "falling" else 9.8)
    fly_by_itself(flight, 0.2, up_mps2, seconds)
    message: Any = flight.message(flight.send(AttitudeThrust(0.4, 0.0, 0.0, 0.0)))
    assert message.thrust == pytest.approx(0.4, abs=1e-3)


@BOTH
def test_a_new_mode_that_is_not_told_yet_is_no_other_station(profile: Profile) -> None:
    flight = attitude_flight(profile)
    for k in range(55):  # the mode is told 30 ms after its first target
        message: Any = flight.message(flight.send(LEVEL))
        flight.receive(target(message.thrust if k < 50 else 0.45))
        assert (flight.problem is None) is (k < 54)
    assert flight.output.echo_confirmed
    assert flight.problem.code is Code.OVERRULED


@pytest.mark.parametrize("state", ["disarmed", "another mode", "landed", "idle"])
def test_where_no_echo_is_to_be_expected_none_is_missed(state: str) -> None:
    flight = attitude_flight(PX4)
    flight.vehicle.armed = state != "disarmed"
    flight.vehicle.is_landed = {"landed": True, "idle": None}.get(state, False)
    if state == "another mode":
        flight.vehicle.mode = "ALTCTL"
    action = LEVEL._replace(thrust=0.0) if state == "idle" else LEVEL
    for _ in range(300):
        message: Any = flight.message(flight.send(action))
        flight.receive(target(0.45))
        assert flight.problem is None
        assert flight.output.echo_confirmed
    if state == "idle":
        assert message.thrust == 0.0  # not dithered: the motors stay idle


@pytest.mark.parametrize("is_rates", [False, True])
@pytest.mark.parametrize("every", [10, 40, 90])
def test_a_dive_without_thrust_does_not_hide_that_nothing_is_heard(
    is_rates: bool, every: int
) -> None:
    flight = attitude_flight(ARDUPILOT, is_rates=is_rates)
    level = BodyRates(0.45, 0.3, -0.2, 0.1) if is_rates else LEVEL
    heard = 0.0
    for k in range(700):
        message: Any = flight.message(
            flight.send(level._replace(thrust=0.0 if k % every == 0 else 0.45))
        )
        heard = message.thrust if k < 500 else heard
        flight.receive(target(heard))
        assert k > 500 or flight.problem is None
    assert flight.problem.code is Code.UNHEARD


# --- velocity


@BOTH
def test_velocities_that_the_vehicle_does_not_follow_are_told_with_what_may_refuse_them(
    profile: Profile,
) -> None:
    flight = velocity_flight(profile, is_heading_frame=True)
    wanted = Velocity(1.0, 0.5, -0.25, 0.2)
    for _ in range(20):
        encoded = flight.send(wanted)
        message: Any = flight.message(encoded)
        assert encoded.action == pytest.approx(wanted, abs=0.003)
        flight.receive(VelocityTarget(3079, (0.3, 1.1, message.vz)))  # turned into NED
        assert flight.problem is None
    assert message.coordinate_frame == 8
    for _ in range(5):
        flight.send(wanted)
        flight.receive(VelocityTarget(3079, (0.0, 0.0, 0.0)))
    assert "limits or refuses them" in str(flight.output.overruled(flight.now_ns))


@pytest.mark.parametrize(
    ("up_mps", "down_mps", "asked_and_sent"),
    [
        (2.0, 1.0, ((-5.0, -2.0), (5.0, 1.0), (0.5, 0.5))),
        # a climb rate that cannot be turns no climb into a descent
        *((limit, limit, ((-2.0, 0.0), (0.0, 0.0), (2.0, 0.0))) for limit in (-20.0, -3.4e38)),
    ],
)
def test_px4_is_asked_for_no_climb_that_it_would_cut(
    up_mps: float, down_mps: float, asked_and_sent: tuple[tuple[float, float], ...]
) -> None:
    flight = velocity_flight(PX4)
    flight.vehicle.params.values = {"MPC_Z_VEL_MAX_UP": up_mps, "MPC_Z_VEL_MAX_DN": down_mps}
    for asked, sent in asked_and_sent:
        encoded = flight.send(Velocity(0.0, 0.0, asked, 0.0))
        message: Any = flight.message(encoded)
        assert message.vz == pytest.approx(sent, abs=0.003)
        assert encoded.action[2] == pytest.approx(sent, abs=0.003)


# --- release and refusals


@BOTH
def test_silence_is_the_release_and_ends_with_another_mode_or_by_itself(profile: Profile) -> None:
    for ends_by_mode in (True, False):
        flight = velocity_flight(profile)
        assert flight.is_released
        flight.send(Velocity(1.0, 0.0, 0.0, 0.0))
        assert not flight.is_released
        flight.output.released()
        assert flight.output.release_packet(flight.session, flight.now_ns) is None
        assert not flight.is_released
        if ends_by_mode:
            flight.vehicle.mode = profile.modes.roles.hold
        else:
            flight.now_ns += HELD_NS + 1
        assert flight.is_released


def test_what_is_no_such_action_never_leaves() -> None:
    nan, attitude, velocity = float("nan"), attitude_flight(PX4), velocity_flight(PX4)
    for flight, action in (
        (attitude, NEUTRAL),
        (attitude, Velocity(0.0, 0.0, 0.0, 0.0)),
        (attitude, BodyRates(0.5, nan, 0.0, 0.0)),
        (velocity, LEVEL),
        (velocity, Velocity(0.0, 0.0, nan, 0.0)),
    ):
        with pytest.raises(CommandRefusedError):
            flight.send(action)


@BOTH
def test_a_thrust_that_cannot_be_matched_to_the_vehicle_is_told_once(profile: Profile) -> None:
    flight = attitude_flight(profile)
    flight.send(LEVEL)
    (note,) = flight.vehicle.texts
    assert "hovers is not known" in note
    assert isinstance(note, AdviceText)  # told once
