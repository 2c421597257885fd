"""The command: what is flown, what is refused, how it ends."""

import json
import signal
import socket
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mavbridge.__main__ import main
from mavbridge.commands.evaluate import jobs, run
from mavbridge.commands.evaluate.jobs import fly_job, make_jobs
from mavbridge.commands.evaluate.run import INTERRUPTED, evaluate
from mavbridge.config.courses import HELD_OUT_COURSE_SEED, MAX_EPISODES
from mavbridge.config.evaluate import EvaluateConfig, Variety
from mavbridge.config.policy import PolicyConfig
from mavbridge.core.clock import NS_PER_MS
from mavbridge.core.errors import PeerError, UserError
from mavbridge.flight.policies import is_stateless
from mavbridge.simulation.episode import Episode, Setup

CIRCLE = PolicyConfig(policy="scripted:circle", dual_rate=True)


def told(capsys: pytest.CaptureFixture[str], *flags: str) -> tuple[int, str]:
    with pytest.raises(SystemExit) as exit_info:
        main(("evaluate", *flags))
    captured = capsys.readouterr()
    text = " ".join((captured.out + captured.err).replace("│", " ").split())
    assert "Traceback" not in text
    assert isinstance(exit_info.value.code, int)
    return exit_info.value.code, text


def test_seeds_follow_from_the_evaluations_seed_and_the_index_alone() -> None:
    few, many = (make_jobs(EvaluateConfig(policy=CIRCLE, episodes=n)) for n in (3, 20))
    assert few == many[:3]
    other = make_jobs(EvaluateConfig(policy=PolicyConfig(policy="scripted", seed=1), episodes=20))
    assert not {job.course_seed for job in many} & {job.course_seed for job in other}
    assert all(job.course_seed >= HELD_OUT_COURSE_SEED for job in (*many, *other))
    assert len({job.seed for job in many}) == 20


def test_only_built_in_nets_are_kept_from_one_episode_to_the_next() -> None:
    assert is_stateless(PolicyConfig(policy="toge:small"))
    assert is_stateless(PolicyConfig(policy="resnet-unet"))
    assert not is_stateless(CIRCLE)
    assert not is_stateless(PolicyConfig(policy="my.package:Policy"))


def test_two_runs_write_the_same_file(tmp_path: Path) -> None:
    paths = [tmp_path / "first.json", tmp_path / "folder" / "second.json"]
    for path in paths:
        config = EvaluateConfig(policy=CIRCLE, episodes=2, max_time=1.0, json=path)
        assert evaluate(config) == 0
    first, second = (path.read_bytes() for path in paths)
    assert first == second
    document = json.loads(first)
    assert document["mode"] == "lockstep"
    assert document["summary"]["outcomes"] == {"timed out": 2}


def test_varied_vehicles_fly_the_same_twice_and_not_as_the_nominal_one(tmp_path: Path) -> None:
    def episodes(name: str, conditions: Variety) -> list[dict[str, Any]]:
        path = tmp_path / name
        config = EvaluateConfig(
            policy=CIRCLE, episodes=2, max_time=1.5, conditions=conditions, json=path
        )
        assert evaluate(config) == 0
        document = json.loads(path.read_text())
        assert document["conditions"] == conditions
        flown: list[dict[str, Any]] = document["episodes"]
        return flown

    first = episodes("first.json", "random")
    assert episodes("second.json", "random") == first
    nominal = episodes("nominal.json", "nominal")
    assert all(a["distance_m"] != b["distance_m"] for a, b in zip(first, nominal, strict=True))


def test_random_conditions_are_held_out_like_the_courses() -> None:
    for conditions, held_out in (("random", [1_000_000, 1_000_001]), ("nominal", [None, None])):
        config = EvaluateConfig(policy=CIRCLE, episodes=2, conditions=conditions)
        assert [job.conditions_seed for job in make_jobs(config)] == held_out


