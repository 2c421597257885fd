"""Whole flights in memory: the real loops and link against the real simulator."""

from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
import pytest

from helpers.fakes import ListSink
from helpers.pilots import single_rate, steady
from mavbridge.config.flight import FlyConfig
from mavbridge.config.policy import Rates
from mavbridge.core.clock import NS_PER_MS, NS_PER_S
from mavbridge.core.records import Tick
from mavbridge.simulation.delays import Delay, Delays
from mavbridge.simulation.flight import SimulatedFlight, SimulationSettings
from policy.contract import FloatArray
from policy.errors import PolicyError
from sitl.vehicle.config import STEP_NS

MS = NS_PER_MS
HOP_NS = MS // 10
CLIMB = (0.5, 0.0, 0.0, 0.0)
STAMP_ERROR_NS = MS + MS // 2
"""The vehicle cuts its stamps off to a millisecond, and answers TIMESYNC at its next step."""
FIXED = Delays(
    camera=Delay(p50_ns=5 * MS),
    vision=Delay(p50_ns=12 * MS),
    action=Delay(p50_ns=3 * MS),
    hop=Delay(p50_ns=HOP_NS),
    uplink=Delay(p50_ns=MS // 2),
    downlink=Delay(p50_ns=MS // 2),
)
BLIND = SimulationSettings(draw_images=False)


def flight(settings: SimulationSettings = BLIND, *, seed: int = 0, **given: int) -> SimulatedFlight:
    return SimulatedFlight(course_seed=given.get("course_seed", 3), seed=seed, settings=settings)


def flown(sink: ListSink) -> list[Tick]:
    return [tick for tick in sink.ticks if tick.trace is not None]


def climb(settings: SimulationSettings, *, seed: int = 0, is_dual: bool = True) -> ListSink:
    """What a sink saw of one second of climbing."""
    sink, pilot = ListSink(), steady(lambda: CLIMB)
    flight(settings, seed=seed).fly(
        pilot if is_dual else single_rate(pilot), max_time_s=1.0, sinks=(sink,)
    )
    return sink


@dataclass
class Watched:
    """A flight with images and fixed delays, and all that can be watched of it."""

    sink: ListSink = field(default_factory=ListSink)
    encoded: list[float] = field(default_factory=list)
    features: list[float] = field(default_factory=list)


@pytest.fixture(scope="module")
def watched() -> Watched:
    watched, one = Watched(), flight(SimulationSettings(delays=FIXED))
    pilot = steady(lambda: CLIMB)

    def encode(rgb: np.ndarray, camera: int = 0) -> FloatArray:
        watched.encoded.append(float(rgb.mean()))
        return np.full((1, 1), rgb.mean(), np.float32)

    def act(e: FloatArray, s: FloatArray, h: FloatArray) -> FloatArray:
        watched.features.append(float(e[0, 0]))
        return pilot.act(e, s, h)

    runner = replace(pilot, encode=encode, act=act)
    one.fly(runner, max_time_s=1.0, sinks=(watched.sink,))
    return watched


def test_ages_are_what_was_injected(watched: Watched) -> None:
    visions = watched.sink.visions
    for vision in visions:
        assert vision.ready_ns - vision.started_ns == 12 * MS
        # The stamp is that of the vehicle's last step, up to 2.5 ms before the shutter.
        assert 5 * MS <= vision.started_ns - vision.captured_ns < 5 * MS + STEP_NS
    ticks = flown(watched.sink)
    boot_ns = visions[0].captured_ns % STEP_NS
    first = {tick.chunk_serial: tick for tick in reversed(ticks)}
    assert len(first) == pytest.approx(101, abs=1)
    for tick in list(first.values())[:-1]:
        assert tick.predict_ns == 3 * MS
        assert tick.chunk_computed_ns is not None
        assert tick.sent_ns - tick.chunk_computed_ns == HOP_NS
        solved_ns = tick.chunk_computed_ns - 3 * MS
        ready = [v.captured_ns for v in visions if v.ready_ns <= solved_ns]
        assert tick.feature_captured_ns == max(ready)
        assert tick.state is not None
        # The downlink, and a hop: every solve starts on an attitude that has just come.
        assert abs(solved_ns - HOP_NS - MS // 2 - tick.state.attitude_ns) <= STAMP_ERROR_NS
        force_ns = tick.state.specific_force_ns  # this stamp is in us
        assert (force_ns - boot_ns + MS // 2) % STEP_NS <= MS
        # The last one: at its rate of 100 Hz the accelerometer is a few steps out of phase.
        assert 0 <= tick.state.attitude_ns - force_ns <= 10 * MS


def test_each_image_is_encoded_once_and_each_action_gets_its_feature(watched: Watched) -> None:
    visions, ticks = watched.sink.visions, flown(watched.sink)
    by_frame = {vision.frame_id: np.float32(vision.rgb.mean()) for vision in visions}
    features = [by_frame[int(tick.feature_frame_id or 0)] for tick in ticks]
    assert features == [watched.features[int(tick.chunk_serial or 0) - 1] for tick in ticks]
    assert [np.float32(mean) for mean in watched.encoded][: len(visions)] == list(by_frame.values())


def test_a_policy_that_looks_at_less_sees_a_camera_of_the_usual_size(watched: Watched) -> None:
    assert {vision.rgb.shape for vision in watched.sink.visions} == {(224, 224, 3)}


def test_a_policy_that_looks_at_more_sees_a_larger_camera() -> None:
    pilot, sink = steady(lambda: CLIMB), ListSink()
    contract = replace(pilot.contract, image_height=256, image_width=256)
    flight().fly(replace(pilot, contract=contract), max_time_s=0.2, sinks=(sink,))
    assert {vision.rgb.shape for vision in sink.visions} == {(256, 256, 3)}


def test_thirty_frames_feed_a_hundred_actions_a_second() -> None:
    sink = climb(BLIND, seed=5)
    ticks = flown(sink)
    slots = [tick for tick in sink.ticks if tick.is_slot]
    assert {(tick.due_ns - slots[0].due_ns) % (10 * MS) for tick in slots} == {0}
    assert sum(tick.missed_slots for tick in ticks) == 0
    assert max(b.sent_ns - a.sent_ns for a, b in pairwise(ticks)) < 15 * MS
    captured = [vision.captured_ns for vision in sink.visions]
    assert set(np.diff(captured) // STEP_NS) <= {13, 14}  # 33.3 ms on the grid of 2.5
    solves = {tick.chunk_serial: tick.feature_frame_id for tick in ticks}
    assert len(solves) == pytest.approx(100, abs=2)
    frames = list(solves.values())
    served = [frames.count(frame) for frame in sorted(set(map(int, filter(None, frames))))]
    assert set(served[1:-1]) <= {2, 3, 4, 5}
    assert len(served) == pytest.approx(30, abs=2)
    for stamps in ([t.sent_ns for t in sink.ticks], [v.ready_ns for v in sink.visions]):
        assert stamps == sorted(stamps)


@pytest.mark.parametrize(("stick_hz", "action_hz"), [(50, 100.0), (400, 5.0)])
def test_the_sticks_keep_their_rate_whatever_the_rate_of_the_policy(
    stick_hz: float, action_hz: float
) -> None:
    config = FlyConfig(rates=Rates(stick_rate=stick_hz, action_rate=action_hz))
    sink, pilot = ListSink(), steady(lambda: CLIMB)
    pilot = replace(pilot, contract=replace(pilot.contract, play_s=0.2))
    flight(replace(BLIND, delays=FIXED, config=config)).fly(pilot, max_time_s=1.0, sinks=(sink,))
    ticks = flown(sink)
    assert max(b.sent_ns - a.sent_ns for a, b in pairwise(ticks)) <= 1.5 * NS_PER_S / stick_hz
    assert {tick.missed_slots for tick in ticks} == {0}
    assert len({tick.chunk_serial for tick in ticks}) == pytest.approx(action_hz, abs=2)


def test_a_slow_encoder_takes_the_newest_frame_and_drops_the_rest() -> None:
    vision, action = Delay(p50_ns=80 * MS), Delay(p50_ns=MS)
    delays = Delays(camera=Delay(p50_ns=0), vision=vision, action=action)
    sink = climb(replace(BLIND, delays=delays))
    starts = [vision.started_ns for vision in sink.visions]
    assert min(np.diff(starts)) >= 80 * MS
    assert sink.visions[-1].dropped_frames > len(starts)


def test_an_action_that_takes_longer_than_its_slot_costs_no_slot() -> None:
    ticks = flown(climb(replace(BLIND, delays=Delays(action=Delay(p50_ns=25 * MS)))))
    assert {tick.missed_slots for tick in ticks} == {0}
    assert max(b.sent_ns - a.sent_ns for a, b in pairwise(ticks)) < 15 * MS
    assert len({tick.chunk_serial for tick in ticks}) == pytest.approx(1000 / 25, abs=3)


def test_single_rate_takes_the_time_of_the_whole_network_for_every_action() -> None:
    sink = climb(replace(BLIND, delays=FIXED), is_dual=False)
    ticks = flown(sink)
    assert len({tick.chunk_serial for tick in ticks}) == pytest.approx(30, abs=2)
    assert {tick.predict_ns for tick in ticks} == {15 * MS}
    assert {vision.ready_ns - vision.started_ns for vision in sink.visions} == {0}


def test_a_crash_ends_the_flight() -> None:
    one, is_diving = flight(), False

    def dive() -> tuple[float, float, float, float]:
        nonlocal is_diving
        is_diving = is_diving or -one.vehicle.ap.truth.position_ned_m[2] > 5.0
        return (-1.0, 0.0, 1.0, 0.0) if is_diving else (1.0, 0.0, 0.0, 0.0)

    result = one.fly(steady(dive), max_time_s=60.0)
    assert result.outcome == "crashed"
    assert result.flown_s < 20.0
    assert result.course_s is None


def test_the_error_of_a_policy_that_fails_is_not_swallowed() -> None:
    one = flight()

    def fail() -> tuple[float, float, float, float]:
        if one.vehicle.ap.truth.position_ned_m[2] < -0.5:
            raise PolicyError("no idea")
        return CLIMB

    with pytest.raises(PolicyError, match="no idea"):
        one.fly(steady(fail))
