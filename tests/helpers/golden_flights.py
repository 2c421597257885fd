"""Recorded flights whose sticks every change of the flight's and the gate's code must reproduce."""

import shutil
from functools import cache
from pathlib import Path

from mavbridge.simulation.replay.gate import GateStep, replay_gate
from mavbridge.simulation.replay.recording import ReplaySource, open_source

FLIGHTS = Path(__file__).parents[1] / "data" / "flights"
NAMES = ("toge_ardupilot", "numpy_px4", "scripted_velocity_ardupilot")


@cache
def golden(name: str) -> ReplaySource:
    """One of ``NAMES``."""
    return open_source(FLIGHTS / name)


@cache
def through_gate(name: str) -> tuple[GateStep, ...]:
    """Its recorded chunks through the gate."""
    return tuple(replay_gate(golden(name)))


def copied(name: str, folder: Path) -> Path:
    """A copy to spoil."""
    return Path(shutil.copytree(FLIGHTS / name, folder / name))
