from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from helpers.factories import make_state, make_tick, make_vision_tick
from mavbridge.config.rates import Rates
from mavbridge.core.clock import NS_PER_MS, NS_PER_S
from mavbridge.core.records import Tick, VisionTick
from mavbridge.flight.vision_rate import BUDGET, AdaptiveRate


def turning(rate_radps: float) -> Tick:
    values = make_state().values.copy()
    values[9] = rate_radps
    return make_tick(state=make_state(values=values))


def look(
    rate: AdaptiveRate, seconds: float, *, encode_ms: float = 5.0, flicker: int = 0, start: int = 0
) -> None:
    """Frames at 30 Hz that alternate between two greys."""
    for k in range(start, start + round(seconds * 30)):
        at_ns = k * NS_PER_S // 30
        grey = np.full((64, 64, 3), 100 + flicker * (k % 2), dtype=np.uint8)
        event: VisionTick = replace(
            make_vision_tick(),
            captured_ns=at_ns,
            started_ns=at_ns,
            ready_ns=at_ns + round(encode_ms * NS_PER_MS),
            rgb=grey,
        )
        rate.emit(event)


def test_a_still_scene_is_looked_at_rarely_and_a_turn_often() -> None:
    rate = AdaptiveRate(min_hz=10, max_hz=60)
    assert rate.rate_hz == 60  # nothing known yet
    look(rate, 5)
    assert rate.rate_hz == pytest.approx(10, abs=0.1)
    rate.emit(turning(0.75))
    look(rate, 0.1, start=150)
    assert rate.rate_hz == pytest.approx(35)
    rate.emit(turning(9.0))
    look(rate, 0.1, start=153)
    assert rate.rate_hz == 60
    rate.emit(turning(0.0))
    look(rate, 0.5, start=156)
    assert 10 < rate.rate_hz < 35  # calms down with time, not at once
    look(rate, 5, start=171)
    assert rate.rate_hz == pytest.approx(10, abs=0.1)


def test_a_changing_image_is_motion() -> None:
    rate = AdaptiveRate(min_hz=10, max_hz=60)
    look(rate, 5, flicker=4)  # 4 / 255 of full scale, 30 times a second
    assert rate.rate_hz == pytest.approx(10 + 50 * 4 / 255 * 30, abs=0.5)


def test_the_encoder_bounds_the_rate() -> None:
    rate = AdaptiveRate(min_hz=10, max_hz=60)
    rate.emit(turning(9.0))
    look(rate, 1, encode_ms=20)
    assert rate.rate_hz == pytest.approx(BUDGET / 0.020)
    look(rate, 1, encode_ms=200, start=30)
    assert rate.rate_hz == 10


events = st.one_of(
    st.floats(0, 100).map(turning),
    st.tuples(st.integers(0, 10**10), st.integers(0, 10**9), st.integers(0, 255)).map(
        lambda t: replace(
            make_vision_tick(),
            captured_ns=t[0],
            started_ns=t[0],
            ready_ns=t[0] + t[1],
            rgb=np.full((8 + t[2] % 3, 8, 3), t[2], dtype=np.uint8),
        )
    ),
)


@given(st.lists(events, max_size=40), st.floats(1, 60), st.floats(0, 60))
def test_it_never_leaves_its_limits(
    history: list[Tick | VisionTick], min_hz: float, span_hz: float
) -> None:
    rate = AdaptiveRate(min_hz=min_hz, max_hz=min_hz + span_hz)
    for event in history:
        rate.emit(event)
        assert min_hz <= rate.rate_hz <= min_hz + span_hz


@pytest.mark.parametrize(
    ("given_rate", "limits"),
    [(30.0, (30, 30)), ("auto", (10, 60)), ("auto:5:30", (5, 30)), ("auto:20:20", (20, 20))],
)
def test_the_flag(given_rate: float | str, limits: tuple[float, float]) -> None:
    assert Rates(visual_rate=given_rate).visual_limits_hz == limits


@pytest.mark.parametrize(("change", "hz"), [(0, 10.0), (60_000, 60.0)])
def test_depth_is_compared_without_overflow(change: int, hz: float) -> None:
    rate = AdaptiveRate(min_hz=10, max_hz=60)
    for k in range(150):
        depth = np.full((64, 64), 2_000 + change * (k % 2), np.uint16)
        at_ns = k * NS_PER_S // 30
        stamps = {"captured_ns": at_ns, "started_ns": at_ns, "ready_ns": at_ns + NS_PER_MS}
        rate.emit(replace(make_vision_tick(), rgb=depth, **stamps))
    assert rate.rate_hz == pytest.approx(hz, abs=0.1)
