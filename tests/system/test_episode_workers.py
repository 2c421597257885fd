"""Jobs in worker processes and on a local Ray cluster, and an evaluation in several processes."""

import os
import signal
import subprocess
import sys
import traceback
from pathlib import Path

import pytest

from helpers.worker_jobs import Job, run
from mavbridge.commands.episode_workers import fly_jobs
from mavbridge.commands.evaluate import evaluate
from mavbridge.config.episodes import EvaluateConfig, WorkersConfig
from mavbridge.config.policy import PolicyConfig
from mavbridge.core.errors import PeerError

TWO = WorkersConfig(workers=2)


def test_workers_have_the_results_of_one_process() -> None:
    three = [Job(number=10), Job(number=20, gets_ctrl_c=True), Job(number=30)]
    assert sorted(fly_jobs(run, three, TWO, lambda: False)) == [(0, 10), (1, 20), (2, 30)]


def test_a_worker_that_dies_ends_the_run_and_its_job_is_named(tmp_path: Path) -> None:
    dying = Job(number=20, deaths=1, folder=tmp_path)
    others = [Job(number=30, waits_for_stop=True) for _ in range(2)]
    with pytest.raises(PeerError, match="the worker that flew job 20 died"):
        list(fly_jobs(run, [others[0], dying, others[1]], TWO, lambda: False))


KILLED_PARENT = """
from helpers.worker_jobs import Job, run
from mavbridge.commands import episode_workers
from mavbridge.config.episodes import WorkersConfig
episode_workers.END_TIMEOUT_S = 0.1  # workers read this file, too
if __name__ == "__main__":
    jobs = [Job(number=1, waits_for_stop=True), Job(number=2, kills_parent=True)]
    list(episode_workers.fly_jobs(run, jobs, WorkersConfig(workers=2), lambda: False))
"""


def test_workers_end_with_a_parent_that_is_killed(tmp_path: Path) -> None:
    program = tmp_path / "parent.py"
    program.write_text(KILLED_PARENT)
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    with subprocess.Popen(
        [sys.executable, str(program)], stdout=subprocess.PIPE, env=environment
    ) as parent:
        parent.communicate(timeout=60)  # the end of the output, which every worker holds open
    assert parent.returncode == -signal.SIGKILL


@pytest.mark.parametrize("error", [PeerError("the vehicle is gone"), KeyError("a bug")])
def test_an_error_in_a_worker_is_raised_here(error: Exception) -> None:
    failing = [Job(number=1, error=error), Job(number=2, waits_for_stop=True)]
    with pytest.raises(type(error)) as raised:  # and the other worker is not waited for
        list(fly_jobs(run, failing, TWO, lambda: False))
    shown = "".join(traceback.format_exception(raised.value))
    assert str(error) in shown
    assert "worker_jobs.py" in shown


def test_a_stop_interrupts_the_jobs_under_way() -> None:
    flown: list[tuple[int, int]] = []
    endless = [Job(number=1), *(Job(number=2, waits_for_stop=True) for _ in range(3))]
    for result in fly_jobs(run, endless, TWO, lambda: bool(flown)):
        flown.append(result)
    assert flown == [(0, 1)]


@pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::DeprecationWarning")
def test_ray_has_the_same_results_though_a_worker_is_lost(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("ray", reason="needs the extra cluster")
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(sys.path))  # its workers import the helpers
    config = WorkersConfig(workers=2, ray="local")
    three = [Job(number=10), Job(number=20, deaths=1, folder=tmp_path), Job(number=30)]
    flown = list(fly_jobs(run, three, config, lambda: False))
    assert sorted(flown) == [(0, 10), (1, 20), (2, 30)]


CIRCLE = PolicyConfig(policy="scripted:circle", dual_rate=True)


def test_two_workers_write_what_one_writes(tmp_path: Path) -> None:
    for workers in (1, 2):
        config = EvaluateConfig(
            policy=CIRCLE,
            episodes=2,
            max_time=1.0,
            conditions="random",
            workers=WorkersConfig(workers=workers),
            json=tmp_path / f"{workers}.json",
        )
        assert evaluate(config) == 0
    assert (tmp_path / "1.json").read_bytes() == (tmp_path / "2.json").read_bytes()
