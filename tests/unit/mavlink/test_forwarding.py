"""A ground station beside us: what passes, what does not, and when its sticks win."""

import select
import socket
from collections.abc import Callable, Iterator
from contextlib import closing
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as dialect

from helpers.fakes import FakeClock
from helpers.network import needs_ipv6
from mavbridge.core.address import spelled
from mavbridge.core.clock import NS_PER_MS
from mavbridge.core.errors import UserError
from mavbridge.core.processes import free_port
from mavbridge.mavlink.codec.frames import RawPacket, split_frames
from mavbridge.mavlink.codec.messages import Endpoint
from mavbridge.mavlink.codec.signing import EPOCH_NS, Signing
from mavbridge.mavlink.transport.forwarding import MAX_DATAGRAMS, MAX_QUEUED_BYTES, Forwarding
from mavbridge.mavlink.transport.ground_station import GroundStationRules, Verdict, denial

VEHICLE = Endpoint(1, 1)
GCS = dialect.MAVLink(None, srcSystem=255, srcComponent=190)
ATTITUDE = dialect.MAVLINK_MSG_ID_ATTITUDE
NEUTRAL = (0, 0, 500, 0)


def frame_of(message: Any, codec: Any = GCS) -> RawPacket:
    (frame,), has_rest = split_frames(bytes(message.pack(codec)))
    assert not has_rest
    return frame


def command(number: int, *params: float, target: int = 1) -> Any:
    padded = (*params, *[0.0] * (7 - len(params)))
    return GCS.command_long_encode(target, target, number, 0, *padded)


def command_int(number: int) -> Any:
    return GCS.command_int_encode(1, 1, 0, number, 0, 0, 30.0, 1e4, 0, 0, 0, 0, 0)


def manual(x: int = 0, y: int = 0, z: int = 500, r: int = 0) -> Any:
    return GCS.manual_control_encode(1, x, y, z, r, 0)


def override(*channels_us: int) -> Any:
    return GCS.rc_channels_override_encode(1, 1, *channels_us, *[65535] * (8 - len(channels_us)))


def attitude_target() -> Any:
    return GCS.set_attitude_target_encode(0, 1, 1, 0, [1.0, 0, 0, 0], 0, 0, 0, 0.5)


def velocity_target() -> Any:
    return GCS.set_position_target_local_ned_encode(0, 1, 1, 1, 1479, *[0.0] * 11)


def global_target() -> Any:
    return GCS.set_position_target_global_int_encode(0, 1, 1, 6, 0, 0, 0, *[0.0] * 9)


# --- packets


def signed(message: Any) -> bytes:
    codec = dialect.MAVLink(None, srcSystem=255, srcComponent=190)
    codec.signing.secret_key = b"k" * 32
    codec.signing.sign_outgoing = True
    return bytes(message.pack(codec))


def test_packets_of_both_versions_and_signed_ones_are_cut_apart_unchanged() -> None:
    packets = [
        bytes(GCS.heartbeat_encode(6, 8, 0, 0, 4).pack(GCS)),
        bytes(command(400, 1).pack(GCS, force_mavlink1=True)),
        signed(command(400, 1)),
    ]

    frames, has_rest = split_frames(b"".join(packets))

    assert [frame.data for frame in frames] == packets
    assert not has_rest
    assert [frame.message_id for frame in frames] == [0, 76, 76]
    assert {frame.source for frame in frames} == {Endpoint(255, 190)}


@pytest.mark.parametrize("rest", [b"\xfd", b"\xfd\x09\x00", b"noise", b"\xfe\xff\x00\x01\x01\x00"])
def test_what_is_no_packet_is_left_over(rest: bytes) -> None:
    whole = bytes(GCS.heartbeat_encode(6, 8, 0, 0, 4).pack(GCS))

    frames, has_rest = split_frames(whole + rest)

    assert [frame.data for frame in frames] == [whole]
    assert has_rest


# --- rules


def judge(rules: GroundStationRules, message: Any, now_ns: int = 0, *, flying: bool = True) -> Any:
    return rules.judge(frame_of(message), now_ns, is_engaged=flying)


