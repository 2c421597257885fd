"""Recorded flights whose sticks every change of flight and guard must reproduce."""

import shutil
from functools import cache
from pathlib import Path

from mavbridge.simulation.replay.guard import GuardStep, replay_guard
from mavbridge.simulation.replay.recording import ReplaySource, open_source

FLIGHTS = Path(__file__).parents[1] / "data" / "flights"
NAMES = ("toge_ardupilot", "numpy_px4", "scripted_velocity_ardupilot")


@cache
def golden(name: str) -> ReplaySource:
    return open_source(FLIGHTS / name)


@cache
def through_gate(name: str) -> tuple[GuardStep, ...]:
    return tuple(replay_guard(golden(name)))


def copied(name: str, folder: Path) -> Path:
    """Return a copy that a test can damage."""
    return Path(shutil.copytree(FLIGHTS / name, folder / name))
