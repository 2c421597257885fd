"""``mavbridge evaluate``: what is flown, how it ends, and its figures."""

import json
import math
import signal
import statistics
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from helpers.evaluated_flights import FINISHED, crashed, finished
from helpers.factories import make_released_tick, make_tick, make_trace, make_vision_tick
from mavbridge.commands.evaluate import (
    INTERRUPTED,
    EpisodeSpec,
    FlownEpisode,
    evaluate,
    fly_simulated,
    mean,
    rate,
    summarise,
)
from mavbridge.config.episodes import (
    COURSE_SEEDS,
    HELD_OUT_COURSE_SEED,
    MAX_EPISODES,
    MAX_EVALUATION_SEED,
    ConditionsKind,
    EvaluateConfig,
)
from mavbridge.config.policy import PolicyConfig
from mavbridge.core.clock import NS_PER_MS
from mavbridge.core.errors import PeerError
from mavbridge.core.reasons import Code
from mavbridge.core.vehicle import NEUTRAL, Sticks
from mavbridge.simulation.referee import StickMeter
from sitl.course import make_course

CIRCLE = PolicyConfig(policy="scripted:circle", dual_rate=True)


def specs(config: EvaluateConfig, count: int = 20) -> list[EpisodeSpec]:
    return [EpisodeSpec(config=config, index=index) for index in range(count)]


def test_seeds_follow_from_the_evaluations_seed_and_the_index_alone() -> None:
    first = specs(EvaluateConfig(policy=CIRCLE))
    other = specs(EvaluateConfig(policy=PolicyConfig(policy="scripted", seed=1)))
    assert [spec.seed for spec in first] == list(range(20))
    assert not {spec.course_seed for spec in first} & {spec.course_seed for spec in other}
    assert all(spec.course_seed >= HELD_OUT_COURSE_SEED for spec in (*first, *other))
    last = EvaluateConfig(policy=PolicyConfig(seed=MAX_EVALUATION_SEED), episodes=MAX_EPISODES)
    assert EpisodeSpec(config=last, index=MAX_EPISODES - 1).course_seed < COURSE_SEEDS["race"]


def test_two_runs_write_the_same_and_other_vehicles_fly_otherwise(tmp_path: Path) -> None:
    def written(conditions: ConditionsKind, folder: str) -> bytes:
        path = tmp_path / folder / "results.json"
        short = EvaluateConfig(policy=CIRCLE, episodes=2, max_time=1.0, json=path)
        assert evaluate(replace(short, conditions=conditions)) == 0
        return path.read_bytes()

    first = written("nominal", "first")
    assert written("nominal", "second") == first
    nominal, random = json.loads(first), json.loads(written("random", "third"))
    assert nominal["summary"]["outcomes"] == {"timed out": 2}
    assert (nominal["flags"]["episodes"], nominal["flags"]["vision_delay"]) == (2, 0.0)
    assert (nominal["flags"]["conditions"], random["flags"]["conditions"]) == ("nominal", "random")
    assert nominal["flags"]["policy"]["policy"] == CIRCLE.policy
    for a, b in zip(nominal["episodes"], random["episodes"], strict=True):
        assert a["distance_m"] != b["distance_m"]


def test_gusts_are_the_only_thing_that_changes() -> None:
    """Each flight has gusts of its own; without any it is the nominal one."""
    config = EvaluateConfig(policy=CIRCLE, max_time=1.0)
    results = [
        [fly_simulated(spec, lambda: False).result for spec in specs(one, 2)]
        for one in (config, replace(config, gusts=0.0), replace(config, gusts=5.0))
    ]
    assert {result.lost for flights in results for result in flights} == {None}
    calm, same, windy = ([result.distance_m for result in flights] for flights in results)
    assert calm == same
    assert len({*calm, *windy}) == 4


def test_images_later_than_the_age_limit_are_not_flown_by() -> None:
    config = EvaluateConfig(policy=CIRCLE, max_time=1.0, vision_delay=400.0)
    with pytest.raises(PeerError, match=r"within 30 s: the image is \d{3} ms old, beyond 300 ms"):
        fly_simulated(EpisodeSpec(config=config, index=0), lambda: False)


def test_a_flight_says_why_the_policy_lost_control() -> None:
    config = EvaluateConfig(policy=CIRCLE, max_time=6.0, stalls=1500.0)
    flown = fly_simulated(EpisodeSpec(config=config, index=0), lambda: False)
    assert flown.result.lost.codes == (Code.LATE,)


def flown(spec: EpisodeSpec) -> FlownEpisode:
    result = (finished, crashed)[spec.index](course_seed=spec.course_seed, seed=spec.seed)
    return FlownEpisode(engine="numpy", notes=("mind the gap",), result=result)


