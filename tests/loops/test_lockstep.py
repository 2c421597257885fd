"""Whole flights in memory: the real loops and link against the real simulator."""

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from helpers.fakes import ListSink
from helpers.pilots import pursuit, single_rate, steady
from mavbridge.config.policy import PolicyConfig
from mavbridge.config.rates import Rates
from mavbridge.core.clock import NS_PER_MS, NS_PER_S
from mavbridge.core.errors import PeerError, UserError
from mavbridge.core.records import Tick
from mavbridge.flight.policies import load_configured_policy
from mavbridge.simulation.delays import Delays, Fixed
from mavbridge.simulation.episode import Episode, Setup, run_episode
from mavbridge.simulation.referee import EpisodeInterruptedError
from mavbridge.simulation.result import EpisodeResult
from mavbridge.simulation.wire import MemoryTransport
from mavbridge.simulation.world import Exposure, Scene, nominal_scene
from policy.contract import Executable, FloatArray
from policy.errors import PolicyError
from sitl.simulated_vehicle import SimulatedVehicle
from sitl.vehicle.autopilot import STEP_NS, VehicleConfig

MS = NS_PER_MS
HOVER = (0.0, 0.0, 0.0, 0.0)
CLIMB = (0.5, 0.0, 0.0, 0.0)
FIXED = Delays(
    camera=Fixed(5 * MS),
    vision=Fixed(12 * MS),
    action=Fixed(3 * MS),
    uplink=Fixed(MS // 2),
    downlink=Fixed(MS // 2),
)


def scripted(program: str) -> tuple[Episode, Executable]:
    episode = Episode(course_seed=3, seed=0, setup=Setup(draw_images=False))
    wanted = PolicyConfig(policy=f"scripted:{program}", dual_rate=True)
    return episode, load_configured_policy(wanted, episode.clock).executable


def flying(sink: ListSink) -> list[Tick]:
    return [tick for tick in sink.ticks if tick.trace is not None]


def stick_bytes(monkeypatch: pytest.MonkeyPatch, *, seed: int) -> list[bytes]:
    """All that the bridge sends in one flight through gates by sight of the truth."""
    sent: list[bytes] = []
    send = MemoryTransport.send

    def spy(self: MemoryTransport, data: bytes) -> bool:
        sent.append(data)
        return send(self, data)

    with monkeypatch.context() as patch:
        patch.setattr(MemoryTransport, "send", spy)
        episode = Episode(course_seed=3, seed=seed)
        episode.fly(pursuit(episode), max_time_s=3.0)
    return sent


def test_the_same_seed_sends_the_same_bytes_and_another_one_others(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    first = stick_bytes(monkeypatch, seed=1)
    assert len(first) > 400
    assert stick_bytes(monkeypatch, seed=1) == first
    assert stick_bytes(monkeypatch, seed=2) != first


def test_a_pilot_with_the_true_state_flies_all_gates() -> None:
    episode = Episode(course_seed=1_000_003, seed=0)
    result = episode.fly(pursuit(episode), max_time_s=60.0)
    assert result.outcome == "finished"
    assert result.gates_passed == result.gates_total == 8
    assert list(result.gate_times_s) == sorted(result.gate_times_s)
    assert result.course_s == result.gate_times_s[-1]
    assert result.flown_s == pytest.approx(result.gate_times_s[-1] + 1.0, abs=0.01)
    assert 1.0 < result.mean_speed_mps < 3.5
    assert result.stick_rate_per_s is not None
    # The sticks were given back: the receiver's idle throttle is what the vehicle acts on.
    assert episode.vehicle.ap.rc.channels_us[2] == 1000


def test_ages_are_what_was_injected() -> None:
    sink = ListSink()
    run_episode(
        steady(lambda: CLIMB),
        course_seed=3,
        seed=0,
        setup=Setup(delays=FIXED),
        max_time_s=3.0,
        sinks=(sink,),
    )
    for vision in sink.visions:
        assert vision.ready_ns - vision.started_ns == 12 * MS
        # The stamp is that of the vehicle's last step, up to 2.5 ms before the shutter.
        assert 5 * MS <= vision.started_ns - vision.captured_ns < 5 * MS + STEP_NS
    ticks = flying(sink)
    assert len(ticks) == pytest.approx(301, abs=1)
    boot_ns = sink.visions[0].captured_ns % STEP_NS
    for tick in ticks:
        assert tick.predict_ns == 3 * MS
        assert tick.sent_ns - tick.woke_ns == 3 * MS
        ready = [v.captured_ns for v in sink.visions if v.ready_ns <= tick.woke_ns]
        assert tick.feature_captured_ns == max(ready)
        assert tick.state is not None
        assert 0 <= tick.woke_ns - tick.state.attitude_ns <= 10 * MS
        assert (tick.state.attitude_ns - MS // 2) % STEP_NS == boot_ns


def test_thirty_frames_feed_a_hundred_actions_a_second() -> None:
    sink = ListSink()
    run_episode(
        steady(lambda: CLIMB),
        course_seed=3,
        seed=5,
        setup=Setup(draw_images=False),
        max_time_s=3.0,
        sinks=(sink,),
    )
    ticks = flying(sink)
    assert {b.due_ns - a.due_ns for a, b in pairwise(ticks)} == {10 * MS}
    assert sum(tick.missed_slots for tick in ticks) == 0
    captured = [vision.captured_ns for vision in sink.visions]
    assert set(np.diff(captured) // STEP_NS) <= {13, 14}  # 33.3 ms on the grid of 2.5
    frames = [tick.feature_frame_id for tick in ticks]
    served = [frames.count(frame) for frame in sorted(set(map(int, filter(None, frames))))]
    assert set(served[1:-1]) <= {2, 3, 4, 5}
    assert len(served) == pytest.approx(90, abs=2)
    stamps = [e.sent_ns if isinstance(e, Tick) else e.ready_ns for e in sink.events]
    assert stamps == sorted(stamps)


def test_a_slow_encoder_takes_the_newest_frame_and_drops_the_rest() -> None:
    sink = ListSink()
    delays = Delays(camera=Fixed(0), vision=Fixed(80 * MS), action=Fixed(MS))
    run_episode(
        steady(lambda: CLIMB),
        course_seed=3,
        seed=0,
        setup=Setup(delays=delays),
        max_time_s=1.0,
        sinks=(sink,),
    )
    starts = [vision.started_ns for vision in sink.visions]
    assert min(np.diff(starts)) >= 80 * MS
    assert sink.visions[-1].dropped_frames > len(starts)


def test_an_action_that_takes_longer_than_its_slot_misses_slots() -> None:
    sink = ListSink()
    delays = Delays(action=Fixed(25 * MS))
    run_episode(
        steady(lambda: CLIMB),
        course_seed=3,
        seed=0,
        setup=Setup(delays=delays, draw_images=False),
        max_time_s=1.0,
        sinks=(sink,),
    )
    assert {tick.missed_slots for tick in flying(sink)[1:]} == {2}


@pytest.mark.parametrize("program", ["hover", "circle", "square", "yaw"])
def test_the_scripted_policies_fly(program: str) -> None:
    episode, executable = scripted(program)
    result = episode.fly(executable, max_time_s=9.0)
    assert result.outcome == "timed out"
    body = episode.vehicle.ap.truth
    assert -body.position_ned_m[2] == pytest.approx(3.0, abs=1.0)
    if program in ("circle", "square"):
        assert result.distance_m > 6.0
    if program in ("circle", "yaw"):
        assert abs(body.ned_from_body_wxyz[3]) > 0.3


def test_single_rate_takes_the_time_of_the_whole_network_for_every_action() -> None:
    sink = ListSink()
    run_episode(
        single_rate(steady(lambda: CLIMB)),
        course_seed=3,
        seed=0,
        setup=Setup(delays=FIXED),
        max_time_s=1.0,
        sinks=(sink,),
    )
    ticks = flying(sink)
    assert len(ticks) == pytest.approx(30, abs=2)
    assert {tick.predict_ns for tick in ticks} == {15 * MS}
    assert {vision.ready_ns - vision.started_ns for vision in sink.visions} == {0}


def test_state_pacing_acts_on_states_that_have_just_come() -> None:
    sink = ListSink()
    run_episode(
        steady(lambda: CLIMB),
        course_seed=3,
        seed=0,
        setup=Setup(rates=Rates(pace="state"), delays=FIXED, draw_images=False),
        max_time_s=1.0,
        sinks=(sink,),
    )
    ages = [t.woke_ns - t.state.attitude_ns for t in flying(sink)[1:] if t.state is not None]
    assert len(ages) > 90
    assert max(ages) == 0


def test_a_crash_ends_the_episode() -> None:
    episode = Episode(course_seed=3, seed=0, setup=Setup(draw_images=False))

    def dive() -> tuple[float, float, float, float]:
        is_up = -episode.vehicle.ap.truth.position_ned_m[2] > 5.0 or bool(dives)
        dives.extend([True] if is_up else [])
        return (-1.0, 0.0, 1.0, 0.0) if is_up else (1.0, 0.0, 0.0, 0.0)

    dives: list[bool] = []
    result = episode.fly(steady(dive), max_time_s=60.0)
    assert result.outcome == "crashed"
    assert result.flown_s < 20.0
    assert result.course_s is None


def test_exposures_and_steps_tell_the_truth_behind_each_frame() -> None:
    episode = Episode(course_seed=3, seed=0)
    exposures: dict[int, Exposure] = {}
    steps: list[int] = []
    episode.watch_exposures(lambda exposure: exposures.update({exposure.frame_id: exposure}))
    episode.watch_steps(lambda: steps.append(episode.vehicle.ap.now_ns))
    sink = ListSink()
    episode.fly(steady(lambda: CLIMB), max_time_s=1.0, sinks=(sink,))
    assert set(np.diff(steps)) == {STEP_NS}
    for vision in sink.visions:
        assert exposures[vision.frame_id].captured_ns == vision.captured_ns
        assert vision.captured_ns in steps
    bodies = [exposures[vision.frame_id].body for vision in sink.visions]
    assert bodies[-1].position_ned_m[2] < -0.2
    assert not np.array_equal(sink.visions[0].rgb, sink.visions[-1].rgb)


@pytest.mark.parametrize(("wanted", "drawn"), [(96, 224), (256, 256)])
def test_the_camera_is_not_smaller_for_a_policy_that_looks_at_less(wanted: int, drawn: int) -> None:
    pilot = steady(lambda: CLIMB)
    contract = replace(pilot.contract, image_height=wanted, image_width=wanted)
    sink = ListSink()
    Episode(course_seed=3, seed=0).fly(
        replace(pilot, contract=contract), max_time_s=0.2, sinks=(sink,)
    )
    assert {vision.rgb.shape for vision in sink.visions} == {(drawn, drawn, 3)}


def test_an_image_is_encoded_once_and_only_for_an_action() -> None:
    images: list[float] = []
    seen: list[float] = []
    executable = steady(lambda: CLIMB)

    def encode(rgb: np.ndarray) -> FloatArray:
        images.append(float(rgb.mean()))
        return np.full((1, 1), rgb.mean(), np.float32)

    def act(e: FloatArray, s: FloatArray, h: FloatArray, elapsed_s: float | None) -> FloatArray:
        seen.append(float(e[0, 0]))
        return executable.act(e, s, h, elapsed_s)

    sink = ListSink()
    watching = Executable(
        contract=executable.contract,
        name="test",
        engine="numpy",
        dual_rate=True,
        encode=encode,
        act=act,
    )
    run_episode(watching, course_seed=3, seed=0, max_time_s=1.0, sinks=(sink,))
    by_frame = {vision.frame_id: np.float32(vision.rgb.mean()) for vision in sink.visions}
    ticks = flying(sink)
    assert [by_frame[int(t.feature_frame_id or 0)] for t in ticks] == seen[: len(ticks)]
    assert len(images) == len({tick.feature_frame_id for tick in ticks})
    assert len(images) < len(sink.visions) / 2  # most of them were taken before the flight


def never_ready(*, course_seed: int, seed: int, boot_ns: int) -> Scene:
    scene = nominal_scene(course_seed=course_seed, seed=seed, boot_ns=boot_ns)
    slow = VehicleConfig(estimator_ready_s=1000.0)
    return Scene(
        vehicle=SimulatedVehicle(links=1, boot_ns=boot_ns, config=slow, course=scene.course),
        course=scene.course,
        make_renderer=scene.make_renderer,
    )


def test_a_vehicle_that_does_not_get_ready_is_an_error() -> None:
    setup = Setup(draw_images=False)
    with pytest.raises(PeerError, match="did not get the sticks within 30 s"):
        run_episode(
            steady(lambda: HOVER), course_seed=3, seed=0, setup=setup, build_scene=never_ready
        )


def test_a_policy_that_fails_gives_the_sticks_back() -> None:
    episode = Episode(course_seed=3, seed=0, setup=Setup(draw_images=False))

    def fail() -> tuple[float, float, float, float]:
        if episode.vehicle.ap.truth.position_ned_m[2] < -0.5:
            raise PolicyError("no idea")
        return CLIMB

    with pytest.raises(PolicyError, match="no idea"):
        episode.fly(steady(fail))
    assert episode.vehicle.ap.rc.channels_us[2] == 1000


def interrupted(episode: Episode) -> EpisodeResult:
    stop_ns = episode.clock.now_ns() + 6 * NS_PER_S
    return episode.fly(steady(lambda: CLIMB), should_stop=lambda: episode.clock.now_ns() >= stop_ns)


def negative(episode: Episode) -> EpisodeResult:
    return run_episode(steady(lambda: HOVER), course_seed=3, seed=-1)


def twice(episode: Episode) -> EpisodeResult:
    episode.fly(steady(lambda: CLIMB), max_time_s=0.1)
    return episode.fly(steady(lambda: CLIMB), max_time_s=0.1)


@pytest.mark.parametrize(
    ("misuse", "error"),
    [(interrupted, EpisodeInterruptedError), (negative, UserError), (twice, UserError)],
)
def test_no_result_without_a_whole_episode(
    misuse: Callable[[Episode], EpisodeResult], error: type[Exception]
) -> None:
    with pytest.raises(error):
        misuse(Episode(course_seed=3, seed=0, setup=Setup(draw_images=False)))
