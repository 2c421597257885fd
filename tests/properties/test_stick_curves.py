"""Any policy's sticks on any vehicle: the same motion, both ways, without a jump backwards."""

import math

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from helpers.stick_curves import copter_values, policy_motion, px4_motion
from mavbridge.core.vehicle import StickGains, Sticks
from mavbridge.mavlink.profiles.ardupilot_sticks import YawExpo, ardupilot_curves
from mavbridge.mavlink.profiles.px4 import PX4, CubicExpo
from mavbridge.mavlink.profiles.sticks import Half, StickCurves

dead_zones = st.integers(0, 50).map(lambda hundredths: hundredths / 100.0)
gains = st.builds(
    StickGains,
    lean_deg=st.floats(5.0, 60.0),
    yaw_rate_degps=st.floats(20.0, 400.0),
    climb_mps=st.floats(0.5, 8.0),
    descent_mps=st.floats(0.5, 8.0),
    lean_dead_zone=dead_zones,
    yaw_dead_zone=dead_zones,
    throttle_dead_zone=dead_zones,
)
positions = st.integers(-1000, 1000).map(lambda thousandths: thousandths / 1000.0)
sticks = st.builds(Sticks, throttle=positions, yaw=positions, pitch=positions, roll=positions)
px4_values = st.fixed_dictionaries(
    {
        "MPC_MAN_TILT_MAX": st.floats(5.0, 80.0),
        "MAN_DEADZONE": dead_zones,
        "MPC_MAN_Y_MAX": st.floats(20.0, 400.0),
        "MPC_Z_VEL_MAX_UP": st.floats(0.5, 8.0),
        "MPC_Z_VEL_MAX_DN": st.floats(0.5, 8.0),
        "MPC_YAW_EXPO": dead_zones,
        "MPC_Z_MAN_EXPO": st.sampled_from((0.0, 0.6, 1.0)),
    }
)
copters = st.builds(
    copter_values,
    ANGLE_MAX=st.floats(1000.0, 8000.0),
    PILOT_Y_RATE=st.floats(20.0, 400.0),
    PILOT_Y_EXPO=st.floats(-0.5, 1.0),
    PILOT_SPEED_UP=st.floats(50.0, 800.0),
    PILOT_SPEED_DN=st.integers(0, 800).map(float),
    THR_DZ=st.floats(0.0, 300.0),
    RC3_DZ=st.floats(0.0, 200.0),
    RC4_DZ=st.floats(0.0, 200.0),
    RC1_DZ=st.floats(0.0, 200.0),
    RC2_DZ=st.floats(0.0, 200.0),
)
curves = st.one_of(
    st.builds(PX4.stick_curves, px4_values, st.sampled_from(("ALTCTL", "STABILIZED")), gains),
    st.builds(ardupilot_curves, copters, st.sampled_from(("ALT_HOLD", "STABILIZE")), gains),
)


def below(value: float, ulps: int) -> float:
    """So many floats below ``value``."""
    for _ in range(ulps):
        value = math.nextafter(value, 0.0)
    return value


near_stops = st.builds(
    lambda sign, ulps: sign * below(1.0, ulps), st.sampled_from((-1, 1)), st.integers(0, 40)
)


def at_their_limits(found: StickCurves, moved: Sticks) -> set[str]:
    """Sticks of the vehicle at the greatest motion that it can do."""
    names = set()
    for name, axes in (("throttle", found.throttle), ("yaw", found.yaw)):
        stick = getattr(moved, name)
        half = None if axes is None else axes[1].above if stick >= 0.0 else axes[1].below
        names |= {name} if half is not None and abs(stick) >= half.end - 1e-9 else set()
    if found.lean is not None:
        lean = found.lean[1]
        motion = math.hypot(lean.pitch.motion(moved.pitch), lean.roll.motion(moved.roll))
        names |= {"pitch", "roll"} if motion >= lean.full * (1.0 - 1e-9) else set()
    return names


