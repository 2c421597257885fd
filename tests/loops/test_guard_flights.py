"""What only a whole flight shows: ways of the sticks and gaps of the link."""

from dataclasses import replace
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as dialect

from helpers.guard_flights import MS
from helpers.output_flights import HOVERING, LEANING, OutputFlight
from helpers.wire import WireEnd
from mavbridge.core.clock import NS_PER_S
from mavbridge.core.reasons import Code, because
from mavbridge.guard.values import Phase
from mavbridge.mavlink.outputs.sender import LEVELS
from mavbridge.mavlink.transport.connection import REFUSED_NS
from mavbridge.simulation.world import NOMINAL_VEHICLE
from policy.contract import ActionKind
from policy.motion.controllers import Motion, Program, Push
from sitl.ardupilot.flight_modes import Mode
from sitl.vehicle.config import MID_RECEIVER_US, AutopilotName

SLOT_S = 0.01


def copter(program: Program = LEANING, **config: Any) -> OutputFlight:
    return OutputFlight("ardupilot", "sticks", program, **config)


def from_ground(**config: Any) -> OutputFlight:
    """A flight that arms, climbs to 3 m and leans."""
    return copter(in_air=False, arm=True, **config)


def climb(flight: OutputFlight) -> None:
    flight.until(lambda: flight.phase is Phase.FLYING and flight.height_m > 2, within_s=16)


def overrides(flight: OutputFlight, since_ns: int) -> list[tuple[int, ...]]:
    """First four channels of each sent RC_CHANNELS_OVERRIDE [us]."""
    return [
        (m.chan1_raw, m.chan2_raw, m.chan3_raw, m.chan4_raw)
        for _, m in flight.left(since_ns)
        if m.get_type() == "RC_CHANNELS_OVERRIDE"
    ]


def refuse(flight: OutputFlight, *, is_refused: bool = True) -> None:
    network = flight.network
    if is_refused:
        network.send = lambda data, peer=None: False  # type: ignore[method-assign]
    else:
        del network.send  # type: ignore[attr-defined]


# --- who has the sticks


