"""The command line, run inside the test or in a process of its own."""

import io
import subprocess
import sys
from contextlib import redirect_stderr, redirect_stdout

import pytest

from mavbridge.__main__ import main
from mavbridge.cli import cli
from mavbridge.config.flight import FlyConfig
from mavbridge.core.processes import child_environment


def status_of(*arguments: object) -> int:
    """Exit status of ``mavbridge`` with these arguments."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cli, "config", cli.config)  # --config sets it, for all who parse later
        with pytest.raises(SystemExit) as stopped:
            main([str(argument) for argument in arguments])
    assert isinstance(stopped.value.code, int)
    return stopped.value.code


def told_by(*arguments: object) -> tuple[int, str]:
    """Exit status, and all that was printed, on one line."""
    printed = io.StringIO()
    with redirect_stdout(printed), redirect_stderr(printed):
        status = status_of(*arguments)
    text = " ".join(printed.getvalue().replace("│", " ").split())
    assert "Traceback" not in text
    return status, text


def asked_flight(*words: object) -> FlyConfig:
    """The configuration of the flight that these words ask for, which is not flown."""
    asked: list[FlyConfig] = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("mavbridge.flight.app.fly", lambda config: asked.append(config) or 0)
        assert status_of(*words) == 0
    return asked[0]


def printed_by(*words: str) -> tuple[int, str]:
    """Exit status and output of ``mavbridge`` in a process of its own, 200 columns wide."""
    done = subprocess.run(
        [sys.executable, "-m", "mavbridge", *words],
        env=child_environment() | {"COLUMNS": "200"},
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        timeout=180.0,
    )
    return done.returncode, done.stdout
