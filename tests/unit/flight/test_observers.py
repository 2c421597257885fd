"""The end of a flight as its observers tell it."""

import io
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from helpers.factories import make_tick
from helpers.fakes import FakeClock
from helpers.guard_facts import DEATH
from helpers.recordings import disk_of
from mavbridge.config.flight import FlyConfig
from mavbridge.flight.observers import FlightObservers
from mavbridge.flight.plan import plan_flight
from mavbridge.guard.wire import GuardStatus
from mavbridge.recording import recorder
from policy.contract import Contract
from policy.engines.runner import ExecutionSettings, make_numpy_runner


class Hovering:
    contract = Contract(arrays="numpy", camera_rates_hz=(10.0,))

    def predict(
        self, image: np.ndarray, state: np.ndarray, history: np.ndarray, steps: int
    ) -> np.ndarray:
        return np.zeros((1, self.contract.horizon, 4), np.float32)


def observers(report: Path, said: io.StringIO, *, record: Path | None = None) -> FlightObservers:
    runner = make_numpy_runner(Hovering(), ExecutionSettings(name="hovering", dual_rate=False))
    console = Console(file=said, width=200)
    plan = plan_flight(FlyConfig(report=report, record=record), runner.contract, is_dual=False)
    return FlightObservers(plan, runner, clock=FakeClock(), console=console)


def test_a_report_that_cannot_be_written_is_said(tmp_path: Path) -> None:
    said = io.StringIO()
    observers(tmp_path, said).finish(None, "ardupilot", None)
    assert f"--report {tmp_path}: Is a directory" in said.getvalue()
    assert " of 10 Hz" in said.getvalue(), "the rate of the contract's camera"
    (report := tmp_path / "report.json").write_text("of the flight before")
    with disk_of(100):
        observers(report, said).finish(None, "ardupilot", None)
    assert f"--report {report}: File too large" in said.getvalue()
    assert report.read_text() == "of the flight before"


def test_a_flight_that_flew_is_reported_although_the_vehicle_is_gone(tmp_path: Path) -> None:
    watching = observers(report := tmp_path / "report.json", io.StringIO())
    watching.referee.emit(make_tick(0, phase="flying"))
    gone = GuardStatus("ArduPilot", None, False, None, (), None)
    watching.finish(None, None, watching.referee.outcome(DEATH, gone, None))
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


def test_the_stamps_of_a_recording_have_the_wall_time_of_its_log(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The guard starts before the weights load; wall time may step until the recorder does."""
    begun: dict[str, Any] = {}
    begin = lambda _folder, meta, **rest: begun.update(rest, meta=meta)  # noqa: E731
    monkeypatch.setattr(recorder, "Recorder", begin)
    guard: Any = SimpleNamespace(tlog_pipe=object(), wall_offset_ns=1_700_000_000 * 10**9)
    watching = observers(tmp_path / "report.json", io.StringIO(), record=tmp_path / "flight")
    watching.open_recorder(guard, lambda: "ArduPilot")
    assert begun["settings"].wall_offset_ns == guard.wall_offset_ns
    assert begun["meta"].started_at.startswith("2023-11-14T22:")
