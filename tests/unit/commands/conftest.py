import pytest

from helpers.recordings import InProcessWriter
from mavbridge.commands import imagine
from mavbridge.recording import flight_writer


@pytest.fixture
def in_process_writer(monkeypatch: pytest.MonkeyPatch) -> None:
    """No writer process; threads are there."""
    for module in (flight_writer, imagine):
        monkeypatch.setattr(module, "VideoWriter", InProcessWriter)
