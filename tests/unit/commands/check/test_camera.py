"""Rows of cameras: rates, sizes, ages and stamps, by what the frames say."""

from pathlib import Path

import numpy as np
import pytest

from mavbridge.commands.check.camera import CameraNeeds, CameraView, camera_rows, judge
from mavbridge.commands.check.rows import CheckRow
from mavbridge.config.flight import CameraConfig
from mavbridge.core.clock import NS_PER_MS, MonotonicClock

FRAME_NS = 33_333_333


def needs(source: str = "shm:fpv", **changed: object) -> CameraNeeds:
    values: dict[str, object] = {"name": "", "rate_hz": 30.0, "side_px": 224, "max_age_s": 0.3}
    return CameraNeeds(source=source, **(values | changed))  # type: ignore[arg-type]


def seen(*, age_ms: float = 15.0, period_ns: int = FRAME_NS, size_px: int = 224) -> CameraView:
    return CameraView(
        captured_ns=[k * period_ns for k in range(60)],
        ages_ns=[round(age_ms * NS_PER_MS)] * 60,
        image=np.random.default_rng(0).integers(0, 255, (size_px, size_px, 3)).astype(np.uint8),
    )


def rows(need: CameraNeeds, what: CameraView, latency_ms: float = 0.0) -> dict[str, CheckRow]:
    """By the last words of their names."""
    return {
        row.name.removeprefix(need.source).strip(): row
        for row in judge(need, what, latency_ms=latency_ms)
    }


def test_a_camera_that_does_all_that_is_needed_is_a_go() -> None:
    told = rows(needs(), seen())
    assert {row.verdict for row in told.values()} == {"go"}
    assert told["rate"].found == "30.0 Hz"
    assert told["image"].found == "224x224"


def test_frames_that_were_passed_over_count_for_the_rate() -> None:
    half = seen(period_ns=2 * FRAME_NS)
    assert rows(needs(), half)["rate"].verdict == "warn"
    half.dropped = 59
    assert rows(needs(), half)["rate"].verdict == "go"


@pytest.mark.parametrize(
    ("source", "age_ms", "latency_ms", "verdict"),
    [
        ("rtsp://camera", 0.1, 0.0, "warn"),  # stamped as they arrive
        ("rtsp://camera", 120.0, 120.0, "go"),
        ("shm:fpv", 0.1, 0.0, "go"),  # its writer stamps the exposure
        ("0", 25.0, 0.0, "go"),  # the driver's stamps
        ("shm:fpv", 400.0, 0.0, "no-go"),
    ],
)
def test_the_age_of_an_image_must_be_known_and_small(
    source: str, age_ms: float, latency_ms: float, verdict: str
) -> None:
    age = rows(needs(source), seen(age_ms=age_ms), latency_ms)["age when read"]
    assert age.verdict == verdict


def test_a_black_image_is_a_no_go_only_for_a_policy_that_looks_at_it() -> None:
    black = seen()
    black.image = np.zeros((224, 224, 3), np.uint8)
    assert rows(needs(), black)["image"].verdict == "no-go"
    assert rows(needs(is_flown_by=False), black)["image"].verdict == "warn"
    assert rows(needs(), seen(size_px=160))["image"].verdict == "warn", "small: it is enlarged"


def test_a_camera_that_is_not_there_is_one_row(tmp_path: Path) -> None:
    told = camera_rows(
        [needs("shm:nobody-writes-this"), needs(str(tmp_path / "none.mp4"))],
        CameraConfig(camera_timeout=0.1),
        MonotonicClock(),
    )
    assert [row.verdict for row in told] == ["no-go", "no-go"]
    assert "there is none" in told[0].advice
    assert "no such file" in told[1].advice
