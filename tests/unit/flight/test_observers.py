"""The end of a flight as its observers tell it."""

import io
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from helpers.factories import make_tick
from helpers.fakes import FakeClock
from mavbridge.config.flight import FlyConfig
from mavbridge.flight.observers import FlightObservers
from mavbridge.flight.plan import plan_flight
from mavbridge.guard.wire import GuardStatus
from policy.contract import Contract
from policy.engines.runner import ExecutionSettings, make_numpy_runner


class Hovering:
    contract = Contract(arrays="numpy", camera_rates_hz=(10.0,))

    def predict(
        self, image: np.ndarray, state: np.ndarray, history: np.ndarray, steps: int
    ) -> np.ndarray:
        return np.zeros((1, self.contract.horizon, 4), np.float32)


def observers(report: Path, said: io.StringIO) -> FlightObservers:
    runner = make_numpy_runner(Hovering(), ExecutionSettings(name="hovering", dual_rate=False))
    console = Console(file=said, width=200)
    plan = plan_flight(FlyConfig(report=report), runner.contract, is_dual=False)
    return FlightObservers(plan, runner, clock=FakeClock(), console=console)


def test_a_report_that_cannot_be_written_is_said(tmp_path: Path) -> None:
    said = io.StringIO()
    observers(tmp_path, said).finish(None, "ardupilot", None)
    assert f"--report {tmp_path}: Is a directory" in said.getvalue()
    assert " of 10 Hz" in said.getvalue(), "the rate of the contract's camera"


def test_a_flight_that_flew_is_reported_although_the_vehicle_is_gone(tmp_path: Path) -> None:
    watching = observers(report := tmp_path / "report.json", io.StringIO())
    watching.referee.emit(make_tick(0, phase="flying"))
    gone = GuardStatus("ArduPilot", None, False, None, (), None)
    watching.finish(None, None, watching.referee.outcome("fault", gone))
    assert report.exists()


def test_the_terminal_is_given_back_even_if_the_report_fails(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(_report: object) -> None:
        raise RuntimeError("a bug")

    closed: list[float] = []
    watching = observers(tmp_path / "report.json", io.StringIO())
    monkeypatch.setattr(watching.screen, "show_report", fail)
    monkeypatch.setattr(watching.screen, "close", closed.append)
    with pytest.raises(RuntimeError, match="a bug"):
        watching.finish(None, "ardupilot", None)
    assert closed
