"""Which images and states one chunk comes from."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from mavbridge.core.clock import NS_PER_MS
from mavbridge.core.reasons import Code, Reason, because
from mavbridge.core.records import FeatureFrame, VehicleState
from mavbridge.flight.feature_cache import MAX_PAST, FeatureCache
from mavbridge.flight.state import MAX_STATES, Observation, ObservationSource
from policy.contract import Contract
from policy.protocol import PolicyRunner

MS = NS_PER_MS
NOW_NS = 10_000 * MS
THREE_STEPS = Contract(observation_steps=3, observation_dt_s=0.1, feature_dim=1)
TWO_CAMERAS = Contract(cameras=("front", "down"), feature_dim=1)


BLACK = because(Code.IMAGE_BLANK, what="black", age_s=0.6)


def of(camera: str, why: Reason) -> Reason:
    return because(Code.OF_CAMERA, camera=camera, why=why)


def seen(ago_ms: float, fault: Reason | None = None) -> FeatureFrame:
    """A feature whose value is its age in ms."""
    captured_ns = NOW_NS - round(ago_ms * MS)
    value = np.full((1, 1), ago_ms, np.float32)
    return FeatureFrame(
        frame_id=0, captured_ns=captured_ns, ready_ns=captured_ns, value=value, fault=fault
    )


def felt(ago_ms: float) -> VehicleState:
    at_ns = NOW_NS - round(ago_ms * MS)
    values = np.full(13, ago_ms, np.float32)
    values[3:7] = (1, 0, 0, 0)
    return VehicleState(
        values=values, attitude_ns=at_ns, rate_ns=at_ns, velocity_ns=at_ns, specific_force_ns=at_ns
    )


def source(
    contract: Contract, *caches: FeatureCache, past: Sequence[float] = ()
) -> ObservationSource:
    runner = PolicyRunner(
        contract=contract,
        name="",
        engine="",
        dual_rate=True,
        encode=lambda rgb, camera=0: np.zeros((1, 1), np.float32),
        act=lambda e, s, h: e,
    )
    looks = ObservationSource(contract, caches=caches, join=runner.join, max_age_ns=300 * MS)
    for ago_ms in past:
        looks.push(felt(ago_ms))
    return looks


def cache_of(*ago_ms: float) -> FeatureCache:
    cache = FeatureCache(span_ns=200 * MS)
    for each_ms in ago_ms:
        cache.publish(seen(each_ms))
    return cache


def observed(found: Observation | Reason) -> Observation:
    assert isinstance(found, Observation)
    return found


def test_past_features_are_the_nearest_to_each_step_before_the_newest() -> None:
    # 30 Hz with jitter; the newest is 20 ms old, so 120 and 220 ms are wanted.
    cache = cache_of(254, 221.5, 187, 154, 119, 86, 53, 20)
    past = (210, 201, 190, 110, 99, 90, 10)
    found = observed(source(THREE_STEPS, cache, past=past).observe(felt(0), NOW_NS))
    assert found.encoded.shape == (1, 3, 1)
    assert found.encoded[0, :, 0].tolist() == [221.5, 119, 20]
    assert found.states.shape == (1, 3, 13)
    assert found.states[0, :, 0].tolist() == [201, 99, 0]
    assert found.image_ns == found.captured_ns == NOW_NS - 20 * MS


def test_the_oldest_is_repeated_where_there_is_no_older_one() -> None:
    found = observed(source(THREE_STEPS, cache_of(60, 20), past=[30]).observe(felt(0), NOW_NS))
    assert found.encoded[0, :, 0].tolist() == [60, 60, 20]
    assert found.states[0, :, 0].tolist() == [30, 30, 0]
    alone = source(THREE_STEPS, cache_of(20))
    found = observed(alone.observe(felt(0), NOW_NS))
    assert found.encoded[0, :, 0].tolist() == [20, 20, 20]
    assert found.states[0, :, 0].tolist() == [0, 0, 0]


def test_an_image_with_a_fault_is_nobodys_past() -> None:
    cache = cache_of(221, 187)
    cache.publish(seen(120, fault=BLACK))
    cache.publish(seen(20))
    found = observed(source(THREE_STEPS, cache).observe(felt(0), NOW_NS))
    assert found.encoded[0, :, 0].tolist() == [221, 187, 20]


def test_each_past_state_is_told_of_its_own_image() -> None:
    contract = replace(THREE_STEPS, since_exposure=True)
    looks = source(contract, cache_of(230, 125, 20), past=(250, 200, 150, 100, 50))
    looks.push(felt(0))
    rows = observed(looks.observe(felt(0), NOW_NS)).states[0]
    np.testing.assert_allclose(rows[:, 13], [0.030, 0.025, 0.020], atol=1e-6)
    # Velocity is -time here: since the exposure each component has fallen by the image's age in ms.
    np.testing.assert_allclose(rows[:, 17], [-30, -25, -20], atol=1e-3)


@pytest.mark.parametrize(
    ("front", "down", "reason"),
    [
        (None, seen(20), of("front", because(Code.NO_IMAGE))),
        (seen(20), None, of("down", because(Code.NO_IMAGE))),
        (
            seen(20),
            seen(301),
            of("down", because(Code.TOO_OLD, quantity="image", age_ms=301.0, limit_ms=300.0)),
        ),
        (seen(20), seen(20, BLACK), of("down", BLACK)),
        (seen(20), seen(300), None),
    ],
)
def test_no_camera_may_be_missing_old_or_at_fault(
    front: FeatureFrame | None, down: FeatureFrame | None, reason: Reason | None
) -> None:
    caches = FeatureCache(), FeatureCache()
    for cache, frame in zip(caches, (front, down), strict=True):
        if frame is not None:
            cache.publish(frame)
    found = source(TWO_CAMERAS, *caches).observe(felt(0), NOW_NS)
    assert (found if isinstance(found, Reason) else None) == reason


@pytest.mark.parametrize("ago_ms", [None, 20, 301])
def test_a_refusal_explains_an_image_that_is_missing_or_old(ago_ms: int | None) -> None:
    cache, dark = FeatureCache(), because(Code.POLICY_REFUSED, said="too dark")
    if ago_ms is not None:
        cache.publish(seen(ago_ms))
    cache.refusal = dark
    found = source(Contract(feature_dim=1), cache).observe(felt(0), NOW_NS)
    assert (found == dark) is (ago_ms != 20)


def test_the_age_is_that_of_the_oldest_of_the_newest_images() -> None:
    caches = FeatureCache(), FeatureCache()
    for cache, ago_ms in zip(caches, (20, 90), strict=True):
        cache.publish(seen(150))
        cache.publish(seen(ago_ms))
    found = observed(source(TWO_CAMERAS, *caches).observe(felt(0), NOW_NS))
    assert found.image_ns == NOW_NS - 90 * MS
    assert found.encoded.tolist() == [[20, 90]]
    assert found.captured_ns == NOW_NS - 20 * MS


def test_histories_are_bounded() -> None:
    past = range(6000, 0, -1)
    contract = replace(THREE_STEPS, observation_steps=16, observation_dt_s=1.0)
    cache = FeatureCache(span_ns=60_000 * MS)
    for ago_ms in past:
        cache.publish(seen(ago_ms))
    looks = source(contract, cache, past=past)
    rows = observed(looks.observe(felt(0), NOW_NS)).states[0]
    assert rows[0, 0] == MAX_STATES
    assert cache.nearest(seen(0), before_ns=60_000 * MS).value[0, 0] == MAX_PAST
    short = source(THREE_STEPS, cache, past=(*past, 50))  # 50 is late
    assert len(short._states) == 201


def aged(attitude_ms: float, velocity_ms: float) -> VehicleState:
    return replace(felt(attitude_ms), velocity_ns=NOW_NS - round(velocity_ms * MS))


def test_a_state_counts_by_attitude_or_velocity_and_leaves_when_both_are_old() -> None:
    newest = source(Contract(feature_dim=1))
    for ago_ms in (10, 0):
        newest.push(felt(ago_ms))
    assert len(newest._states) == 1
    looks = source(THREE_STEPS)  # 200 ms
    for state, kept in (
        (aged(400, 400), 1),
        (aged(400, 400), 1),
        (aged(400, 390), 2),
        (aged(390, 390), 3),
        (aged(400, 390), 3),
    ):
        looks.push(state)
        assert len(looks._states) == kept
    for states, kept in (
        ([aged(300, 300), aged(250, 100), aged(0, 0)], 3),
        ([aged(300, 300), aged(100, 250), aged(0, 0)], 3),
        ([aged(400, 400), aged(300, 300), aged(0, 0)], 2),
    ):
        looks = source(THREE_STEPS)
        for state in states:
            looks.push(state)
        assert len(looks._states) == kept


def test_the_newest_row_is_the_state_itself_with_its_optional_inputs() -> None:
    state = replace(felt(0), extras=(7.0,))
    looks = source(THREE_STEPS, cache_of(20))
    for ago_ms in (200, 100):
        looks.push(replace(felt(ago_ms), extras=(7.0,)))
    looks.push(replace(state, values=felt(5).values))
    rows = observed(looks.observe(state, NOW_NS)).states[0, -1]
    assert rows.tolist() == [*state.values.tolist(), 7.0]
