"""The vision loop tells with each feature what is wrong with its image."""

import threading
from dataclasses import replace

import numpy as np
import pytest

from helpers.fakes import START_NS, FakeClock, ListSink
from mavbridge.camera.image_watch import TAKEOFF_NS, ImageWatch
from mavbridge.core.clock import NS_PER_MS, NS_PER_S
from mavbridge.core.reasons import Code, because
from mavbridge.core.records import Frame
from mavbridge.flight.feature_cache import FeatureCache
from mavbridge.flight.vision_loop import VisionLoop

FRAME_NS = NS_PER_S // 30


class StillCamera:
    """Delivers the same picture over and over."""

    dropped_frames = 0

    def __init__(self, clock, picture):
        self._clock = clock
        self._picture = picture
        self._frames = 0

    def read(self, timeout_ns):
        self._clock.advance_ns(FRAME_NS)
        self._frames += 1
        return Frame(
            frame_id=self._frames, captured_ns=self._clock.now_ns(), rgb=self._picture.copy()
        )

    def close(self):
        pass


def faults(*, picture, image_watch, airborne_from_ns=START_NS, seconds=4):
    """Time of the first fault after the start, and every fault from then on."""
    clock, cache = FakeClock(), FeatureCache()
    sink = ListSink()
    loop = VisionLoop(
        camera=StillCamera(clock, picture),
        encode=lambda rgb: np.zeros((1, 8), np.float32),
        cache=cache,
        sink=sink,
        clock=clock,
        period_ns=lambda: FRAME_NS,
        encoder_lock=threading.Lock(),
        image_watch=image_watch,
        is_airborne=lambda: clock.now_ns() >= airborne_from_ns,
    )
    seen = []
    while clock.now_ns() < START_NS + seconds * NS_PER_S:
        loop.step()
        feature = cache.latest()
        seen.append(((feature.captured_ns - START_NS) / NS_PER_S, feature.fault))
    assert len(sink.visions) == len(seen)
    faulty = [(at_s, fault) for at_s, fault in seen if fault is not None]
    if not faulty:
        return None, []
    first_s = faulty[0][0]
    return first_s, [fault for at_s, fault in seen if at_s >= first_s]


SCENE = np.random.default_rng(3).integers(0, 255, (60, 80, 3), dtype=np.uint8)


def watch():
    return ImageWatch(max_frozen_s=0.5, max_black_s=0.5)


def test_a_frozen_image_marks_every_feature_from_the_limit_on():
    first_s, reasons = faults(picture=SCENE, image_watch=watch())
    assert 0.5 < first_s - FRAME_NS / NS_PER_S < 0.5 + 1.5 * FRAME_NS / NS_PER_S
    assert {reason.code for reason in reasons} == {Code.IMAGE_FROZEN}


def test_before_the_vehicle_is_airborne_a_frozen_image_is_none():
    never = START_NS + 100 * NS_PER_S
    assert faults(picture=SCENE, image_watch=watch(), airborne_from_ns=never) == (None, [])


def test_a_camera_that_froze_on_the_ground_is_noticed_after_take_off():
    first_s, _ = faults(picture=SCENE, image_watch=watch(), airborne_from_ns=START_NS + NS_PER_S)
    expected_s = 1.0 + TAKEOFF_NS / NS_PER_S + 0.5
    assert expected_s - 2 * FRAME_NS / NS_PER_S < first_s < expected_s + 2 * FRAME_NS / NS_PER_S


def test_a_black_image_is_a_fault_on_the_ground_too():
    never = START_NS + 100 * NS_PER_S
    first_s, reasons = faults(
        picture=np.zeros_like(SCENE), image_watch=watch(), airborne_from_ns=never
    )
    assert 0.5 < first_s < 0.6
    assert {reason.code for reason in reasons} == {Code.IMAGE_BLANK}


def test_without_a_watch_nothing_is_a_fault():
    assert faults(picture=np.zeros_like(SCENE), image_watch=None) == (None, [])


def test_of_two_loops_with_one_lock_only_the_one_that_computes_is_encoding():
    clock, lock = FakeClock(), threading.Lock()
    seen = []

    def make_loop(encode):
        return VisionLoop(
            camera=StillCamera(clock, np.zeros((8, 8, 3), np.uint8)),
            encode=encode,
            cache=FeatureCache(),
            sink=ListSink(),
            clock=clock,
            period_ns=lambda: FRAME_NS,
            encoder_lock=lock,
        )

    def encode_second(rgb):
        seen.append((first.encoding_since_ns, second.encoding_since_ns))
        return np.zeros((1, 8), np.float32)

    def encode_first(rgb):
        waiting.start()
        waiting.join(0.05)  # the other cannot end before this one has
        seen.append((first.encoding_since_ns, second.encoding_since_ns))
        return np.zeros((1, 8), np.float32)

    first, second = make_loop(encode_first), make_loop(encode_second)
    waiting = threading.Thread(target=second.step)
    first.step()
    waiting.join(10)
    assert not waiting.is_alive()
    (a, nothing), (nothing_either, b) = seen
    assert a is not None
    assert b is not None
    assert nothing is None
    assert nothing_either is None


def stamped_ahead(clock, cache, ahead_ms, image_watch=None):
    """A loop whose camera stamps each image by so many ms in the future."""
    camera = StillCamera(clock, np.zeros((8, 8, 3), np.uint8))
    read, left_ms = camera.read, list(ahead_ms)
    camera.read = lambda timeout_ns: replace(
        read(timeout_ns), captured_ns=clock.now_ns() + left_ms.pop(0) * NS_PER_MS
    )
    return VisionLoop(
        camera=camera,
        encode=lambda rgb: np.zeros((1, 8), np.float32),
        cache=cache,
        sink=ListSink(),
        clock=clock,
        period_ns=lambda: FRAME_NS,
        encoder_lock=threading.Lock(),
        image_watch=image_watch,
    )


@pytest.mark.parametrize("ahead_ms", [-600, 0, 20, 21, 400, 3_000, 55 * 365 * 86_400_000])
@pytest.mark.parametrize("is_watched", [False, True])
def test_a_stamp_more_than_20_ms_ahead_is_a_fault_of_the_camera(ahead_ms, is_watched):
    clock, cache = FakeClock(), FeatureCache()
    loop = stamped_ahead(clock, cache, [ahead_ms], watch() if is_watched else None)
    loop.step()
    feature = cache.latest()
    assert feature is not None
    assert feature.captured_ns == clock.now_ns() + min(ahead_ms, 0) * NS_PER_MS
    assert (feature.fault is not None) == (ahead_ms > 20)
    if feature.fault is not None:
        assert feature.fault == because(Code.IMAGE_AHEAD, ahead_ms=float(ahead_ms), limit_ms=20.0)


def test_of_a_camera_that_goes_back_to_right_stamps_the_next_feature_is_flown_by():
    clock, cache = FakeClock(), FeatureCache()
    loop = stamped_ahead(clock, cache, [0, 500, 0])
    seen = []
    for _ in range(3):
        loop.step()
        seen.append(cache.latest().fault is not None)
    assert seen == [False, True, False]
