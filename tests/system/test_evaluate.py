"""Evaluation in real processes: workers of a local cluster, and flights on the wall clock."""

import os
import signal
from pathlib import Path

import pytest

from mavbridge.commands.evaluate.cluster import fly_on_ray
from mavbridge.commands.evaluate.jobs import Flown, Job, fly_job, make_jobs
from mavbridge.commands.evaluate.realtime import fly_realtime
from mavbridge.config.evaluate import EvaluateConfig
from mavbridge.config.policy import PolicyConfig

pytestmark = pytest.mark.system

CONFIG = EvaluateConfig(
    policy=PolicyConfig(policy="scripted:circle", dual_rate=True), episodes=3, max_time=1.0
)


@pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::DeprecationWarning")
def test_a_killed_worker_costs_a_retry_and_changes_no_result(tmp_path: Path) -> None:
    pytest.importorskip("ray", reason="needs the extra cluster")
    has_died = tmp_path / "died"

    def fly_and_die_once(job: Job) -> Flown:
        if job.index == 1 and not has_died.exists():
            has_died.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return fly_job(job)

    jobs = make_jobs(CONFIG)
    flown = fly_on_ray(
        jobs, workers=2, address=None, should_stop=lambda: False, fly=fly_and_die_once
    )
    by_index = sorted(flown, key=lambda one: one.index)
    assert has_died.exists()
    assert by_index == [fly_job(job) for job in jobs]


def test_an_episode_flies_in_real_time() -> None:
    (job,) = make_jobs(
        EvaluateConfig(
            policy=CONFIG.policy, episodes=1, max_time=2.0, realtime=True, conditions="random"
        )
    )
    (flown,) = fly_realtime([job], should_stop=lambda: False)
    assert flown.engine == "numpy"
    assert flown.result.outcome == "timed out"
    assert flown.result.flown_s >= 2.0
    assert flown.result.distance_m > 0.2