@pytest.mark.parametrize(
    "message",
    [
        GCS.heartbeat_encode(6, 8, 0, 0, 4),
        GCS.param_request_read_encode(1, 1, b"RTL_ALT", -1),
        GCS.param_set_encode(1, 1, b"RTL_ALT", 1.0, 9),
        GCS.mission_request_list_encode(1, 1),
        GCS.set_mode_encode(1, 1, 5),
        command(dialect.MAV_CMD_DO_SET_MODE, 1, 5),
        command_int(dialect.MAV_CMD_NAV_LAND),
        command(dialect.MAV_CMD_REQUEST_MESSAGE, 148),
        command(dialect.MAV_CMD_GET_MESSAGE_INTERVAL, ATTITUDE),
    ],
    ids=lambda message: message.get_type(),
)
@pytest.mark.parametrize("sticks_win", [False, True])
def test_what_does_not_meet_ours_passes(message: Any, sticks_win: bool) -> None:
    rules = GroundStationRules(sticks_win=sticks_win)

    assert judge(rules, message) is Verdict.PASS
    assert (rules.dropped, rules.texts) == (0, [])


@pytest.mark.parametrize(
    ("message", "verdict", "word"),
    [
        (GCS.request_data_stream_encode(1, 1, 0, 4, 1), Verdict.DROP, "rates"),
        (command(511, ATTITUDE, 1e6), Verdict.DENY, "rates"),
        (command_int(511), Verdict.DENY, "rates"),
        (attitude_target(), Verdict.DROP, "setpoints"),
        (velocity_target(), Verdict.DROP, "setpoints"),
        (global_target(), Verdict.DROP, "setpoints"),
        (manual(), Verdict.DROP, "--gcs-sticks-win"),
        (override(1500, 1500), Verdict.DROP, "--gcs-sticks-win"),
        (override(0, 0, 0, 0), Verdict.DROP, "--gcs-sticks-win"),
    ],
)
@pytest.mark.parametrize("flying", [False, True])
def test_what_would_mix_with_ours_does_not_and_is_told_once(
    message: Any, verdict: Verdict, word: str, flying: bool
) -> None:
    rules = GroundStationRules(sticks_win=False)

    assert [judge(rules, message, flying=flying) for _ in range(3)] == [verdict] * 3
    assert rules.dropped == 3
    (text,) = rules.texts
    assert word in text


def test_a_refused_command_is_answered_as_by_the_vehicle() -> None:
    (ack,) = dialect.MAVLink(None).parse_buffer(denial(frame_of(command(511, 30)), VEHICLE))

    assert (ack.get_srcSystem(), ack.get_srcComponent()) == VEHICLE
    assert (ack.command, ack.result) == (511, dialect.MAV_RESULT_DENIED)
    assert (ack.target_system, ack.target_component) == (255, 190)


def test_a_refused_broadcast_is_answered_by_the_vehicle_that_we_fly() -> None:
    denied = denial(frame_of(command(511, 30, target=0)), Endpoint(7, 1))
    (ack,) = dialect.MAVLink(None).parse_buffer(denied)

    assert (ack.get_srcSystem(), ack.get_srcComponent()) == (7, 1)


MOVED = [
    manual(x=200),
    manual(y=-200),
    manual(r=150),
    manual(z=650),
    manual(z=0),
    override(1600),
    override(65535, 1400),
    override(1500, 1500, 1700, 1500),
    override(65535, 65535, 65535, 1600),
]
UNTOUCHED = [
    manual(),
    manual(x=50, y=-90, z=560, r=32767),
    override(1500, 1500, 1500, 1500),
    override(0, 0, 0, 0),
    override(65535, 1540, 65535, 65535),
]


@pytest.mark.parametrize("message", MOVED)
def test_sticks_that_move_take_over_and_keep_it(message: Any) -> None:
    rules = GroundStationRules(sticks_win=True)
    assert judge(rules, manual()) is Verdict.DROP
    assert rules.overruled(0, is_engaged=True) is None

    assert judge(rules, message) is Verdict.PASS

    assert rules.overruled(9_000 * NS_PER_MS, is_engaged=True) is not None
    assert judge(rules, manual(), 9_000 * NS_PER_MS) is Verdict.PASS
    assert rules.texts == ["the ground station's sticks have taken over"]


@pytest.mark.parametrize("message", UNTOUCHED)
def test_untouched_sticks_of_a_virtual_joystick_change_nothing(message: Any) -> None:
    rules = GroundStationRules(sticks_win=True)

    for at in range(50):
        assert judge(rules, message, 40 * NS_PER_MS * at) is Verdict.DROP

    assert rules.overruled(2_000 * NS_PER_MS, is_engaged=True) is None


