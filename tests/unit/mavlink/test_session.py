"""The parts of a session, each a state machine without I/O."""

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as dialect

from mavbridge.core.address import LinkAddress, parse_address
from mavbridge.core.clock import NS_PER_MS, NS_PER_S
from mavbridge.core.errors import PeerError
from mavbridge.core.reasons import Code
from mavbridge.mavlink.codec.messages import (
    Altitude,
    Attitude,
    Endpoint,
    Heartbeat,
    LocalVelocity,
    ReceivedMessage,
    SpecificForce,
    Timesync,
)
from mavbridge.mavlink.session.discovery import VehicleDiscovery
from mavbridge.mavlink.session.telemetry import LinkCounters, TelemetryCollector
from mavbridge.mavlink.session.timesync import GOOD_EXCHANGES, TimesyncFilter

S = NS_PER_S


def heartbeat(vehicle_type: int = 2, autopilot: int = 3) -> Heartbeat:
    return Heartbeat(vehicle_type, autopilot, base_mode=1, custom_mode=0, system_status=0)


# --- discovery


def test_one_vehicle_is_chosen_once_a_second_one_would_have_been_heard() -> None:
    discovery = VehicleDiscovery(target_system=0)
    discovery.receive(Endpoint(255, 190), heartbeat(dialect.MAV_TYPE_GCS, 8), None, 0)
    discovery.receive(Endpoint(1, 154), heartbeat(dialect.MAV_TYPE_GIMBAL, 8), None, 0)
    assert discovery.choose(10 * S) is None
    discovery.receive(Endpoint(1, 1), heartbeat(), ("host", 5), 10 * S)
    assert discovery.choose(11 * S) is None
    peer = discovery.choose(12 * S)
    assert peer is not None
    assert (peer.source, peer.address, peer.autopilot) == (Endpoint(1, 1), ("host", 5), 3)


def test_two_vehicles_need_a_choice() -> None:
    discovery = VehicleDiscovery(target_system=0)
    discovery.receive(Endpoint(1, 1), heartbeat(), None, 0)
    discovery.receive(Endpoint(7, 1), heartbeat(), None, S)
    with pytest.raises(PeerError, match=r"\[1, 7\].*link.target_system"):
        discovery.choose(2 * S)
    chosen = VehicleDiscovery(target_system=7)
    chosen.receive(Endpoint(1, 1), heartbeat(), None, 0)
    assert chosen.choose(9 * S) is None
    assert "link.target_system" in chosen.describe(*hearing("udp:127.0.0.1:1"))
    chosen.receive(Endpoint(7, 1), heartbeat(autopilot=12), None, S)
    peer = chosen.choose(3 * S)
    assert peer is not None
    assert peer.autopilot == 12


def test_two_vehicles_of_one_id_cannot_be_told_apart() -> None:
    discovery = VehicleDiscovery(target_system=1)
    discovery.receive(Endpoint(1, 1), heartbeat(), ("host", 5), 0)
    discovery.receive(Endpoint(1, 1), heartbeat(), ("host", 6), S)
    with pytest.raises(PeerError, match=r"id 1 .*5.*6.*another id"):
        discovery.choose(2 * S)


def test_a_vehicle_that_was_followed_in_flight_is_not_sought_where_it_was() -> None:
    """Its heartbeat from there may come up to a second later."""
    discovery, start_ns = VehicleDiscovery(target_system=0), 100 * S
    discovery.receive(Endpoint(1, 1), heartbeat(), ("host", 5), start_ns)
    before = discovery.choose(start_ns + 2 * S)
    assert before is not None
    discovery.receive(Endpoint(1, 1), heartbeat(), ("host", 5), start_ns + 2 * S)
    followed = replace(before, address=("host", 6))
    assert discovery.moved(followed, start_ns + 3 * S) is None
    discovery.receive(Endpoint(1, 1), heartbeat(), ("host", 5), start_ns + 7 * S)
    assert discovery.moved(followed, start_ns + 7 * S) == before


