"""Pictures in chunks over UDP: assembled from any order, repetition and loss; stamped; refused."""

import socket

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from helpers.camera_senders import (
    HEADER,
    UdpSender,
    chunks,
    depth_scene,
    encoded,
    next_image,
    repeating,
    scene,
)
from helpers.fakes import START_NS, FakeClock
from mavbridge.camera import jpeg_udp
from mavbridge.camera.jpeg_udp import (
    MAX_PARTIAL,
    RESTART_NS,
    FrameAssembler,
    JpegUdpSource,
    parse_jpeg_udp,
)
from mavbridge.camera.open import check_camera, open_camera
from mavbridge.camera.pipe_frames import MAX_JPEG_BYTES, decode_picture
from mavbridge.core.clock import NS_PER_MS, NS_PER_S, MonotonicClock
from mavbridge.core.errors import CameraError, UserError

FIRST_ID = (1 << 32) - 3
"""Ids wrap around within each test that counts up from here."""


def payload(frame_id: int) -> bytes:
    """Bytes that tell of their frame everywhere; their number differs from frame to frame."""
    return bytes([frame_id % 251]) * (40 + frame_id % 7)


def put_all(frames: FrameAssembler, datagrams: list[bytes], now_ns: int = START_NS) -> list[int]:
    """The ids of the frames that become whole, in that order; each is checked to be itself."""
    done = [frame for each in datagrams if (frame := frames.put(each, now_ns)) is not None]
    for frame in done:
        assert frame.picture == payload(frame.key.frame_id)
    return [frame.key.frame_id for frame in done]


@given(data=st.data())
def test_any_order_repetition_and_loss_give_whole_frames_alone_and_newer_ones(data):
    sent = [
        chunk
        for n in range(8)
        for chunk in chunks(FIRST_ID + n, payload((FIRST_ID + n) % (1 << 32)), part=9)
    ]
    arrived = data.draw(st.lists(st.sampled_from(sent), max_size=3 * len(sent)))
    frames = FrameAssembler()
    places = [(each - FIRST_ID) % (1 << 32) for each in put_all(frames, arrived)]
    assert places == sorted(set(places))
    assert frames.malformed == 0


def test_incomplete_frames_are_bounded():
    frames = FrameAssembler()
    put_all(frames, [chunks(n, payload(n), part=9)[0] for n in range(100)])
    assert frames.incomplete == 100 - MAX_PARTIAL
    assert put_all(frames, chunks(99, payload(99), part=9)) == [99]


@pytest.mark.parametrize(
    ("fields", "payload_bytes"),
    [
        pytest.param((0, 1, 5, 5), b"", id="header alone"),
        pytest.param((0, 1, 5, 5), b"1234", id="cut chunk"),
        pytest.param((1, 1, 5, 5), b"12345", id="chunk 1 of 1"),
        pytest.param((0, 2, 9, 0), b"12345", id="no bytes"),
        pytest.param((0, 1, 4, 5), b"12345", id="more bytes than the picture"),
        pytest.param((0, 1, 6, 5), b"12345", id="fewer bytes than the picture"),
        pytest.param((0, 6, 5, 5), b"12345", id="more chunks than bytes"),
        pytest.param((0, 9, MAX_JPEG_BYTES + 1, 5), b"12345", id="too large"),
    ],
)
def test_what_is_malformed_is_counted_and_ignored(fields, payload_bytes):
    frames = FrameAssembler()
    assert put_all(frames, [b"", HEADER.pack(8, *fields, 0) + payload_bytes]) == []
    assert frames.malformed == 2
    assert put_all(frames, chunks(8, payload(8), part=9)) == [8]


@given(st.lists(st.binary(max_size=80), max_size=20))
def test_no_bytes_raise_or_hide_the_next_frame(datagrams):
    frames = FrameAssembler()
    for datagram in datagrams:
        frames.put(datagram, START_NS)
    later_ns = START_NS + RESTART_NS
    assert put_all(frames, chunks(8, payload(8), part=9), later_ns) == [8]


def test_a_sender_that_starts_again_is_followed_after_a_second():
    frames = FrameAssembler()
    assert put_all(frames, chunks(500, payload(500))) == [500]
    soon_ns, later_ns = START_NS + RESTART_NS - 1, START_NS + RESTART_NS
    assert put_all(frames, chunks(1, payload(1)), soon_ns) == []
    assert put_all(frames, chunks(500, payload(500)), later_ns) == []  # repeated, not news
    assert put_all(frames, chunks(1, payload(1)), later_ns) == [1]
    assert put_all(frames, chunks(2, payload(2)), later_ns) == [2]


