"""The parts of a session, each a state machine without I/O."""

import pytest
from pymavlink.dialects.v20 import ardupilotmega as dialect

from helpers.wire import CALIBRATION
from mavbridge.core.clock import NS_PER_MS, NS_PER_S
from mavbridge.core.errors import PeerError, UserError
from mavbridge.mavlink.codec.messages import (
    Attitude,
    CommandAck,
    CommandRequest,
    Endpoint,
    Heartbeat,
    ParamValue,
    SpecificForce,
    StreamRequest,
    Timesync,
)
from mavbridge.mavlink.session import params, streams
from mavbridge.mavlink.session.discovery import VehicleDiscovery
from mavbridge.mavlink.session.echo import NUDGE_US, EchoCheck
from mavbridge.mavlink.session.modes import ModeTable
from mavbridge.mavlink.session.stats import LinkCounters
from mavbridge.mavlink.session.telemetry import TelemetryCollector
from mavbridge.mavlink.session.timesync import TimesyncFilter

S = NS_PER_S


def heartbeat(vehicle_type: int = 2, autopilot: int = 3) -> Heartbeat:
    return Heartbeat(vehicle_type=vehicle_type, autopilot=autopilot, base_mode=1, custom_mode=0)


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
    assert (peer.source, peer.address, peer.autopilot) == (Endpoint(1, 1), ("host", 5), "ardupilot")


def test_two_vehicles_need_a_choice() -> None:
    discovery = VehicleDiscovery(target_system=0)
    discovery.receive(Endpoint(1, 1), heartbeat(), None, 0)
    discovery.receive(Endpoint(7, 1), heartbeat(), None, S)
    with pytest.raises(PeerError, match=r"\[1, 7\].*--target-system"):
        discovery.choose(2 * S)
    chosen = VehicleDiscovery(target_system=7)
    chosen.receive(Endpoint(1, 1), heartbeat(), None, 0)
    assert chosen.choose(9 * S) is None
    assert "--target-system" in chosen.describe()
    chosen.receive(Endpoint(7, 1), heartbeat(autopilot=12), None, S)
    peer = chosen.choose(3 * S)
    assert peer is not None
    assert peer.autopilot == "px4"


def test_two_vehicles_of_one_id_cannot_be_told_apart() -> None:
    discovery = VehicleDiscovery(target_system=1)
    discovery.receive(Endpoint(1, 1), heartbeat(), ("host", 5), 0)
    discovery.receive(Endpoint(1, 1), heartbeat(), ("host", 6), S)
    with pytest.raises(PeerError, match=r"id 1 .*5.*6.*another id"):
        discovery.choose(2 * S)