def test_a_throttle_that_rests_down_is_untouched_too() -> None:
    rules = GroundStationRules(sticks_win=True)
    assert judge(rules, manual(z=0)) is Verdict.DROP
    assert judge(rules, manual(z=40)) is Verdict.DROP

    assert judge(rules, manual(z=300)) is Verdict.PASS


def test_its_sticks_pass_while_nothing_is_ours_and_forbid_engaging_while_in_use() -> None:
    rules = GroundStationRules(sticks_win=True)

    assert judge(rules, manual(y=900), flying=False) is Verdict.PASS
    assert rules.overruled(900 * NS_PER_MS, is_engaged=False) is not None
    assert rules.overruled(1_100 * NS_PER_MS, is_engaged=False) is None


def test_our_sticks_before_the_flight_are_ours_as_well() -> None:
    rules = GroundStationRules(sticks_win=True)
    rules.on_our_sticks(0)

    assert judge(rules, manual(), 100 * NS_PER_MS, flying=False) is Verdict.DROP
    assert judge(rules, manual(), 600 * NS_PER_MS, flying=False) is Verdict.PASS


def test_after_a_takeover_the_next_act_is_possible_once_its_sticks_rest() -> None:
    rules = GroundStationRules(sticks_win=True)
    assert judge(rules, manual(y=900)) is Verdict.PASS
    assert rules.overruled(0, is_engaged=True) is not None

    later_ns = 5_000 * NS_PER_MS
    assert rules.overruled(later_ns, is_engaged=False) is None
    assert judge(rules, manual(), later_ns) is Verdict.DROP


# --- the socket


@pytest.fixture(params=["127.0.0.1", pytest.param("::1", marks=needs_ipv6)])
def station(request: pytest.FixtureRequest) -> Iterator[socket.socket]:
    kind = socket.AF_INET6 if ":" in request.param else socket.AF_INET
    with socket.socket(kind, socket.SOCK_DGRAM) as udp:
        udp.bind((request.param, 0))
        udp.settimeout(2.0)
        yield udp


@pytest.fixture
def forwarding_to(
    station: socket.socket,
) -> Iterator[Callable[[str], Forwarding]]:
    opened: list[Forwarding] = []

    def forwarding_to(kind: str) -> Forwarding:
        host, port, *_ = station.getsockname()
        place = spelled(host, free_port() if kind == "udpin" else port)
        opened.append(Forwarding(f"{kind}:{place}", FakeClock()))
        return opened[-1]

    yield forwarding_to
    for forwarding in opened:
        forwarding.close()


def ours(forwarding: Forwarding) -> tuple[str, int]:
    with socket.socket(fileno=socket.dup(forwarding.fileno())) as udp:
        host = "::1" if udp.family == socket.AF_INET6 else "127.0.0.1"
        return host, udp.getsockname()[1]


def received(forwarding: Forwarding) -> list[bytes]:
    return list(forwarding.receive(VEHICLE, is_engaged=True))


def test_bytes_pass_both_ways_unchanged(forwarding_to: Any, station: socket.socket) -> None:
    forwarding = forwarding_to("udp")
    unknown = b"\xfd\x01\x00\x00\x05\x01\x01\xff\xff\x7f\x00ab"  # a message that nobody here knows
    forwarding.pass_on(unknown)
    forwarding.pass_on(b"half a pack")
    forwarding.flush()
    assert station.recv(2000) == unknown + b"half a pack"

    packets = [signed(command(400, 1)), bytes(GCS.heartbeat_encode(6, 8, 0, 0, 4).pack(GCS))]
    station.sendto(b"".join(packets), ours(forwarding))

    assert received(forwarding) == packets
    assert forwarding.take_texts() == [
        f"a ground station at {spelled(*station.getsockname())} shares the link"
    ]
    assert forwarding.summary() is None


def test_a_refused_rate_is_answered_on_the_spot(forwarding_to: Any, station: socket.socket) -> None:
    forwarding = forwarding_to("udp")
    station.sendto(bytes(command(511, ATTITUDE, 1e6).pack(GCS)), ours(forwarding))

    assert received(forwarding) == []

    (ack,) = dialect.MAVLink(None).parse_buffer(station.recv(2000))
    assert (ack.command, ack.result) == (511, dialect.MAV_RESULT_DENIED)
    assert "1 packets of the ground station were not passed on" in (forwarding.summary() or "")