def test_another_stations_sticks_release_ours_and_no_mode_command_ever_leaves() -> None:
    """At 10 Hz each of them is shown for a third of a send period only."""
    flight = copter().fly()

    def send() -> None:
        us = (1700, 1450, 1600, 1500, 0, 0, 0, 0)
        flight.station(lambda mav: mav.rc_channels_override_encode(1, 1, *us))
        flight.clock.schedule(flight.clock.now_ns() + NS_PER_S // 10, send)

    # Halfway between two of our sends: just before one it would never be shown.
    flight.clock.schedule(flight.clock.now_ns() + 13 * MS // 2, send)
    flight.until(lambda: flight.phase is not Phase.FLYING, within_s=0.5)
    given_ns = flight.clock.now_ns()
    flight.run(1.5)
    assert flight.phase is Phase.RELEASED
    assert flight.reason == because(
        Code.OVERRULED, quantity="sticks", output="rc-override", fault="foreign"
    )
    assert not flight.modes_asked()
    assert set(overrides(flight, given_ns - MS)) == {(0, 0, 0, 0)}, "nothing but releases"


def test_without_a_receiver_no_takeover_leaves_a_lean_behind() -> None:
    """A release alone keeps the last sticks there: for 1 s, or for ever with FS_THR_ENABLE 0."""
    flight = from_ground(has_receiver=False)
    flight.until(lambda: flight.samples and flight.samples[-1].lean_deg > 10, within_s=25)
    before_ns = flight.clock.now_ns()
    flight.command(dialect.MAV_CMD_DO_SET_MODE, 1, Mode.STABILIZE)
    flight.until(lambda: flight.phase is not Phase.FLYING, within_s=0.2)
    given_ns, given_s = flight.clock.now_ns(), flight.t_s
    flight.run(0.9)
    assert flight.samples[-1].mode == "STABILIZE"
    assert not flight.modes_asked(before_ns)
    sent = overrides(flight, given_ns - MS)
    levels, releases = sent[:LEVELS], sent[LEVELS:]
    assert {(roll, pitch, yaw) for roll, pitch, _, yaw in levels} == {(1500, 1500, 1500)}
    assert len(releases) > 10
    assert set(releases) == {(0, 0, 0, 0)}
    sticks = [e["us"] for e in flight.summary["sticks"] if e["t_s"] >= given_s + 0.02]
    assert sticks
    assert all(us[0] == us[1] == us[3] == 1500 for us in sticks)


def test_without_a_receiver_a_release_that_cannot_be_seen_ends_and_lets_others_override() -> None:
    """The vehicle shows for ever what it heard last, here older sticks than our last."""
    flight = from_ground(has_receiver=False)
    climb(flight)
    since_ns = flight.clock.now_ns()
    flight.up.is_silent = True
    flight.until(lambda: flight.phase is Phase.RELEASING, within_s=1.2)
    assert flight.ardupilot.mode is Mode.RTL
    flight.up.is_silent = False
    flight.until(lambda: flight.phase is Phase.RELEASED, within_s=4.1)
    assert 70 < overrides(flight, since_ns).count((0, 0, 0, 0)) <= 80


def test_a_second_flight_without_a_receiver_is_held_at_its_end_as_the_first_was() -> None:
    """The end of an earlier flight's overrides is a radio failsafe while disarmed, too."""
    flight = from_ground(has_receiver=False)
    for us in (1500, 0):
        flight.ardupilot.rc.override((us,) * 4, flight.ardupilot.now_ns)
        flight.run(0.1)
    flight.until(lambda: flight.ardupilot.in_failsafe, within_s=1.1)
    climb(flight)
    flight.stop()
    flight.run(2.0)
    assert flight.phase is Phase.HOLDING, flight.describe()
    assert flight.ardupilot.mode is Mode.LAND
    assert not flight.ardupilot.in_failsafe


def test_arm_reads_the_pilots_sticks_first_where_a_station_has_set_the_streams_before() -> None:
    """RC_CHANNELS that comes before the calibration shows a receiver, but not its sticks."""
    flight = from_ground()
    end = WireEnd(system=42, component=190)
    for name in (dialect.MAVLINK_MSG_ID_RC_CHANNELS, dialect.MAVLINK_MSG_ID_SYS_STATUS):
        interval = dialect.MAV_CMD_SET_MESSAGE_INTERVAL, 0, name, 500_000, 0, 0, 0, 0, 0
        asked = end.pack(end.mav.command_long_encode(1, 1, *interval))
        flight.vehicle.receive(0, asked, flight.clock.now_ns())
    climb(flight)
    flight.act("release")
    flight.until(lambda: flight.phase is Phase.RELEASED, within_s=3)
    assert flight.ardupilot.mode is Mode.ALT_HOLD, flight.describe()


@pytest.mark.parametrize(
    ("lost", "gap_s"),
    [("refused", 0.15), ("to the vehicle", 1.0), ("from the vehicle", 4.0)],
)
def test_a_gap_of_the_link_delays_arming_and_never_prevents_it(lost: str, gap_s: float) -> None:
    """Nothing is sent meanwhile: what the echo shows then must not keep us from trying again."""
    flight = from_ground(has_receiver=False, mode="ALT_HOLD")
    flight.until(lambda: flight.phase is Phase.PREPARING, within_s=12)
    if lost == "refused":
        refuse(flight)
    flight.up.is_silent, flight.down.is_silent = lost == "to the vehicle", lost.startswith("from")
    flight.run(gap_s)
    if lost == "refused":
        refuse(flight, is_refused=False)
    flight.up.is_silent = flight.down.is_silent = False
    flight.until(lambda: flight.phase is Phase.FLYING, within_s=5)


# --- packets that do not pass


def test_a_vehicle_of_an_older_release_is_flown_once_it_listens_to_us() -> None:
    vehicle = replace(NOMINAL_VEHICLE, ardupilot_release="4.6")
    flight = from_ground(vehicle=vehicle, params={"MAV_GCS_SYSID": 42.0})
    flight.until(lambda: Code.OBSTACLE in flight.codes, within_s=12)
    assert flight.phase is not Phase.FLYING
    assert "--set-config link.source_system=42" in str(flight.reason)

    station = WireEnd(system=42, component=190)
    mended = station.pack(station.mav.param_set_encode(1, 1, b"SYSID_MYGCS", 255.0, 9))
    flight.vehicle.receive(0, mended, flight.clock.now_ns())  # on our link: we hear the answer
    climb(flight)
    assert "4.6.3" in flight.link.autopilot


def test_nothing_flies_before_the_message_that_shows_our_setpoints_is_granted() -> None:
    """Else the first flight ended after a second for want of it, as the requests were lost."""
    flight = OutputFlight("ardupilot", "velocity", HOVERING)
    end, send, lost = WireEnd(), flight.up.send, []

    def lose_three(data: bytes) -> None:
        wanted = dialect.MAVLINK_MSG_ID_POSITION_TARGET_LOCAL_NED
        asked = [m for m in end.read(data) if getattr(m, "param1", None) == wanted]
        lost.extend(asked)
        if not asked or len(lost) > 3:
            send(data)

    flight.up.send = lose_three  # type: ignore[method-assign]
    flight.fly(2.0)


@pytest.mark.parametrize(("autopilot", "kind"), [("ardupilot", "sticks"), ("px4", "rates")])
def test_in_flight_refused_packets_are_a_fault_of_the_link_after_100_ms(
    autopilot: AutopilotName, kind: ActionKind
) -> None:
    flight = OutputFlight(autopilot, kind).fly()
    refuse(flight)
    took_s = flight.until(lambda: flight.phase is not Phase.FLYING, within_s=0.5)
    assert took_s <= REFUSED_NS / 1e9 + 2 * SLOT_S
    assert flight.phase is Phase.LEAVING
    assert flight.guard.guard.engagement.outcome.end == "fault"


def test_after_refused_packets_the_sticks_go_on_from_those_that_were_sent() -> None:
    flight = copter().fly()
    held = flight.ticks[-1].sent
    flight.program = Program(motion=lambda _: Motion(push=Push("roll", -0.8)))
    refuse(flight)
    flight.run(0.06)
    refuse(flight, is_refused=False)
    resumed_ns = flight.clock.now_ns()
    flight.run(0.03)
    first = next(tick.sent for tick in flight.ticks if tick.sent and tick.sent_ns >= resumed_ns)
    assert first == pytest.approx(held, abs=0.03)


@pytest.mark.parametrize(
    ("autopilot", "kind", "share"),
    [
        ("ardupilot", "velocity", 0.5),
        ("px4", "rates", 0.25),
    ],
)
def test_sticks_that_wait_in_a_full_queue_end_the_flight(
    autopilot: AutopilotName, kind: ActionKind, share: float
) -> None:
    flight = OutputFlight(autopilot, kind).fly()
    sent = [data for _, data in flight.up.sent]
    at_ns = flight.clock.now_ns()
    flight.run(1.0)
    needed = sum(len(data) for _, data in flight.up.sent[len(sent) :])
    flight.up.bytes_per_s = share * needed * 1e9 / (flight.clock.now_ns() - at_ns)
    flight.until(lambda: flight.phase is not Phase.FLYING, within_s=4.0)


def test_a_release_that_cannot_be_sent_goes_out_first_when_the_connection_is_back() -> None:
    flight = copter(on_fault="release").fly()
    flight.network.is_down = True
    flight.stop()
    flight.run(1.5)
    flight.network.is_down = False
    back_ns = flight.clock.now_ns()
    flight.until(lambda: flight.guard.is_done, within_s=4)
    flight.run(0.05)

    first = flight.left(back_ns)[0][1]
    assert first.get_type() == "RC_CHANNELS_OVERRIDE"
    assert first.chan1_raw == 0
    assert flight.ardupilot.sticks_us == MID_RECEIVER_US[:4]
