import pytest

from helpers.recordings import InProcessWriter
from mavbridge.commands import imagine


@pytest.fixture
def in_process_writer(monkeypatch: pytest.MonkeyPatch) -> None:
    """No writer process; the decode thread is there."""
    monkeypatch.setattr(imagine, "VideoWriter", InProcessWriter)