@given(px4_values, gains, sticks)
def test_the_motion_is_the_policys_unless_it_saturates(
    values: dict[str, float], meant_by: StickGains, given_sticks: Sticks
) -> None:
    found = PX4.stick_curves(values, "ALTCTL", meant_by)
    vehicles_sticks = found.to_vehicle(given_sticks)
    saturated = at_their_limits(found, vehicles_sticks)
    moved = px4_motion(vehicles_sticks, values)
    meant = policy_motion(given_sticks, meant_by)
    maps = (found.throttle, found.yaw, found.lean, found.lean)
    for name, by, got, wanted in zip(Sticks._fields, maps, moved, meant, strict=True):
        if name in saturated:
            assert abs(got) <= abs(wanted) + 1e-6
        elif by is not None:
            assert got == pytest.approx(wanted, rel=1e-6, abs=1e-6)


@given(curves, st.one_of(sticks, st.builds(Sticks, *[near_stops] * 4)))
def test_every_stick_stays_within_its_travel_and_on_its_side(
    found: StickCurves, given_sticks: Sticks
) -> None:
    for moved in (found.to_vehicle(given_sticks), found.to_policy(given_sticks)):
        for before, after in zip(given_sticks, moved, strict=True):
            assert -1.0 <= after <= 1.0
            assert before * after >= 0.0


bends = st.one_of(
    st.none(),
    st.sampled_from((0.96, 1.0)).map(CubicExpo),  # whose inverses were seen to round upwards
    st.floats(0.001, 1.0).map(CubicExpo),
    st.floats(-0.5, 0.95).map(YawExpo),
)
halves = st.builds(
    Half, full=st.floats(0.1, 2000.0), start=dead_zones, end=st.floats(0.6, 1.0), bend=bends
)


@given(halves, st.integers(0, 40), st.floats(0.0, 1.0))
@example(Half(150.0, 0.04, bend=CubicExpo(1.0)), 1, 0.0)
def test_a_half_maps_its_travel_onto_its_motion_to_the_last_bit(
    half: Half, ulps: int, share: float
) -> None:
    assert half.travel(half.full) == half.end
    assert half.motion(half.end) == half.full
    for motion in (below(half.full, ulps), share * half.full):
        assert 0.0 <= half.travel(motion) <= half.end
    for travel in (below(half.end, ulps), share * half.end):
        assert 0.0 <= half.motion(travel) <= half.full


@given(curves, sticks)
def test_the_other_way_round_leads_back(found: StickCurves, given_sticks: Sticks) -> None:
    moved = found.to_vehicle(given_sticks)
    again = found.to_vehicle(found.to_policy(moved))
    assert again == pytest.approx(moved, abs=1e-6)
    back, saturated = found.to_policy(moved), at_their_limits(found, moved)
    for axis, name in ((found.throttle, "throttle"), (found.yaw, "yaw")):
        if axis is not None and name not in saturated and getattr(moved, name) != 0.0:
            assert getattr(back, name) == pytest.approx(getattr(given_sticks, name), abs=1e-6)
    if found.lean is not None and "pitch" not in saturated and "roll" not in saturated:
        policy, _ = found.lean
        within = math.hypot(*map(policy.pitch.motion, given_sticks[2:])) <= policy.full
        for before, after, there in zip(given_sticks[2:], back[2:], moved[2:], strict=True):
            if within and there != 0.0:
                assert after == pytest.approx(before, abs=1e-6)


@given(curves, positions, positions, st.sampled_from(Sticks._fields))
def test_more_stick_is_never_less_motion(
    found: StickCurves, one: float, other: float, name: str
) -> None:
    low, high = sorted((one, other))
    centre = Sticks(0.0, 0.0, 0.0, 0.0)
    for move in (found.to_vehicle, found.to_policy):
        moved = [getattr(move(centre._replace(**{name: at})), name) for at in (low, high)]
        assert moved[0] <= moved[1] + 1e-12