def test_one_that_listens_answers_the_first_that_talks_and_hears_no_other(
    forwarding_to: Any, station: socket.socket
) -> None:
    forwarding = forwarding_to("udpin")
    forwarding.pass_on(b"to nobody yet")
    packet = bytes(GCS.heartbeat_encode(6, 8, 0, 0, 4).pack(GCS))
    station.sendto(packet, ours(forwarding))
    assert received(forwarding) == [packet]
    with socket.socket(station.family, socket.SOCK_DGRAM) as second:
        second.sendto(packet, ours(forwarding))
        assert received(forwarding) == []

    forwarding.pass_on(b"hello")
    forwarding.flush()

    assert station.recv(2000) == b"hello"


def test_one_that_calls_hears_nobody_else(forwarding_to: Any, station: socket.socket) -> None:
    forwarding = forwarding_to("udp")
    with socket.socket(station.family, socket.SOCK_DGRAM) as stranger:
        stranger.sendto(bytes(command(400, 0, 21196).pack(GCS)), ours(forwarding))

        assert received(forwarding) == []


def test_a_flood_is_read_in_parts(forwarding_to: Any, station: socket.socket) -> None:
    forwarding = forwarding_to("udp")
    packet = bytes(GCS.heartbeat_encode(6, 8, 0, 0, 4).pack(GCS))
    for _ in range(MAX_DATAGRAMS + 5):
        station.sendto(packet, ours(forwarding))

    assert len(received(forwarding)) == MAX_DATAGRAMS
    assert len(received(forwarding)) == 5


def test_long_datagrams_are_read_in_parts_too(forwarding_to: Any, station: socket.socket) -> None:
    forwarding = forwarding_to("udp")
    packet = bytes(GCS.heartbeat_encode(6, 8, 0, 0, 4).pack(GCS))
    for _ in range(10):
        station.sendto(packet * 40, ours(forwarding))

    assert [len(received(forwarding)) for _ in range(5)] == [120, 120, 120, 40, 0]


def test_what_does_not_fit_is_dropped_and_counted(forwarding_to: Any) -> None:
    forwarding = forwarding_to("udp")
    for _ in range(MAX_QUEUED_BYTES // 1000 + 10):
        forwarding.pass_on(b"." * 1000)

    forwarding.flush()

    assert forwarding.dropped >= 10


def test_nobody_at_the_other_end_is_no_error() -> None:
    with closing(Forwarding(f"udp:127.0.0.1:{free_port()}", FakeClock())) as forwarding:
        for _ in range(3):
            forwarding.pass_on(b"anybody?")
            forwarding.flush()
            assert received(forwarding) == []


@pytest.mark.parametrize(
    "spec", ["udp:14550", "tcp:127.0.0.1:1", "udp:127.0.0.1:0", "udp:127.0.0.1:x", "udp::14550", ""]
)
def test_a_malformed_address_is_refused(spec: str) -> None:
    with pytest.raises(UserError, match="--forward"):
        Forwarding(spec, FakeClock())


def test_a_port_that_is_taken_is_refused(station: socket.socket) -> None:
    place = spelled(*station.getsockname())
    with pytest.raises(UserError, match="choose another port"):
        Forwarding(f"udpin:{place}", FakeClock())


def test_with_a_key_only_signed_packets_are_passed_on_and_obeyed(station: socket.socket) -> None:
    key, place = bytes(range(32)), spelled(*station.getsockname())
    signing = Signing(key, unix_ns=lambda: EPOCH_NS)
    forwarding = Forwarding(f"udp:{place}", FakeClock(), sticks_win=True, signing=signing)
    try:
        sticks, mav = manual(x=900), dialect.MAVLink(None, srcSystem=255, srcComponent=190)
        unsigned = bytes(sticks.pack(mav))
        mav.signing.secret_key, mav.signing.sign_outgoing = key, True
        mav.signing.timestamp = 1
        signed = bytes(sticks.pack(mav))
        for packet in (unsigned, signed):
            station.sendto(packet, ours(forwarding))
            select.select([forwarding], [], [], 5)
            passed = list(forwarding.receive(None, is_engaged=True))
            assert passed == ([signed] if packet is signed else [])
            assert forwarding.rules.has_won is (packet is signed)
        assert forwarding.rules.dropped == 1
        assert signing.refused == {"unsigned": 1}
    finally:
        forwarding.close()