def test_a_vehicle_that_changes_its_type_is_one_vehicle() -> None:
    """ArduPilot is a quadrotor until its motors are set up."""
    discovery = VehicleDiscovery(target_system=0)
    discovery.receive(Endpoint(1, 1), heartbeat(), ("host", 5), 0)
    discovery.receive(Endpoint(1, 1), heartbeat(dialect.MAV_TYPE_HEXAROTOR), ("host", 5), S // 2)
    assert discovery.choose(2 * S) is None, "one of the two may be damaged"
    discovery.receive(Endpoint(1, 1), heartbeat(dialect.MAV_TYPE_HEXAROTOR), ("host", 5), S)
    vehicle = discovery.choose(2 * S)
    assert vehicle is not None
    assert vehicle.vehicle_type == dialect.MAV_TYPE_HEXAROTOR
    assert discovery.moved(vehicle, 2 * S) is None
    discovery.receive(Endpoint(1, 1), heartbeat(dialect.MAV_TYPE_TRICOPTER), ("host", 5), 3 * S)
    assert discovery.moved(vehicle, 3 * S) is None, "a single heartbeat, which may be damaged"
    moved = discovery.moved(vehicle, 4 * S)
    assert moved == replace(vehicle, vehicle_type=dialect.MAV_TYPE_TRICOPTER)
    discovery.receive(Endpoint(1, 1), heartbeat(), ("host", 5), 4 * S)  # both: two, by a router
    with pytest.raises(PeerError, match="two vehicles"):
        discovery.choose(4 * S)


@pytest.mark.parametrize("types", ["242", "422", "224", "22422", "33322"])
def test_one_damaged_heartbeat_gives_a_vehicle_no_other_type(types: str) -> None:
    discovery = VehicleDiscovery(target_system=0)
    for at_s, digit in enumerate(types):
        discovery.receive(Endpoint(1, 1), heartbeat(int(digit)), ("host", 5), at_s * S)
    vehicle = discovery.choose(len(types) * S)
    assert vehicle is not None
    assert vehicle.vehicle_type == 2


@pytest.mark.parametrize(
    ("heard", "expected"),
    [
        ([], "heard nothing"),
        ([(Endpoint(255, 190), heartbeat(6, 8))], "heard only GCS (system 255, component 190)"),
        ([(Endpoint(1, 1), heartbeat(2, 8))], "no autopilot"),  # quadrotor type, but no autopilot
        ([(Endpoint(1, 42), heartbeat(2, 3))], "as system 1, component 42,"),
        ([(Endpoint(0, 1), heartbeat(2, 3))], "as system 0, component 1,"),
        ([(Endpoint(255, 191), heartbeat(18, 8))], "heard only what this computer sends"),
    ],
)
def test_other_senders_are_described(
    heard: list[tuple[Endpoint, Heartbeat]], expected: str
) -> None:
    discovery = VehicleDiscovery(target_system=0)
    for source, heartbeat in heard:
        discovery.receive(source, heartbeat, None, 0)
    assert discovery.choose(10 * S) is None
    assert expected in discovery.describe(*hearing("udp:127.0.0.1:14550"))


def hearing(
    spec: str, received_bytes: int = 0, received_packets: int = 0, loss: str = "", radio: int = 0
) -> tuple[LinkAddress, float, Any, int]:
    heard = SimpleNamespace(
        obstacles=lambda _now_ns: [],
        received_bytes=received_bytes,
        received_packets=received_packets,
        radio_packets=radio,
        loss=loss,
        source=Endpoint(255, 191),
    )
    return parse_address(spec), 5.0, heard, 0


@pytest.mark.parametrize(
    ("link", "expected"),
    [
        (hearing("/dev/ttyACM0,921600"), ("silent at 921600 baud", "TX and RX")),
        (
            hearing("/dev/ttyACM0,921600", 30_000),
            ("6.0 kB/s came", "is 921600 the vehicle's"),
        ),
        (hearing("/dev/ttyACM0,921600", 30_000, 9), ("without a heartbeat",)),
        (hearing("tcp:127.0.0.1:5760"), ("not a byte", "one client on TCP 5760")),
        (hearing("/dev/ttyACM0", 0, 0, "gone"), ("connection is lost (gone): plug it in",)),
        (hearing("tcp:127.0.0.1:5760", 99, 0, "ended"), ("lost (ended): is its server running?",)),
        (hearing("/dev/ttyACM0", 90, 9, radio=9), ("this end's telemetry radio", "paired")),
        (hearing("tcp:127.0.0.1:5760", 500), ("0.1 kB/s came", "or service", "a bridge")),
        (hearing("udp:127.0.0.1:14550"), ("send to port 14550",)),
        (hearing("udpout:127.0.0.1:14550"), ("nobody answered",)),
        (hearing("udp:127.0.0.1:14550", 500), ("another program",)),
    ],
)
def test_silence_is_explained_by_the_kind_of_link(link: Any, expected: tuple[str, ...]) -> None:
    told = VehicleDiscovery(target_system=0).describe(*link)
    assert all(part in told for part in expected), told


# --- timesync

BOOT_NS = 70 * S
"""Vehicle's clock minus ours, in these tests."""


def exchange(
    sync: TimesyncFilter, at_ns: int, *, up_ns: int, down_ns: int, offset_ns: int = BOOT_NS
) -> None:
    """One request and its answer, with the time that each takes."""
    ts1 = sync.request(at_ns)
    assert ts1 is not None
    answered_ns = at_ns + up_ns
    sync.receive(Timesync(tc1=answered_ns + offset_ns, ts1=ts1), answered_ns + down_ns)


def good_timesync(*, way_ns: int = NS_PER_MS) -> TimesyncFilter:
    sync = TimesyncFilter()
    for k in range(GOOD_EXCHANGES):
        assert not sync.is_good
        exchange(sync, k * S, up_ns=way_ns, down_ns=way_ns)
    assert sync.is_good
    return sync


def boot_us(at_ns: int) -> int:
    return (at_ns + BOOT_NS) // 1000


def paced_timesync(pace_at: Callable[[int], float]) -> TimesyncFilter:
    """Twelve seconds beside a clock of this pace at each moment."""
    sync, vehicle_ns = TimesyncFilter(), 0
    for at_ns in range(0, 12 * S, S // 5):
        vehicle_ns += round(pace_at(at_ns) * S / 5)
        ts1 = sync.request(at_ns)
        assert ts1 is not None
        sync.receive(Timesync(tc1=vehicle_ns, ts1=ts1), at_ns + 3 * NS_PER_MS)
    return sync


@pytest.mark.parametrize("pace", [0.1, 0.25, 0.5, 0.85])
def test_a_slow_clock_is_known_with_its_pace(pace: float) -> None:
    sync = paced_timesync(lambda _: pace)
    slow = sync.slow_clock
    assert slow is not None
    assert (slow.code, dict(slow.data)) == (Code.SLOW_CLOCK, {"pace": pytest.approx(pace)})


@pytest.mark.parametrize(
    "pace_at",
    [
        lambda _: 1.0,
        lambda _: 0.95,
        lambda _: 3.0,
        lambda at_ns: 0.0 if 9 * S < at_ns < 9.8 * S else 1.0,  # it stood still
        lambda at_ns: -6.0 if at_ns == 10 * S else 1.0,  # stepped back
        lambda at_ns: 0.25 if at_ns > 11 * S else 1.0,  # not for long
    ],
)
def test_a_clock_that_is_not_slow_all_the_time_is_not_called_slow(
    pace_at: Callable[[int], float],
) -> None:
    assert paced_timesync(pace_at).slow_clock is None


@pytest.mark.parametrize(
    ("answered_s", "offset_at", "told"),
    [
        (0, lambda _: BOOT_NS, ["TIMESYNC is not answered"]),
        (9, lambda _: BOOT_NS, ["TIMESYNC answers are too few"]),  # in flight
        (30, lambda at_ns: BOOT_NS + at_ns % (3 * S // 5) // 8, ["TIMESYNC answers are too few"]),
        (30, lambda _: BOOT_NS, []),
        (30, lambda at_ns: BOOT_NS - at_ns // 2, ["the vehicle's clock runs at 0.5"]),
    ],
)
def test_stamps_that_are_not_trusted_for_long_are_told_once(
    answered_s: int, offset_at: Callable[[int], int], told: list[str]
) -> None:
    texts: list[str] = []
    sync = TimesyncFilter(texts.append)
    for at_ns in range(S, 30 * S, S // 5):
        if at_ns < answered_s * S:
            exchange(sync, at_ns, up_ns=0, down_ns=NS_PER_MS, offset_ns=offset_at(at_ns))
        else:
            sync.request(at_ns)
    assert len(texts) == len(told)
    assert all(map(str.startswith, texts, told))


def test_things_happened_when_the_vehicle_says_once_the_offset_is_good() -> None:
    sync = TimesyncFilter()
    assert sync.happened_ns(boot_us(9 * S), 10 * S) == 10 * S
    assert (sync.offset_ns, sync.error_ns(10 * S), sync.is_good) == (None, None, False)
    sync = good_timesync()
    assert sync.happened_ns(boot_us(9 * S), 9 * S + 200 * NS_PER_MS) == 9 * S
    assert sync.happened_ns(boot_us(9 * S), 9 * S) == 9 * S
    assert sync.happened_ns(boot_us(9 * S + NS_PER_MS), 9 * S) == 9 * S  # never later
    assert sync.happened_ns(0, 9 * S) == 9 * S  # not stamped
    assert sync.happened_ns(1_700_000_000_000_000, 9 * S) == 9 * S  # Unix time
    assert (
        sync.happened_ns(5, 9 * S) < -69 * S
    )  # after a reboot that is not known yet: no new state


@given(
    clock_ms=st.one_of(
        st.integers(1, 2**32), st.integers(-60_000, 60_000).map(lambda ms: ms % 2**32)
    ),
    delay_ms=st.integers(0, 20 * 86_400_000),
)
def test_a_stamp_is_as_old_as_it_says_wherever_the_clock_stands(
    clock_ms: int, delay_ms: int
) -> None:
    """Also across the wrap of uint32 milliseconds, and beyond 30 s."""
    sync, offset_ns = TimesyncFilter(), clock_ms * NS_PER_MS + 2**32 * NS_PER_MS
    for k in range(GOOD_EXCHANGES):
        exchange(sync, k * S, up_ns=NS_PER_MS, down_ns=NS_PER_MS, offset_ns=offset_ns)
    now_ns = 9 * S
    stamp_ms = ((now_ns + offset_ns) // NS_PER_MS - delay_ms) % 2**32 or 1
    age_ms = (now_ns - sync.happened_ns(1000 * stamp_ms, now_ns)) / NS_PER_MS
    assert age_ms == pytest.approx(delay_ms, abs=1)


@pytest.mark.parametrize(
    ("way_ms", "ahead_ms", "is_future"),
    [
        *((1, 0, False), (1, 10, False), (1, 20, False)),
        *((1, 25, True), (1, 400, True), (1, 40_000, True), (1, 86_400_000, True)),
        *((200, 215, False), (200, 225, True)),  # the error of the offset is no future
    ],
)
def test_a_stamp_hardly_ahead_is_of_the_arrival_and_one_from_the_future_tells_no_age(
    way_ms: int, ahead_ms: int, is_future: bool
) -> None:
    sync, stamp_ns = good_timesync(way_ns=way_ms * NS_PER_MS), 9 * S + ahead_ms * NS_PER_MS
    assert sync.happened_ns(boot_us(stamp_ns), 9 * S) == (stamp_ns if is_future else 9 * S)


@pytest.mark.parametrize(("up_ms", "down_ms"), [(200, 200), (0, 400), (400, 0)])
def test_a_delay_that_begins_later_does_not_move_the_offset(up_ms: int, down_ms: int) -> None:
    sync = good_timesync()
    for k in range(10, 200):
        exchange(sync, k * S, up_ns=up_ms * NS_PER_MS, down_ns=down_ms * NS_PER_MS)
        assert sync.is_good
    assert sync.offset_ns == BOOT_NS
    assert sync.happened_ns(boot_us(300 * S), 300 * S + down_ms * NS_PER_MS) == 300 * S
    drift_ns = 200 * S // 10_000  # what it may have come to
    assert sync.error_ns(204 * S) == pytest.approx(NS_PER_MS + drift_ns, rel=1e-3)


def test_packets_that_begin_to_come_late_are_told_after_two_of_them() -> None:
    sync = good_timesync()
    exchange(sync, 10 * S, up_ns=200 * NS_PER_MS, down_ns=NS_PER_MS)
    assert sync.late_sending is None  # one may have waited
    exchange(sync, 11 * S, up_ns=180 * NS_PER_MS, down_ns=NS_PER_MS)
    assert sync.late_sending is not None
    assert sync.late_sending.code is Code.LATE_SENDING
    assert dict(sync.late_sending.data)["age_ms"] == pytest.approx(178.5, abs=0.5)
    exchange(sync, 12 * S, up_ns=NS_PER_MS, down_ns=NS_PER_MS)
    assert sync.late_sending is None
    exchange(sync, 13 * S, up_ns=310 * NS_PER_MS, down_ns=NS_PER_MS)
    assert sync.late_sending is not None


@pytest.mark.parametrize(
    ("way_ms", "up_ms", "down_ms"), [(1, 140, 1), (1, 1, 400), (300, 300, 300)]
)
def test_packets_that_come_soon_enough_or_were_as_slow_from_the_start_are_not_told(
    way_ms: int, up_ms: int, down_ms: int
) -> None:
    sync = good_timesync(way_ns=way_ms * NS_PER_MS)
    for k in range(10, 20):
        exchange(sync, k * S, up_ns=up_ms * NS_PER_MS, down_ns=down_ms * NS_PER_MS)
        assert sync.late_sending is None


def test_a_drifting_clock_is_followed() -> None:
    sync = good_timesync()
    for k in range(10, 1000):
        drifted_ns = BOOT_NS + k * 300_000  # 300 ppm, which a simulator on a busy computer has
        exchange(sync, k * S, up_ns=NS_PER_MS, down_ns=NS_PER_MS, offset_ns=drifted_ns)
        assert sync.is_good
        assert sync.offset_ns is not None
        assert abs(sync.offset_ns - drifted_ns) < 4 * NS_PER_MS


def test_a_clock_that_steps_is_not_trusted_until_exchanges_agree_again() -> None:
    sync = good_timesync()
    for k in range(GOOD_EXCHANGES):
        stepped_ns = BOOT_NS + S
        exchange(sync, (10 + k) * S, up_ns=1, down_ns=1, offset_ns=stepped_ns)
        assert sync.offset_ns == stepped_ns
        assert sync.is_good == (k == GOOD_EXCHANGES - 1)


def test_an_answer_that_is_dated_back_does_not_move_the_offset_and_a_step_back_does() -> None:
    """ArduPilot's, by bytes that wait at a slow port. Its stamps tell that it is no step."""
    sync = good_timesync()

    def stamped(at_ns: int) -> int:
        return sync.happened_ns(boot_us(at_ns), at_ns + 2 * NS_PER_MS)

    for k in range(100):
        at_ns = 10 * S + k * S // 5
        assert stamped(at_ns - 10 * NS_PER_MS) == at_ns - 10 * NS_PER_MS
        dated_ns = BOOT_NS - 29 * NS_PER_MS
        exchange(sync, at_ns, up_ns=4 * NS_PER_MS, down_ns=4 * NS_PER_MS, offset_ns=dated_ns)
        assert (sync.offset_ns, sync.is_good) == (BOOT_NS, True)
    stepped_ns = BOOT_NS - S
    for k in range(2):  # stamps before the step hide it from the first exchange
        exchange(sync, 40 * S + k * S // 5, up_ns=1, down_ns=1, offset_ns=stepped_ns)
        sync.happened_ns(boot_us(39 * S), 40 * S + k * S // 5)
    assert sync.offset_ns == stepped_ns


def test_a_clock_that_wavers_by_a_few_milliseconds_is_trusted() -> None:
    """The simulator's, against the wall clock; answers take almost no time."""
    sync = good_timesync()
    for k in range(1000):
        wavering_ns = BOOT_NS + (0, 4, -4, 2, -3)[k % 5] * NS_PER_MS
        exchange(sync, 10 * S + k * S // 5, up_ns=50_000, down_ns=50_000, offset_ns=wavering_ns)
        assert sync.is_good


def test_only_answers_to_our_own_requests_count() -> None:
    sync = TimesyncFilter()
    ts1 = sync.request(1_000)
    assert ts1 == 1_000
    assert sync.request(2_000) is None  # not due yet
    sync.receive(Timesync(tc1=0, ts1=ts1), 3_000)  # a request of another station
    sync.receive(Timesync(tc1=5, ts1=77), 3_000)  # an answer to another station
    assert sync.offset_ns is None
    sync.receive(Timesync(tc1=10_000, ts1=ts1), 5_000)
    sync.receive(Timesync(tc1=20_000, ts1=ts1), 5_000)  # answered twice
    assert sync.offset_ns == 10_000 - 3_000
    assert (sync.round_trips.count, sync.round_trips.max_ns) == (1, 4_000)


# --- telemetry and counters


def test_a_worse_message_never_overwrites_a_better_live_one() -> None:
    telemetry = TelemetryCollector()

    def force(source: str, value: float, at_ns: int) -> None:
        telemetry.receive(SpecificForce(source, at_ns // 1000, (value, 0, 0)), at_ns, at_ns)

    force("RAW_IMU", 1.0, 0)
    force("HIGHRES_IMU", 2.0, 1000)
    force("RAW_IMU", 3.0, 2000)
    assert telemetry.telemetry.specific_force_body_mps2 == (1000, (2.0, 0, 0), 0)
    force("SCALED_IMU2", 4.0, S)
    assert telemetry.telemetry.specific_force_body_mps2 == (S, (4.0, 0, 0), 0)

    def attitude(quaternion: bool, at_ns: int) -> None:
        body = Attitude(quaternion, 0, (1, 0, 0, 0), (0, 0, 0))
        telemetry.receive(body, at_ns, at_ns)

    attitude(True, 0)
    attitude(False, 1)
    assert telemetry.telemetry.rate_body_radps == (0, (0, 0, 0), 0)
    telemetry.receive(Altitude(489.4, 12.5, 0), 5, 5)
    assert telemetry.telemetry.height_above_home_m == (5, (12.5,), 0)


def velocities(*received: tuple[int, float, int]) -> list[tuple[float, int]]:
    """What is held after each of these, of (stamp in ms, value, delay in ms), one every 10 ms."""
    telemetry, held = TelemetryCollector(), []
    for k, (stamp_ms, value, delay_ms) in enumerate(received):
        arrived_ns = (1000 + k) * 10 * NS_PER_MS
        body = LocalVelocity(stamp_ms * 1000, (value, 0, 0))
        telemetry.receive(body, arrived_ns, arrived_ns - delay_ms * NS_PER_MS)
        reading = telemetry.telemetry.velocity_ned_mps
        assert reading is not None
        assert reading.happened_ns <= reading.arrived_ns <= arrived_ns
        held.append((reading.values[0], (arrived_ns - reading.happened_ns) // NS_PER_MS))
    return held


@pytest.mark.parametrize(
    ("received", "held"),
    [
        # the age counts from when it happened
        ([(5000, 1.0, 200), (5010, 2.0, 200)], [(1.0, 200), (2.0, 200)]),
        # a late datagram replaces nothing
        ([(5000, 1.0, 0), (4990, 2.0, 0), (5010, 3.0, 0)], [(1.0, 0), (1.0, 10), (3.0, 0)]),
        ([(0, 1.0, 0), (0, 2.0, 0)], [(1.0, 0), (2.0, 0)]),  # unstamped
        # the offset of the clocks has just become good, and tells of a delay of 35 ms
        (
            [(5000, 1.0, 0), (5010, 2.0, 35), (5020, 3.0, 35), (5030, 4.0, 30)],
            [(1.0, 0), (2.0, 10), (3.0, 20), (4.0, 30)],
        ),
    ],
)
def test_the_newest_reading_by_the_vehicles_clock_is_held(
    received: list[tuple[int, float, int]], held: list[tuple[float, int]]
) -> None:
    assert velocities(*received) == held


def numbered(sequence: int, packet: bytes) -> ReceivedMessage:
    return ReceivedMessage(Endpoint(1, 1), sequence, "ATTITUDE", None, packet, is_unusable=False)


@pytest.mark.parametrize(
    ("sequences", "lost"),
    [
        ((254, 255, 0, 2, 3), 1),  # a wrap is none
        ((254, 255, 1, 0, 2, 3), 0),  # overtaken
        ((254, 255, 255, 0, 0, 1), 0),  # doubled
        ((1, 2, 4, 2, 4, 5), 1),  # doubled, by a slower route
        ((0, 2, 1, 3, 5, 6), 1),
        ((7, 6, 8, 9), 0),  # the counters began between the two
        ((0, 201, 202, 203), 200),  # an outage
        ((5, 6, None, 99, 100), 0),  # another session
    ],
)
def test_gaps_in_the_sequence_are_losses(sequences: tuple[int | None, ...], lost: int) -> None:
    counters, received = LinkCounters(), len(set(sequences) - {None})
    assert (counters.lost_fraction, counters.messages_per_s) == (None, {})
    for k, sequence in enumerate(sequences):
        if sequence is None:
            counters.new_sequence()
        else:
            counters.receive("ATTITUDE", numbered(sequence, b"%d" % sequence), k * S)
    assert counters.lost_fraction == pytest.approx(lost / (lost + received))
    assert counters.messages_per_s == {"ATTITUDE": received / (len(sequences) - 1)}


def test_messages_of_a_router_that_does_not_number_count_and_their_copies_do_not() -> None:
    counters = LinkCounters()
    for k in range(11):
        for _ in range(2):
            counters.receive("ATTITUDE", numbered(0, b"%d" % k), k * S // 10)
    assert counters.messages_per_s == {"ATTITUDE": 11.0}
    assert counters.lost_fraction == 0.0
