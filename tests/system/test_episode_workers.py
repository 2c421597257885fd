"""Jobs in worker processes and on a local Ray cluster."""

import os
import sys
import traceback
from pathlib import Path

import pytest

from helpers.worker_jobs import Job, run
from mavbridge.commands.episode_workers import MAX_RETRIES, fly_jobs
from mavbridge.config.workers import WorkersConfig
from mavbridge.core.errors import PeerError

pytestmark = pytest.mark.system

TWO = WorkersConfig(workers=2)


def jobs(folder: Path, *, deaths: int) -> list[Job]:
    return [
        Job(number=10),
        Job(number=20, deaths=deaths, folder=folder),
        Job(number=30, gets_ctrl_c=True),
    ]


def test_a_lost_worker_costs_a_retry_and_changes_no_result(tmp_path: Path) -> None:
    flown = list(fly_jobs(run, jobs(tmp_path, deaths=2), TWO, lambda: False))
    assert sorted(flown) == [(0, 10), (1, 20), (2, 30)]
    assert len(list(tmp_path.iterdir())) == 2


def test_a_job_that_loses_every_worker_is_named(tmp_path: Path) -> None:
    with pytest.raises(PeerError, match=f"job 20 lost {MAX_RETRIES + 1} workers"):
        list(fly_jobs(run, jobs(tmp_path, deaths=100), TWO, lambda: False))
    assert len(list(tmp_path.iterdir())) == MAX_RETRIES + 1


@pytest.mark.parametrize("error", [PeerError("the vehicle is gone"), KeyError("a bug")])
def test_an_error_in_a_worker_is_raised_here(error: Exception) -> None:
    failing = [Job(number=1, error=error), Job(number=2, waits_for_stop=True)]
    with pytest.raises(type(error)) as raised:  # and the other worker is not waited for
        list(fly_jobs(run, failing, TWO, lambda: False))
    shown = "".join(traceback.format_exception(raised.value))
    assert str(error) in shown
    assert ("worker_jobs.py" in shown) == isinstance(error, KeyError)


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
    flown = list(fly_jobs(run, jobs(tmp_path, deaths=1), config, lambda: False))
    assert sorted(flown) == [(0, 10), (1, 20), (2, 30)]