def test_a_vehicle_that_speaks_from_a_new_address_has_moved() -> None:
    discovery = VehicleDiscovery(target_system=0)
    discovery.receive(Endpoint(1, 1), heartbeat(), ("host", 5), 0)
    old = discovery.choose(2 * S)
    assert old is not None
    discovery.receive(Endpoint(1, 1), heartbeat(), ("host", 6), 2 * S)
    assert discovery.moved(old, 5 * S // 2) is None  # it was heard at both just now
    discovery.receive(Endpoint(1, 1), heartbeat(), ("host", 6), 4 * S)
    moved = discovery.moved(old, 4 * S)
    assert moved is not None
    assert moved.address == ("host", 6)


@pytest.mark.parametrize(
    ("heard", "expected"),
    [
        ([], "heard nothing"),
        ([(Endpoint(255, 190), heartbeat(6, 8))], "heard only GCS (system 255, component 190)"),
        ([(Endpoint(1, 1), heartbeat(2, 8))], "no autopilot"),  # quadrotor type, but no autopilot
    ],
)
def test_other_senders_are_described(
    heard: list[tuple[Endpoint, Heartbeat]], expected: str
) -> None:
    discovery = VehicleDiscovery(target_system=0)
    for source, heartbeat in heard:
        discovery.receive(source, heartbeat, None, 0)
    assert discovery.choose(10 * S) is None
    assert expected in discovery.describe()


# --- modes


def test_mode_names_of_both_autopilots() -> None:
    copter = ModeTable(autopilot="ardupilot", vehicle_type=dialect.MAV_TYPE_QUADROTOR)
    assert copter.name(2) == "ALT_HOLD"
    assert copter.number("alt_hold") == 2
    assert copter.name(99) == "99"
    px4 = ModeTable(autopilot="px4", vehicle_type=dialect.MAV_TYPE_QUADROTOR)
    assert px4.name(3 << 16 | 2 << 24) == "POSCTL"
    assert px4.number("ACRO") == 5
    with pytest.raises(UserError, match="no mode 'HOVER'; it has ACRO"):
        copter.number("HOVER")


# --- parameters


def test_parameters_are_requested_a_few_at_a_time_and_again_when_lost() -> None:
    names = tuple(f"P{k}" for k in range(20))
    reader = params.ParamReader(names)
    first = [request.name for request in reader.step(0)]
    assert first == list(names[:16])
    assert list(reader.step(S // 10)) == []
    for name in first[1:]:
        reader.receive(ParamValue(name=name, value=1.0))
    again = [request.name for request in reader.step(S)]
    assert again == ["P0", *names[16:]]
    for name in again:
        reader.receive(ParamValue(name=name, value=2.0))
    assert reader.is_done
    assert reader.values["P0"] == 2.0


def test_a_parameter_that_does_not_exist_is_given_up() -> None:
    reader = params.ParamReader(("NONE",))
    requested = sum(len(list(reader.step(k * S))) for k in range(20))
    assert requested == 4
    assert reader.is_done
    assert reader.values == {}


def test_calibration_comes_from_the_vehicle() -> None:
    ours = params.calibration(CALIBRATION | {"RC2_REVERSED": 1.0, "RC2_TRIM": 1510.0})
    assert ours.pitch.number == 2
    assert ours.pitch.is_reversed
    assert ours.pitch.trim_us == 1510
    assert ours.throttle_floor_us == 985


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"RC1_MIN": None}, "RC1_MIN"),
        ({"RCMAP_YAW": 3.0}, "two sticks on one channel"),
        ({"RC4_MAX": 900.0}, "unusable"),
    ],
)
def test_an_unusable_calibration_is_the_peers_error(
    change: dict[str, float | None], message: str
) -> None:
    values = {k: v for k, v in (CALIBRATION | change).items() if v is not None}
    with pytest.raises(PeerError, match=message):
        params.calibration(values)


@pytest.mark.parametrize(
    ("values", "source_system", "expected"),
    [
        ({"MAV_GCS_SYSID": 255.0}, 255, None),
        ({"MAV_GCS_SYSID": 255.0}, 42, "--source-system 255"),
        ({"MAV_GCS_SYSID": 240.0, "MAV_GCS_SYSID_HI": 250.0}, 245, None),
        ({"MAV_GCS_SYSID": 240.0, "MAV_GCS_SYSID_HI": 0.0}, 245, "obeys system 240"),
        ({"SYSID_MYGCS": 252.0}, 255, "obeys system 252"),
        ({"RC_OPTIONS": 34.0}, 255, "RC_OPTIONS bit 1"),
        ({"RC_OPTIONS": 32.0}, 255, None),
        ({"RC_OVERRIDE_TIME": 0.0}, 255, "RC_OVERRIDE_TIME is 0"),
    ],
)
def test_obstacles_are_read_from_parameters(
    values: dict[str, float], source_system: int, expected: str | None
) -> None:
    found = list(params.override_obstacles(values, source_system))
    assert found == [] if expected is None else expected in found[0]


def test_the_override_switch_is_found() -> None:
    assert params.override_switch({"RC7_OPTION": 46.0, "RC8_OPTION": 31.0}) == 7
    assert params.override_switch({"RC7_OPTION": 0.0}) is None


