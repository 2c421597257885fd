"""Jobs in this process; tests/system/test_episode_workers.py has them in others."""

import socket
import sys

import pytest

from helpers.worker_jobs import Job, run
from mavbridge.commands.episode_workers import fly_jobs
from mavbridge.config.episodes import WorkersConfig
from mavbridge.core.errors import PeerError, UserError
from mavbridge.simulation.referee import EpisodeInterruptedError

JOBS = [Job(number=number) for number in (10, 20, 30)]


def test_one_worker_flies_in_order_until_it_is_told_to_stop_or_interrupted() -> None:
    assert list(fly_jobs(run, JOBS, WorkersConfig(), lambda: False)) == [(0, 10), (1, 20), (2, 30)]
    answers = iter([False, False, True])
    assert list(fly_jobs(run, JOBS, WorkersConfig(), lambda: next(answers))) == [(0, 10), (1, 20)]
    jobs = [JOBS[0], Job(number=1, error=EpisodeInterruptedError("stopped")), JOBS[1]]
    assert list(fly_jobs(run, jobs, WorkersConfig(), lambda: False)) == [(0, 10)]


def test_an_error_ends_the_run_with_the_results_before_it() -> None:
    jobs = [JOBS[0], Job(number=1, error=PeerError("the vehicle is gone"))]
    flown = fly_jobs(run, jobs, WorkersConfig(), lambda: False)
    assert next(flown) == (0, 10)
    with pytest.raises(PeerError, match="the vehicle is gone"):
        next(flown)


def test_a_bad_cluster_is_refused_before_ray_is_loaded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)

    def refusal(address: str | bool) -> str:
        with pytest.raises(UserError) as refused:
            list(fly_jobs(run, JOBS, WorkersConfig(ray=address), lambda: False))
        return str(refused.value)

    assert "name the head of a cluster as HOST:PORT" in refusal("cluster")
    with socket.socket() as probe:  # bound, but it does not listen
        probe.bind(("127.0.0.1", 0))
        assert "nothing answers there" in refusal(f"127.0.0.1:{probe.getsockname()[1]}")
    assert "pip install ray" in refusal(True)