def test_ctrl_c_ends_with_the_results_so_far(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fly(spec: EpisodeSpec, should_stop: Any) -> FlownEpisode:
        if spec.index == 1:
            signal.raise_signal(signal.SIGINT)
        return flown(spec)

    monkeypatch.setattr(f"{evaluate.__module__}.fly_simulated", fly)
    path = tmp_path / "some.json"
    config = EvaluateConfig(policy=CIRCLE, episodes=5, vision_delay=50.0, json=path)
    assert evaluate(config) == INTERRUPTED
    assert len(json.loads(path.read_text())["episodes"]) == 2
    shown = capsys.readouterr()
    assert "interrupted after 2 of 5 episodes" in shown.err
    assert shown.err.count("mind the gap") == 1
    assert "vision delay 50.0" in shown.out
    assert "2 flights: 1 finished, 1 crashed" in shown.out


GATES = make_course(FINISHED.course_seed).gates
LEG_M = math.dist(GATES[0].center_ned_m, GATES[1].center_ned_m)


def test_the_figures_of_three_flights() -> None:
    # One gate has no leg: the speed from gate to gate is that of the two others.
    summary = summarise([finished(), crashed(), finished(gate_times_s=(3.0, 6.0), flown_s=7.5)])
    values = {name: found and (found.value, found.count) for name, found in summary.items()}
    assert values == {
        "success_rate": (pytest.approx(2 / 3), 3),
        "gates_passed": (pytest.approx(5 / 3), 3),
        "mean_speed_mps": (pytest.approx((3.0 + 6.0 + 4.0) / 3), 3),
        "course_speed_mps": (pytest.approx(LEG_M * (1 / 5 + 1 / 3) / 2), 2),
        "stick_rate_per_s": (0.5, 2),
        "flown_s": (pytest.approx(22.5 / 3), 3),
        "course_s": (7.5, 2),
        "drift_m": None,
    }


def test_stick_movement_counts_only_what_the_policy_sent_in_a_row() -> None:
    meter = StickMeter()
    full_yaw = Sticks(throttle=0.0, yaw=1.0, pitch=0.0, roll=0.0)
    half = Sticks(throttle=0.5, yaw=0.5, pitch=0.5, roll=0.5)
    meter.emit(make_released_tick(0))
    assert meter.engaged_ns is None
    assert meter.rate_per_s is None
    meter.emit(make_tick(1, sent=NEUTRAL, trace=make_trace()))
    meter.emit(make_vision_tick())
    meter.emit(make_tick(2, sent=full_yaw, trace=make_trace(full_yaw)))  # 1 in 10 ms
    meter.emit(make_released_tick(3))
    meter.emit(make_tick(4, sent=half, trace=make_trace(half)))  # not compared across the release
    meter.emit(make_tick(5, sent=half, trace=make_trace(half)))  # 0 in 10 ms
    assert meter.engaged_ns == make_tick(1).woke_ns
    assert meter.rate_per_s == pytest.approx(1 / 4 / (20 * NS_PER_MS / 1e9))


@pytest.mark.parametrize(
    ("successes", "count", "low", "high"),
    [  # Wilson's interval with z = 1.96, by hand
        (8, 10, 0.4902, 0.9433),
        (0, 10, 0.0, 0.2775),
        (50, 100, 0.4038, 0.5962),
    ],
)
def test_intervals_are_those_of_the_textbook(
    successes: int, count: int, low: float, high: float
) -> None:
    estimate = rate(successes, count)
    assert estimate.value == successes / count
    assert (estimate.low, estimate.high) == pytest.approx((low, high), abs=1e-4)
    assert estimate.low <= estimate.value <= estimate.high


def test_the_interval_of_a_mean_is_that_of_its_standard_error() -> None:
    spread = mean([float(value) for value in range(100)])
    # Mean 49.5, deviation 28.87, standard error 2.887.
    assert spread.low == pytest.approx(49.5 - 1.96 * 2.887, abs=0.3)
    assert spread.high == pytest.approx(49.5 + 1.96 * 2.887, abs=0.3)


@pytest.mark.parametrize(
    ("count", "t"), [(2, 12.706), (3, 4.303), (4, 3.182), (5, 2.776), (11, 2.228), (31, 2.042)]
)
def test_the_interval_of_few_flights_is_students(count: int, t: float) -> None:
    values = [float(value) for value in range(count)]
    half = t * statistics.stdev(values) / math.sqrt(count)
    assert mean(values).high - mean(values).value == pytest.approx(half, rel=0.01)
