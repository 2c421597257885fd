"""The end of a real flight: what is stopped, read and closed in which order."""

import threading
from contextlib import ExitStack
from types import SimpleNamespace
from typing import Any

import pytest

from mavbridge.flight import app
from mavbridge.guard.values import Phase


class Stop:
    """Ctrl-C, and once more while the guard lands the vehicle."""

    def __init__(self) -> None:
        self._count = 0

    @property
    def requests(self) -> int:
        self._count += 1
        return self._count

    def is_set(self) -> bool:
        return True

    def wait(self, timeout_s: float) -> bool:
        return True


def test_a_second_signal_leaves_nothing_unread_that_the_last_solves_used(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    done: list[str] = []

    def loop(name: str) -> Any:
        def run(stop: threading.Event) -> None:
            stop.wait(10)
            done.append(name)

        return SimpleNamespace(run=run, alive_ns=0, encoding_since_ns=None)

    guard = SimpleNamespace(
        summary=None,
        send=lambda message: True,
        listen=lambda stop, view: loop("listener").run(stop),
        read_rest=lambda view: done.append("rest"),
    )
    flight: Any = object.__new__(app._Flight)
    flight._bridge = SimpleNamespace(
        visions=[loop("vision")],
        policy=loop("policy"),
        view=SimpleNamespace(phase=Phase.LEAVING),
    )
    flight._observers = SimpleNamespace(
        screen=SimpleNamespace(start=lambda hint: None),
        referee=SimpleNamespace(ending=lambda now_ns: None),
    )
    flight._config = SimpleNamespace(
        link=SimpleNamespace(readonly=True),
        rates=SimpleNamespace(realtime=False),
        engage_channel=None,
    )
    flight._clock = app.MonotonicClock()
    flight._guard, flight._cameras, flight._has_hung = guard, ("front",), False
    flight._hang_ns = flight._encoder_hang_ns = 0
    monkeypatch.setattr(app, "settle_process", lambda: None)
    with ExitStack() as flight._stack:
        flight.run(Stop())
    assert done == ["listener", "policy", "vision", "rest"]
