from pathlib import Path
from types import SimpleNamespace

import pytest

from mavbridge.commands.record import episodes
from mavbridge.commands.record.episodes import FIRST_BYTES_PS, DiskWatch
from mavbridge.core.clock import NS_PER_S

RESERVE = 1e9


@pytest.mark.parametrize(("seconds", "left_s"), [(600, 600), (61, 61), (59, 59), (-1, 0)])
def test_seconds_are_counted_down_to_the_reserve_at_the_measured_rate(
    seconds: float, left_s: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    free = SimpleNamespace(free=RESERVE + seconds * FIRST_BYTES_PS)
    monkeypatch.setattr(episodes, "disk_usage", lambda _: free)
    disk = DiskWatch(tmp_path, reserve_bytes=RESERVE)
    assert disk.left_s() == pytest.approx(left_s)
    assert (disk.missing() is None) == (left_s >= 60), "nothing begins in the last minute"
    (tmp_path / "camera.mp4").write_bytes(bytes(50_000))
    (tmp_path / "ticks.arrows").write_bytes(bytes(10_000))
    disk.measure(tmp_path, NS_PER_S)
    assert disk.left_s() == pytest.approx(left_s), "a second is too short to measure by"
    disk.measure(tmp_path, 10 * NS_PER_S)
    assert disk.left_s() == pytest.approx(left_s * FIRST_BYTES_PS / 6000)
