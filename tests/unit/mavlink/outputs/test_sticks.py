"""Sticks by MANUAL_CONTROL and by overrides: the vehicle's curves, the echo, the release."""

from types import SimpleNamespace
from typing import Any

import pytest

from helpers.fakes import FakeClock
from helpers.flown_vehicle import Flight, FlownVehicle, codec
from helpers.wire import ARDUPILOT as CALIBRATION
from mavbridge.core.clock import NS_PER_MS
from mavbridge.core.errors import PeerError
from mavbridge.core.reasons import Code
from mavbridge.core.vehicle import (
    NEUTRAL,
    ActionKind,
    ActionMeaning,
    AttitudeThrust,
    Output,
    Release,
    StickGains,
    Sticks,
)
from mavbridge.mavlink.codec.messages import ManualControl, RcChannels
from mavbridge.mavlink.codec.packets import CommandRefusedError
from mavbridge.mavlink.outputs.sender import ActionSender, choose_output
from mavbridge.mavlink.outputs.sticks import ManualControlOutput, OverrideOutput
from mavbridge.mavlink.profiles.ardupilot import ARDUPILOT
from mavbridge.mavlink.profiles.profile import Profile
from mavbridge.mavlink.profiles.px4 import PX4

MS = NS_PER_MS
PX4_VALUES = {
    "MPC_MAN_TILT_MAX": 35.0,
    "MPC_MAN_Y_MAX": 150.0,
    "MPC_Z_VEL_MAX_UP": 3.0,
    "MPC_Z_VEL_MAX_DN": 1.5,
    "MAN_DEADZONE": 0.1,
}
WANTED = Sticks(throttle=0.5, yaw=0.2, pitch=0.1, roll=-0.3)


def px4_flight(gains: StickGains | None = None) -> Flight:
    vehicle = FlownVehicle(PX4)
    vehicle.mode, vehicle.params.values = "ALTCTL", dict(PX4_VALUES)
    return Flight(ManualControlOutput(codec(), gains), vehicle)


def copter_flight(gains: StickGains | None = None) -> Flight:
    vehicle = FlownVehicle(ARDUPILOT, CALIBRATION)
    vehicle.mode = "ALT_HOLD"
    return Flight(OverrideOutput(codec(), gains), vehicle)


def echo(flight: Flight, action: Sticks, *, lost: int = 0) -> None:
    """Send sticks, which the vehicle shows, rounded down by so much."""
    message: Any = flight.message(flight.send(action))
    flight.receive(ManualControl(message.x - lost, message.y, message.z - lost, message.r))


# --- curves


def test_the_curves_follow_the_mode_at_once_and_the_parameters_soon() -> None:
    flight = px4_flight(StickGains())
    before = flight.send(WANTED).shown
    flight.vehicle.mode = "POSCTL"  # where sticks are something else
    assert flight.send(WANTED).shown[:3] == (100, -300, 750)  # type: ignore[index]
    flight.vehicle.mode = "ALTCTL"
    assert flight.send(WANTED).shown[:3] == before[:3]  # type: ignore[index]
    flight.vehicle.params.values["MPC_MAN_TILT_MAX"] = 20.0
    flight.now_ns += 500 * MS
    assert flight.send(WANTED).shown[1] < before[1]  # type: ignore[index]


def test_what_the_vehicle_cannot_do_is_told() -> None:
    flight = px4_flight(StickGains(climb_mps=6.0))
    flight.send(Sticks(1.0, 0.0, 0.0, 0.0))
    assert "climbs 3 m/s at most" in flight.vehicle.texts[0]


# --- overrides


@pytest.mark.parametrize(
    ("changes", "throttle_us"),
    [
        ({}, 1500),
        ({"mode": "RTL"}, 1500),
        ({"mode": "STABILIZE"}, 1700),  # where the middle of the throttle is thrust
        ({"has_receiver": True}, None),  # it has the sticks as soon as ours are released
        ({"armed": False}, None),
        ({"is_failsafe": True}, 1500),  # one that only warns
        ({"is_failsafe": True, "mode": "RTL"}, None),  # it would fire again
    ],
)
def test_level_sticks_go_ahead_of_a_release_that_would_keep_ours(
    changes: dict[str, Any], throttle_us: int | None
) -> None:
    flight = copter_flight()
    for name, value in changes.items():
        setattr(flight.vehicle, name, value)
    flight.send(Sticks(throttle=0.5, yaw=0.2, pitch=0.5, roll=-0.5))
    encoded = flight.output.last_sticks(flight.session, flight.now_ns)
    if throttle_us is None:
        assert encoded is None
        return
    assert encoded is not None
    message: Any = flight.message(encoded)
    roll, pitch, throttle, yaw = (getattr(message, f"chan{n}_raw") for n in (1, 2, 3, 4))
    assert (roll, pitch, yaw) == (1500, 1500, 1500)
    assert throttle == pytest.approx(throttle_us, abs=8)


# --- MANUAL_CONTROL


