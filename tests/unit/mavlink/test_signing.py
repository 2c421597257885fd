"""Signatures against pymavlink's own, which is the other side here, and replays refused."""

import pytest
from pymavlink.dialects.v20 import ardupilotmega as dialect

from mavbridge.mavlink.codec.packets import Codec
from mavbridge.mavlink.codec.signing import EPOCH_NS, LATEST_TICKS, TICK_NS, Signing, SigningState

KEY, OTHER_KEY = bytes(range(32)), bytes(32)
NOW_NS = EPOCH_NS + 350_000_000 * 10**9
NOW_TICKS = (NOW_NS - EPOCH_NS) // TICK_NS
MINUTE_TICKS = 60 * 10**9 // TICK_NS


class TimeOfDay:
    def __init__(self, unix_ns):
        self.unix_ns = unix_ns

    def __call__(self):
        return self.unix_ns


def make_codec(key=KEY, *, day=None, state=None):
    if key is None:
        signing = None
    else:
        signing = Signing(key, unix_ns=day or TimeOfDay(NOW_NS), state=state or SigningState())
    return Codec(source_system=255, signing=signing)


def make_vehicle(key=KEY, *, ticks=NOW_TICKS, component=1, link_id=0):
    vehicle = dialect.MAVLink(None, srcSystem=1, srcComponent=component)
    vehicle.robust_parsing = True
    if key is not None:
        vehicle.signing.secret_key = key
        vehicle.signing.timestamp = ticks
        vehicle.signing.link_id = link_id
        vehicle.signing.sign_outgoing = True
    return vehicle


def heartbeat(vehicle, *, is_v1=False):
    return bytes(vehicle.heartbeat_encode(2, 3, 0, 0, 4).pack(vehicle, is_v1))


def beat(key=KEY, **options):
    return heartbeat(make_vehicle(key, **options))


def radio_status(*, is_v1=False):
    """A radio knows no key."""
    radio = make_vehicle(None)
    return bytes(radio.radio_status_encode(1, 1, 1, 1, 1, 1, 1).pack(radio, is_v1))


def attitude(vehicle):
    message = vehicle.attitude_quaternion_encode(1000, 1.0, 0.0, 0.0, 0.0, 0.1, 0.2, 0.3)
    return bytes(message.pack(vehicle))


def names(codec, *packets):
    return [message.name for packet in packets for message in codec.decode_datagram(packet)]


def timestamp(packet):
    return int.from_bytes(packet[-12:-6], "little")


def changed(packet):
    """With its checksum mended."""
    data = bytearray(packet)
    data[12] ^= 1
    crc_extra = dialect.MAVLink_heartbeat_message.crc_extra
    crc = dialect.x25crc(bytes(data[1:-15]) + bytes((crc_extra,))).crc
    data[-15:-13] = crc.to_bytes(2, "little")
    return bytes(data)


def v1_beats():
    """Of MAVLink 1, which has the sequence number where MAVLink 2 has its flags."""
    vehicle = make_vehicle(None)
    for sequence in range(2):
        vehicle.seq = sequence
        yield heartbeat(vehicle, is_v1=True)


UNKNOWN = bytes([0xFD, 5, 0, 0, 7, 1, 1, 0, 0, 1]) + b"noise" + bytes(2)
SIGNED_NOISE = bytes([0xFD, 5, 1, 0, 7, 1, 1, 0, 0, 1]) + b"noise" + bytes(15)
OTHER_STREAMS = beat(component=100), beat(link_id=3)
LATE_TICKS = NOW_TICKS - MINUTE_TICKS


@pytest.mark.parametrize(
    ("packets", "accepted", "refused"),
    [
        ([beat(None), beat(OTHER_KEY)], 0, {"unsigned": 1, "wrong key": 1}),
        ([beat(), beat(ticks=NOW_TICKS + 1)] * 2, 2, {"replayed": 2}),
        ([changed(beat())], 0, {"wrong key": 1}),
        ([beat(ticks=NOW_TICKS + 1), *OTHER_STREAMS, beat()], 3, {"replayed": 1}),
        ([beat(ticks=LATE_TICKS - 1), beat(ticks=LATE_TICKS)], 1, {"clock behind": 1}),
        ([radio_status(), radio_status(is_v1=True)], 2, {}),
        ([*v1_beats()], 0, {"unsigned": 2}),
        ([UNKNOWN], 0, {}),
    ],
)
def test_refused_is_what_the_key_has_not_signed_or_not_just_now(packets, accepted, refused):
    codec, without_key = make_codec(), make_codec(None)
    assert len(names(codec, *packets)) == accepted
    assert codec.signing.refused == refused
    assert codec.refused_signatures == sum(refused.values())
    assert len(names(without_key, *packets)) == len(packets)