# --- streams


def ack(result: int, command: int = dialect.MAV_CMD_SET_MESSAGE_INTERVAL) -> CommandAck:
    return CommandAck(command=command, result=result, target=Endpoint(0, 0))


def ids(request: object) -> tuple[float, float]:
    assert isinstance(request, CommandRequest)
    return request.params[0], round(request.params[1])


def one_group() -> streams.StreamRequester:
    return streams.StreamRequester(streams.telemetry_streams(state_hz=100, rc_hz=20)[:1])


def test_streams_are_requested_one_after_the_other_at_the_action_rate() -> None:
    requester = streams.StreamRequester(streams.telemetry_streams(state_hz=100, rc_hz=20))
    requested = []
    for k in range(4):
        requested.append(ids(requester.step(k)))
        assert requester.step(k) is None  # acks carry no id: one at a time
        requester.receive_ack(ack(0, command=400))  # an ack of another command
        assert requester.step(k) is None
        requester.receive_ack(ack(0))
    assert requested == [(31, 10000), (32, 10000), (105, 10000), (65, 50000)]
    assert requester.is_settled


def test_denied_means_slower_then_another_message_then_the_legacy_stream() -> None:
    requester, requested = one_group(), []
    for k in range(6):
        requested.append(ids(requester.step(k)))
        requester.receive_ack(ack(dialect.MAV_RESULT_DENIED))
    assert requested == [(id_, us) for id_ in (31, 30) for us in (10000, 20000, 40000)]
    assert requester.step(9) == StreamRequest(dialect.MAV_DATA_STREAM_EXTRA1, 100)
    assert requester.is_settled


def test_an_unanswered_request_is_repeated_and_then_the_legacy_stream_used() -> None:
    requester = one_group()
    requests = [requester.step(k * S) for k in range(5)]
    assert [type(request) for request in requests] == [CommandRequest] * 4 + [StreamRequest]


