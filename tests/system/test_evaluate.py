"""Evaluation in several processes, and without a reader of its output."""

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from mavbridge.commands.evaluate import evaluate
from mavbridge.config.episodes import EvaluateConfig, WorkersConfig
from mavbridge.config.policy import PolicyConfig

pytestmark = pytest.mark.system

CIRCLE = PolicyConfig(policy="scripted:circle", dual_rate=True)


def test_two_workers_write_what_one_writes(tmp_path: Path) -> None:
    for workers in (1, 2):
        config = EvaluateConfig(
            policy=CIRCLE,
            episodes=3,
            max_time=1.0,
            conditions="random",
            workers=WorkersConfig(workers=workers),
            json=tmp_path / f"{workers}.json",
        )
        assert evaluate(config) == 0
    assert (tmp_path / "1.json").read_bytes() == (tmp_path / "2.json").read_bytes()


@pytest.mark.parametrize("open_ends", [os.pipe, os.openpty])
def test_flights_are_written_although_the_reader_has_gone(
    tmp_path: Path, open_ends: Callable[[], tuple[int, int]]
) -> None:
    reader, writer = open_ends()
    os.close(reader)
    flags = "--policy scripted:circle --episodes 1 --max-time 1 --json flown.json"
    ended = subprocess.run(
        [sys.executable, "-m", "mavbridge", "evaluate", *flags.split()],
        cwd=tmp_path,
        stdout=writer,
        stderr=writer,
        timeout=120,
        check=False,
    )
    os.close(writer)
    assert (ended.returncode, (tmp_path / "flown.json").exists()) == (0, True)