def test_each_image_takes_longer_by_the_vision_delay(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Setup] = []

    class Spy(Episode):
        def __init__(self, *, setup: Setup, **given: Any) -> None:
            asked.append(setup)
            super().__init__(setup=setup, **given)

    monkeypatch.setattr(jobs, "Episode", Spy)
    for vision_delay in (0.0, 75.0):
        config = EvaluateConfig(policy=CIRCLE, episodes=1, max_time=1.0, vision_delay=vision_delay)
        fly_job(make_jobs(config)[0])
    plain, slow = (setup.delays.vision.sample_ns(np.random.default_rng(1), 50) for setup in asked)
    assert plain == Setup().delays.vision.sample_ns(np.random.default_rng(1), 50)
    assert {b - a for a, b in zip(plain, slow, strict=True)} == {75 * NS_PER_MS}


def test_ctrl_c_ends_with_the_results_so_far(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fly_until_told(job: jobs.Job, should_stop: Any) -> jobs.Flown:
        if job.index == 1:
            signal.raise_signal(signal.SIGINT)
        return fly_job(job, should_stop)

    monkeypatch.setattr(run, "fly_job", fly_until_told)
    path = tmp_path / "some.json"
    config = EvaluateConfig(policy=CIRCLE, episodes=5, max_time=1.0, json=path)
    assert evaluate(config) == INTERRUPTED
    assert len(json.loads(path.read_text())["episodes"]) == 1
    assert "interrupted after 1 of 5 episodes" in capsys.readouterr().err


def test_an_error_costs_no_result_that_was_there_before(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fly_two(job: jobs.Job, should_stop: Any) -> jobs.Flown:
        if job.index == 2:
            raise PeerError("the vehicle is gone")
        return fly_job(job, should_stop)

    monkeypatch.setattr(run, "fly_job", fly_two)
    path = tmp_path / "some.json"
    config = EvaluateConfig(policy=CIRCLE, episodes=5, max_time=1.0, json=path)
    with pytest.raises(PeerError, match="the vehicle is gone"):
        evaluate(config)
    assert len(json.loads(path.read_text())["episodes"]) == 2
    assert "ended after 2 of 5 episodes" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--episodes", "0"], f"--episodes must be between 1 and {MAX_EPISODES}"),
        (["--workers", "0"], "--workers must be between"),
        (["--max-time", "0"], "--max-time must be between"),
        (["--realtime", "--workers", "2"], "--realtime flies one episode at a time"),
        (["--realtime", "--vision-delay", "50"], "--vision-delay is for --lockstep"),
        (["--vision-delay", "-1"], "--vision-delay must be between 0 and 5000 ms"),
        (["--conditions", "stormy"], "--conditions"),
        (["--action-rate", "0"], "between 10 and 500 Hz"),
        (["--policy", "toge:medium"], "--allow-untrained"),
        (["--policy", "scripted", "--json", "/proc/none/out.json"], "cannot write"),
        (["--policy", "scripted", "--json", "/"], "cannot write /"),
        (["--policy", "scripted", "--plot", "/proc/none/out.png"], "cannot write"),
        (["--policy", "scripted", "--ray", "cluster"], "not HOST:PORT"),
        (["--fast"], "Unknown option: --fast"),
    ],
)
def test_a_bad_flag_is_one_clear_error(
    flags: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    status, text = told(capsys, *flags)
    assert status != 0
    assert message in text


def test_help_tells_both_ways_of_flying(capsys: pytest.CaptureFixture[str]) -> None:
    status, text = told(capsys, "--help")
    assert status == 0
    flags = """--realtime --lockstep --episodes --workers --ray --json --plot --seed --policy
        --conditions --vision-delay --checkpoint --engine --head-steps --dual-rate --max-time"""
    assert [flag for flag in flags.split() if flag not in text] == []


def test_a_cluster_that_nobody_answers_for_is_refused_at_once() -> None:
    pytest.importorskip("ray", reason="needs the extra cluster")
    with socket.socket() as probe:  # bound, but nobody listens
        probe.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{probe.getsockname()[1]}"
        with pytest.raises(UserError, match="nobody answers there"):
            evaluate(EvaluateConfig(policy=CIRCLE, ray=address))


def test_without_ray_there_is_one_clear_message(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(UserError, match=r"mavbridge\[cluster\]"):
        evaluate(EvaluateConfig(policy=CIRCLE, workers=2))