def test_addresses():
    assert parse_jpeg_udp("5600") == ("127.0.0.1", 5600)
    assert parse_jpeg_udp("[::1]:65535") == ("::1", 65535)
    with pytest.raises(UserError, match="jpeg-udp:\\[HOST:\\]PORT"):
        check_camera("jpeg-udp:host")


class TickingClock(FakeClock):
    """Moves by half a second whenever it is read: a wait that lasts."""

    def now_ns(self):
        self.advance_ns(500 * NS_PER_MS)
        return super().now_ns()


@pytest.mark.parametrize("host", ["127.0.0.1", "::1"])
def test_the_newest_frame_is_read_and_older_ones_are_left(host):
    source = JpegUdpSource(host, 17201, clock=MonotonicClock())
    with UdpSender(17201, host) as sender:
        before_ns = MonotonicClock().now_ns()
        for number in range(3):
            sender.send(number, encoded(scene(number), ".png"), stamp_ns=before_ns)
        image = next_image(source)
        assert np.array_equal(image.rgb, scene(2))
        assert image.stamp_ns == before_ns <= image.arrived_ns
        old_ns = before_ns - 3 * NS_PER_S
        sender.send(7, encoded(depth_scene(1), ".png"), stamp_ns=old_ns)
        image = next_image(source)
        assert np.array_equal(image.rgb, depth_scene(1))
        assert image.stamp_ns == old_ns
    source.close()


def test_the_latency_is_not_added_to_the_age_by_the_stamps():
    clock, stamp_age_ns = MonotonicClock(), 400 * NS_PER_MS
    picture = encoded(scene(0))
    with UdpSender(17206) as sender:

        def send(number):
            sender.send(number, picture, stamp_ns=clock.now_ns() - stamp_age_ns)

        with repeating(send):
            camera = open_camera("jpeg-udp:17206", image_size=(32, 32), clock=clock, latency_ms=350)
            frame = camera.read(NS_PER_S)
    assert frame.is_stamped
    assert stamp_age_ns <= clock.now_ns() - frame.captured_ns < stamp_age_ns + 300 * NS_PER_MS
    camera.close()


def test_silence_says_what_has_come():
    source = JpegUdpSource("127.0.0.1", 17202, clock=TickingClock())
    with pytest.raises(CameraError, match="no datagram has come"):
        next_image(source)
    with UdpSender(17202) as sender:
        sender.send_raw(b"hello")
        sender.send_raw(chunks(1, payload(1), part=9)[0])
        with pytest.raises(CameraError, match="of 2 datagrams 1 were malformed"):
            next_image(source)
    source.close()


def test_damaged_pictures_are_skipped_and_many_in_a_row_are_an_error(monkeypatch):
    source = JpegUdpSource("127.0.0.1", 17203, clock=MonotonicClock())
    with UdpSender(17203) as sender:
        tried = []

        def decode(data):
            tried.append(data)
            sender.send(len(tried), b"no picture" if len(tried) != 5 else encoded(scene(0)))
            return decode_picture(data)

        monkeypatch.setattr(jpeg_udp, "decode_picture", decode)
        sender.send(0, b"no picture")
        assert next_image(source).rgb.shape == scene(0).shape
        with pytest.raises(CameraError, match="11 pictures in a row are damaged"):
            next_image(source)
    source.close()


def test_a_port_that_is_in_use_is_named():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", 17204))
        with pytest.raises(CameraError, match=r"jpeg-udp:127.0.0.1:17204 .*in use"):
            open_camera(
                "jpeg-udp:17204", image_size=(32, 32), clock=MonotonicClock(), timeout_s=0.2
            )


def test_a_picture_that_says_it_is_huge_is_not_decoded():
    jpeg, png = encoded(scene(0)), encoded(depth_scene(0), ".png")
    size_at = jpeg.index(b"\xff\xc0") + 5
    for picture, at, sides in (
        (jpeg, size_at, b"\xff\xdc" * 2),
        (png, 16, b"\x7f\xff\xff\xff" * 2),
    ):
        assert decode_picture(picture) is not None
        assert decode_picture(picture[:at] + sides + picture[at + len(sides) :]) is None
        assert not [end for end in range(40) if decode_picture(picture[:end]) is not None]
