import pytest

from mavbridge.rollout import streamed
from rollouts import InProcessWriter


@pytest.fixture
def in_process_writer(monkeypatch: pytest.MonkeyPatch) -> None:
    """No writer process; the decode thread is there."""
    monkeypatch.setattr(streamed, "VideoWriter", InProcessWriter)