def test_a_known_stream_goes_on_where_it_was_however_late_its_clock_is():
    """A vehicle without GPS goes on counting from where its last flight has ended."""
    days_ago = NOW_TICKS - 3 * 24 * 60 * MINUTE_TICKS
    codec = make_codec(state=SigningState(0, {(0, 1, 1): days_ago}))
    assert names(codec, heartbeat(make_vehicle(ticks=days_ago))) == []
    assert len(names(codec, heartbeat(make_vehicle(ticks=days_ago + 1)))) == 1
    assert codec.signing.refused == {"replayed": 1}
    assert codec.signing.state.heard_ticks == {(0, 1, 1): days_ago + 1}


def test_our_timestamps_follow_the_clock_and_never_step_back():
    day = TimeOfDay(NOW_NS)
    codec = make_codec(day=day)
    first, second = timestamp(codec.encode_heartbeat()), timestamp(codec.encode_heartbeat())
    assert (first, second) == (NOW_TICKS, NOW_TICKS + 1)
    day.unix_ns += 10**9
    assert timestamp(codec.encode_heartbeat()) == NOW_TICKS + 10**9 // TICK_NS
    day.unix_ns -= 3600 * 10**9
    assert timestamp(codec.encode_heartbeat()) == NOW_TICKS + 10**9 // TICK_NS + 1
    restarted = make_codec(day=TimeOfDay(EPOCH_NS - 1), state=SigningState(NOW_TICKS + 500))
    assert timestamp(restarted.encode_heartbeat()) == NOW_TICKS + 501
    assert timestamp(make_codec(day=TimeOfDay(0)).encode_heartbeat()) == 1
    late = make_codec(day=TimeOfDay(EPOCH_NS + 2**48 * TICK_NS))  # in 2104
    assert timestamp(late.encode_heartbeat()) == LATEST_TICKS


@pytest.mark.parametrize("key", [KEY, None])
def test_what_is_rehearsed_uses_up_no_number_and_is_a_stream_of_its_own(key):
    codec = make_codec(key)
    with codec.rehearsing():
        packets = [codec.encode_heartbeat(), codec.encode_heartbeat()]
    packets.append(codec.encode_heartbeat())
    assert [packet[4] for packet in packets] == [0, 1, 0]
    assert key is None or [packet[-13] for packet in packets] == [1, 1, 0]


def test_without_a_key_signed_packets_are_read_and_noticed():
    codec = make_codec(None)
    assert names(codec, attitude(make_vehicle(None))) == ["ATTITUDE_QUATERNION"]
    assert list(codec.decode(SIGNED_NOISE))
    assert (codec.hears_signed, codec.refused_signatures) == (False, 0)
    for key in (KEY, None):  # it is remembered
        assert names(codec, attitude(make_vehicle(key))) == ["ATTITUDE_QUATERNION"]
        assert codec.hears_signed


AHEAD_TICKS = NOW_TICKS + 100 * MINUTE_TICKS


@pytest.mark.parametrize(
    ("key", "ticks", "answered_at"),
    [
        (KEY, AHEAD_TICKS, AHEAD_TICKS + 1),
        (OTHER_KEY, AHEAD_TICKS, NOW_TICKS),
        # a time without a next one, or near the end of its bits
        (KEY, 2**48 - 1, NOW_TICKS),
        (KEY, 2**48 - 2**39, NOW_TICKS),
        (KEY, LATEST_TICKS + 1, NOW_TICKS),
        (KEY, LATEST_TICKS, LATEST_TICKS + 1),
    ],
)
def test_our_timestamps_follow_a_vehicle_whose_clock_is_ahead(key, ticks, answered_at):
    codec, vehicle = make_codec(), make_vehicle(key, ticks=ticks)
    assert names(codec, heartbeat(vehicle)) == ["HEARTBEAT"] * (key == KEY)
    reply = codec.encode_heartbeat()
    assert timestamp(reply) == answered_at
    if answered_at > NOW_TICKS:
        assert vehicle.decode(bytearray(reply)).get_type() == "HEARTBEAT"
