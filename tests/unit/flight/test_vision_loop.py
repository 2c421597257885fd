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
from policy.errors import NoChunkError

FRAME_NS = NS_PER_S // 30


class StillCamera:
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


def make_loop(clock, camera, *, cache=None, sink=None, lock=None, **changes):
    settings = {
        "encode": lambda rgb, camera: np.zeros((1, 8), np.float32),
        "period_ns": FRAME_NS,
        "encoder_lock": lock or threading.Lock(),
    }
    return VisionLoop(
        camera=camera,
        cache=cache or FeatureCache(),
        sink=sink or ListSink(),
        clock=clock,
        **(settings | changes),
    )


SCENE = np.random.default_rng(3).integers(0, 255, (60, 80, 3), dtype=np.uint8)
FRAME_S = FRAME_NS / NS_PER_S


def watch():
    return ImageWatch(max_frozen_s=0.5, max_black_s=0.5)


@pytest.mark.parametrize("is_watched", [True, False])
def test_every_feature_from_the_limit_on_has_the_fault_of_its_image(is_watched):
    """Frozen since the ground, which it leaves after a second."""
    clock, cache, sink = FakeClock(), FeatureCache(), ListSink()
    loop = make_loop(
        clock,
        StillCamera(clock, SCENE),
        cache=cache,
        sink=sink,
        image_watch=watch() if is_watched else None,
        is_airborne=lambda: clock.now_ns() >= START_NS + NS_PER_S,
    )
    limit_s, seen = 1.5 + TAKEOFF_NS / NS_PER_S, []
    while clock.now_ns() < START_NS + 4 * NS_PER_S:
        loop.step()
        feature = cache.latest()
        at_s = (feature.captured_ns - START_NS) / NS_PER_S
        if abs(at_s - limit_s) > 2 * FRAME_S:
            seen.append((at_s > limit_s, feature.fault and feature.fault.code))
    code = Code.IMAGE_FROZEN if is_watched else None
    assert set(seen) == {(False, None), (True, code)}
    assert len(sink.visions) == 4 * NS_PER_S // FRAME_NS + 1


@pytest.mark.parametrize(
    ("words", "said"),
    [("too dark", "too dark"), ("", "NoChunkError"), ("why:\n" + "x" * 9999, "x" * 300)],
    ids=["a line", "nothing", "a page"],
)
def test_an_image_that_the_policy_skips_leaves_the_last_feature_and_a_reason(words, said):
    clock, cache, sink, seen = FakeClock(), FeatureCache(), ListSink(), []

    def encode(rgb, camera):
        if clock.now_ns() == START_NS + 2 * FRAME_NS:
            raise NoChunkError(words)
        return np.zeros((1, 8), np.float32)

    loop = make_loop(clock, StillCamera(clock, SCENE), cache=cache, encode=encode, sink=sink)
    for _ in range(3):
        loop.step()
        seen.append((cache.latest().frame_id, cache.refusal, loop.encoding_since_ns))
    dark = because(Code.POLICY_REFUSED, said=said)
    assert seen == [(1, None, None), (1, dark, None), (3, None, None)]
    assert [vision.fault for vision in sink.visions] == [None, dark, None]
    assert [vision.feature is None for vision in sink.visions] == [False, True, False]


def test_a_camera_faster_than_the_visual_rate_is_thinned():
    clock, sink = FakeClock(), ListSink()
    loop = make_loop(clock, StillCamera(clock, SCENE), sink=sink, period_ns=2 * FRAME_NS)
    for _ in range(100):
        loop.step()
    assert set(np.diff([vision.captured_ns for vision in sink.visions])) == {2 * FRAME_NS}
    assert len(sink.visions) == 50


def test_of_two_loops_with_one_lock_only_the_one_that_computes_is_encoding():
    clock, lock = FakeClock(), threading.Lock()
    seen = []

    def encoding(encode):
        camera = StillCamera(clock, np.zeros((8, 8, 3), np.uint8))
        return make_loop(clock, camera, lock=lock, encode=encode)

    def encode_second(rgb, camera):
        seen.append((first.encoding_since_ns, second.encoding_since_ns))
        return np.zeros((1, 8), np.float32)

    def encode_first(rgb, camera):
        waiting.start()
        waiting.join(0.05)  # the other cannot end before this one has
        seen.append((first.encoding_since_ns, second.encoding_since_ns))
        return np.zeros((1, 8), np.float32)

    first, second = encoding(encode_first), encoding(encode_second)
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
    return make_loop(clock, camera, cache=cache, image_watch=image_watch)


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