@pytest.mark.parametrize(
    ("shown", "code", "expected"),
    [
        (ManualControl(300, 0, 700, 0), Code.OVERRULED, "another station sends sticks"),
        (ManualControl(0, 0, 500, 0), Code.UNHEARD, "our sticks"),
        (None, Code.NO_ECHO, "our sticks are not heard, or"),
    ],
)
def test_what_px4_acts_on_instead_of_our_sticks_is_told(
    shown: ManualControl | None, code: Code, expected: str
) -> None:
    flight = px4_flight()
    for _ in range(50):
        echo(flight, NEUTRAL)
    since_ns = flight.now_ns
    while flight.problem is None and flight.now_ns - since_ns < 2000 * MS:
        flight.send(NEUTRAL)
        if shown is not None:
            flight.receive(shown)
    assert flight.problem.code is code
    assert expected in str(flight.problem)
    assert flight.now_ns - since_ns < 500 * MS


@pytest.mark.parametrize("first_ms", range(10, 200, 20))
@pytest.mark.parametrize(
    ("shown", "code"),
    [((0, 0, 0, 0), Code.UNHEARD), ((300, 0, 0, 0), Code.OVERRULED)],
    ids=["at rest", "in a hand"],
)
def test_a_px4_that_misses_us_and_follows_its_receiver_is_no_takeover_unless_a_hand_is_seen(
    first_ms: int, shown: tuple[int, ...], code: Code
) -> None:
    """It shows our last for 0.5 s, every 200 ms, and once a second more often, then a receiver's.

    Taken for a takeover, it was released to an idle throttle.
    """
    flight = px4_flight()
    flight.receive(ManualControl(0, 0, 0, 0))
    for _ in range(50):
        echo(flight, WANTED)
    since_ns, last = flight.now_ns, flight.message(flight.send(WANTED))
    held = ManualControl(last.x, last.y, last.z, last.r)
    due = [(at_ms, held) for at_ms in range(first_ms, 500, 200)]
    due += [(due[-1][0] + 200 + more_ms, ManualControl(*shown)) for more_ms in (0, 200, 400)]
    flight.receive(held)
    for at_ms, values in due:
        while flight.now_ns < since_ns + at_ms * MS:
            flight.send(WANTED._replace(roll=0.3 - at_ms / 1000))
        flight.receive(values)
    assert flight.problem.code is code


NEUTRAL_SENT = (0, 0, 500, 0)


@pytest.mark.parametrize("is_restarted", [False, True])
@pytest.mark.parametrize(
    ("mode", "has_receiver", "last"),
    [
        ("ALTCTL", False, NEUTRAL_SENT),
        ("STABILIZED", False, (0, 0, 650, 0)),  # where the middle of the throttle is thrust
        ("ALTCTL", True, NEUTRAL_SENT),  # which PX4 prefers to the receiver until it is lost
        ("AUTO.LOITER", False, None),  # which would take them for a pilot's hand
        ("OFFBOARD", False, None),
    ],
)
def test_the_last_sticks_are_neutral_ones_where_sticks_are_flown(
    mode: str, has_receiver: bool, last: tuple[int, ...] | None, is_restarted: bool
) -> None:
    """Also of a session that starts over in the air: a reboot may be but a wrong stamp."""
    flight = px4_flight()
    flight.vehicle.mode, flight.vehicle.has_receiver = mode, has_receiver
    assert flight.status.mode == mode
    flight.send(Sticks(0.3, 0.2, 0.5, -0.5))
    if is_restarted:
        flight.output.restart()
        flight.vehicle.is_known = False
    packet = flight.output.release_packet(flight.session, flight.now_ns)
    sent = [(m.x, m.y, m.z, m.r) for m in flight.end.read(packet or b"")]
    assert sent == ([] if last is None else [last])


@pytest.mark.parametrize("after_ms", [50, 650, 750])
def test_a_hold_that_our_moving_sticks_end_leaves_px4_with_level_ones(after_ms: int) -> None:
    """PX4 takes them for the hand of the pilot who has chosen it: POSCTL, on our last sticks."""
    flight, clock, packets = px4_flight(), FakeClock(), list[bytes]()
    connection: Any = SimpleNamespace(send=lambda packet: packets.append(packet) or True)
    sender = ActionSender(connection, codec(), clock)
    sender.begin_flight(ActionMeaning(kind="sticks"), None)
    sender.equip(flight.session)
    sender.send(Sticks(0.3, 0.2, 0.5, -0.5))
    flight.vehicle.mode = "AUTO.LOITER"
    for k in range(100):
        if k * 10 == after_ms:
            flight.vehicle.mode = "POSCTL"
        sender.send(Release())
        clock.advance_ns(10 * MS)
    _, *levels = (flight.end.read(packet)[0] for packet in packets)
    expected = [NEUTRAL_SENT] if after_ms < 700 else []  # it holds none by then
    assert [(m.x, m.y, m.z, m.r) for m in levels] == expected


