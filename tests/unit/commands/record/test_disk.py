from pathlib import Path

import pytest

from mavbridge.commands.record.episodes import FIRST_BYTES_PS, DiskWatch
from mavbridge.core.clock import NS_PER_S

RESERVE = 1e9


def watch(tmp_path: Path, free: list[float]) -> DiskWatch:
    return DiskWatch(tmp_path, reserve_bytes=RESERVE, free=lambda _: int(free[0]))


def test_minutes_are_counted_down_at_the_measured_rate(tmp_path: Path) -> None:
    free = [RESERVE + 600 * FIRST_BYTES_PS]
    disk = watch(tmp_path, free)
    assert disk.left_s() == pytest.approx(600)
    (tmp_path / "camera.mp4").write_bytes(bytes(50_000))
    (tmp_path / "ticks.arrows").write_bytes(bytes(10_000))
    disk.measure(tmp_path, NS_PER_S)
    assert disk.left_s() == pytest.approx(600), "a second is too short to measure by"
    disk.measure(tmp_path, 10 * NS_PER_S)
    assert disk.left_s() == pytest.approx(600 * FIRST_BYTES_PS / 6000)


def test_nothing_begins_in_the_last_minute_and_all_ends_at_the_reserve(tmp_path: Path) -> None:
    free = [RESERVE + 61 * FIRST_BYTES_PS]
    disk = watch(tmp_path, free)
    assert disk.may_begin
    free[0] = RESERVE + 59 * FIRST_BYTES_PS
    assert not disk.may_begin
    assert not disk.is_full
    free[0] = RESERVE - 1
    assert disk.is_full
    assert disk.left_s() == 0.0