def test_a_stream_that_slows_down_is_requested_again() -> None:
    requester = one_group()
    requester.step(0)
    requester.receive_ack(ack(0))
    now_ns, renewed = 0, []
    for tick in range(1000):
        now_ns = tick * 10 * NS_PER_MS
        # a ground station sets 4 Hz after three seconds
        if tick < 300 or tick % 25 == 0:
            requester.receive("ATTITUDE_QUATERNION")
        if requester.step(now_ns) is not None:
            renewed.append(now_ns // S)
            requester.receive_ack(ack(0))
    assert renewed == [4, 6, 8]
    assert requester.renewals == 3


# --- timesync


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


def test_the_fastest_exchange_sets_the_offset() -> None:
    sync = TimesyncFilter()
    for k, delay_ns in enumerate((9_000_000, 1_000_000, 5_000_000)):
        ts1 = sync.request(k * S)
        assert ts1 is not None
        # all the delay on the way back: the offset of a slow exchange is off by half of it
        sync.receive(Timesync(tc1=ts1 + 70 * S, ts1=ts1), ts1 + delay_ns)
    assert sync.offset_ns == 70 * S - 500_000


# --- echo

A, B, C = (1100, 1500, 1500, 1500), (1500, 1500, 1500, 1500), (1000, 1500, 1500, 1500)
"""Throttle, yaw, pitch, roll in us."""


def test_an_override_that_shows_up_is_confirmed() -> None:
    echo = EchoCheck()
    echo.received(C, 0)
    echo.sent(A, S)
    echo.received(C, S + 1)
    assert not echo.confirmed
    echo.received(A, S + 2)
    assert echo.confirmed
    assert not echo.failed(S + 3)


def test_an_override_that_never_shows_up_fails_and_is_tried_again_later() -> None:
    echo = EchoCheck()
    echo.received(C, 0)
    for k in range(100):
        echo.sent(A, k * 10 * NS_PER_MS)
        echo.received(C, k * 10 * NS_PER_MS)
    assert not echo.failed(S)
    assert echo.failed(S + 1)
    echo.released()
    assert echo.failed(3 * S)
    assert not echo.failed(5 * S)


def test_an_echo_that_stops_in_flight_is_noticed() -> None:
    echo = EchoCheck()
    for k in range(300):
        echo.sent(A, k * 10 * NS_PER_MS)
        echo.received(A if k < 100 else B, k * 10 * NS_PER_MS)
    assert echo.failed(3 * S)


def test_sticks_at_rest_are_nudged_until_they_are_seen() -> None:
    echo = EchoCheck()
    echo.received(A, 0)  # the receiver rests where we will hold the sticks
    for k in range(50):
        nudged = echo.with_nudge(A)
        assert nudged == (1100, 1500, 1500, 1500 + NUDGE_US)
        echo.sent(nudged, S + k * 10 * NS_PER_MS)
        echo.received(A, S + k * 10 * NS_PER_MS)  # a vehicle that ignores us shows no nudge
    assert not echo.confirmed
    assert echo.failed(S + S + 1)
    echo.received(nudged, 2 * S)
    assert echo.confirmed
    assert echo.with_nudge(A) == A
    echo.sent(A, 2 * S)
    echo.received(A, 2 * S + 1)
    assert not echo.failed(3 * S)


# --- telemetry and counters


def test_a_worse_message_never_overwrites_a_better_live_one() -> None:
    telemetry = TelemetryCollector()

    def force(source: str, value: float, at_ns: int) -> None:
        telemetry.receive(
            SpecificForce(message_name=source, specific_force_body_mps2=(value, 0, 0)), at_ns
        )

    force("RAW_IMU", 1.0, 0)
    force("HIGHRES_IMU", 2.0, 1)
    force("RAW_IMU", 3.0, 2)
    reading = telemetry.snapshot().specific_force_body_mps2
    assert reading is not None
    assert reading == (1, (2.0, 0, 0))
    force("SCALED_IMU2", 4.0, S)
    assert telemetry.snapshot().specific_force_body_mps2 == (S, (4.0, 0, 0))

    def attitude(quaternion: bool, at_ns: int) -> None:
        telemetry.receive(
            Attitude(
                is_quaternion=quaternion,
                boot_ms=0,
                ned_from_body_wxyz=(1, 0, 0, 0),
                rate_body_radps=(0, 0, 0),
            ),
            at_ns,
        )

    attitude(True, 0)
    attitude(False, 1)
    assert telemetry.snapshot().rate_body_radps == (0, (0, 0, 0))


def test_losses_are_gaps_in_the_sequence() -> None:
    counters, sync = LinkCounters(), TimesyncFilter()
    nothing = counters.stats(sync, echo_confirmed=None, unusable_packets=0)
    assert (nothing.lost_fraction, nothing.rtt_ms, nothing.vehicle_clock_offset_ns) == (None,) * 3
    for k, sequence in enumerate((254, 255, 0, 2, 3)):  # one lost, and a wrap that is none
        counters.receive("ATTITUDE", sequence, k * S)
    counters.new_sequence()
    counters.receive("HEARTBEAT", 99, 10 * S)
    ts1 = sync.request(S)
    assert ts1 is not None
    sync.receive(Timesync(tc1=S, ts1=ts1), ts1 + 2 * NS_PER_MS)
    stats = counters.stats(sync, echo_confirmed=True, unusable_packets=3)
    assert stats.lost_fraction == pytest.approx(1 / 7)
    assert stats.messages_per_s == (("ATTITUDE", 0.5), ("HEARTBEAT", 0.1))
    assert stats.rtt_ms is not None
    assert stats.rtt_ms.p50 == pytest.approx(2.0, rel=0.01)
    assert (stats.unusable_packets, stats.vehicle_clock_offset_ns) == (3, -NS_PER_MS)
    assert stats.echo_confirmed is None  # nothing was sent: there was nothing to confirm