def test_the_pilots_sticks_are_those_that_px4_shows_without_ours() -> None:
    flight = px4_flight()
    assert flight.status.rc_sticks is None
    flight.receive(ManualControl(100, -200, 750, 300))
    pilot = Sticks(throttle=0.5, yaw=0.3, pitch=0.1, roll=-0.2)
    assert flight.status.rc_sticks == flight.status.pilot_sticks == pilot
    assert flight.status.rc_arrived_ns == flight.now_ns
    echo(flight, NEUTRAL)
    assert flight.status.rc_sticks == pytest.approx(NEUTRAL, abs=0.01)
    assert flight.status.pilot_sticks == pilot


@pytest.mark.parametrize("gap_ms", [50, 440, 500, 700, 950])
def test_other_sticks_are_told_in_time_however_seldom_they_are_shown(gap_ms: int) -> None:
    flight = px4_flight()
    flight.receive(ManualControl(300, -200, 600, 0))
    begun_ns = shown_ns = flight.now_ns
    while flight.problem is None:
        flight.send(Sticks(0.2, 0.1, -0.2, 0.3))
        if flight.now_ns - shown_ns >= gap_ms * MS:
            shown_ns = flight.now_ns
            flight.receive(ManualControl(300, -200, 600, 0))
        assert flight.now_ns - begun_ns < 1_100 * MS
    assert flight.problem.code is Code.OVERRULED


def test_a_release_that_comes_late_does_not_reach_who_flies_by_then() -> None:
    flight = px4_flight()
    flight.send(Sticks(0.2, 0.1, -0.2, 0.3))
    for later_ms, is_sent in ((0, True), (700, True), (701, False), (60_000, False)):
        packet = flight.output.release_packet(flight.session, flight.now_ns + later_ms * MS)
        assert (packet is not None) is is_sent


def test_sticks_are_released_once_others_are_shown_or_none() -> None:
    for shown in (ManualControl(200, 0, 400, 0), None):
        flight = px4_flight()
        for _ in range(20):
            echo(flight, NEUTRAL)
        flight.output.released()
        for after_ms in (200, 400, 600):  # it repeats them until they count as lost
            flight.now_ns += 199 * MS
            flight.receive(ManualControl(*NEUTRAL_SENT))
            assert not flight.is_released, after_ms
        if shown is not None:
            flight.receive(shown)
        else:
            flight.now_ns += 210 * MS
        assert flight.is_released


# --- overrides


@pytest.mark.parametrize(
    ("mode", "throttle", "yaw"),
    [("STABILIZE", -1.0, 0.8), ("ACRO", -0.5, 0.8), ("ACRO", -0.49, 1.0), ("ALT_HOLD", -1.0, 1.0)],
)
@pytest.mark.parametrize("side", [1, -1])
def test_no_throttle_and_yaw_of_a_policy_disarm_a_copter_in_the_air(
    mode: str, throttle: float, yaw: float, side: int
) -> None:
    flight = copter_flight()
    flight.vehicle.mode = mode
    sent = flight.send(Sticks(throttle, float(side), 0.0, 0.0)).action
    assert isinstance(sent, Sticks)
    assert (sent.throttle, sent.yaw) == pytest.approx((throttle, side * yaw), abs=0.005)


@pytest.mark.parametrize(
    ("shown_us", "code"),
    [((1500, 1500, 1000, 1500), Code.UNHEARD), ((1500, 1500, 1600, 1500), Code.OVERRULED)],
)
def test_a_receiver_is_known_by_what_it_showed_before_the_output_was_chosen(
    shown_us: tuple[int, ...], code: Code
) -> None:
    """With --arm, the first RC_CHANNELS that the output sees may show our sticks already."""
    flight = copter_flight()
    flight.vehicle.rc_channels_us = (1500, 1500, 1000, 1500)
    for k in range(120):
        message: Any = flight.message(flight.send(Sticks(0.3, 0.0, 0.0, 0.2)))
        ours_us = tuple(getattr(message, f"chan{n}_raw") for n in (1, 2, 3, 4))
        if k < 50:
            held_us = ours_us
        is_over = k >= 100  # RC_OVERRIDE_TIME
        flight.receive(RcChannels(shown_us if is_over else held_us, flight.now_ns // 1000))
    assert flight.problem.code is code


def test_other_actions_than_sticks_are_refused() -> None:
    for flight in (px4_flight(), copter_flight()):
        with pytest.raises(CommandRefusedError, match="not sticks"):
            flight.send(AttitudeThrust(0.5, 0.0, 0.0, 0.0))


# --- the choice


@pytest.mark.parametrize(
    ("profile", "kind", "output", "advice"),
    [
        (PX4, "sticks", "rc-override", "--output manual-control"),
        (ARDUPILOT, "sticks", "manual-control", "--output rc-override"),
        (ARDUPILOT, "sticks", "velocity", "--output auto, which is rc-override here"),
        (PX4, "velocity", "manual-control", "--output auto, which is velocity here"),
        (PX4, "rates", "attitude", "--output auto, which is rates here"),
    ],
)
def test_an_output_that_makes_no_sense_is_refused(
    profile: Profile, kind: ActionKind, output: Output, advice: str
) -> None:
    with pytest.raises(PeerError, match=advice):
        choose_output(ActionMeaning(kind=kind), output, profile, codec())
