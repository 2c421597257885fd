"""Rows of cameras: rates, sizes, ages and stamps, by what the frames say."""

from pathlib import Path

import numpy as np
import pytest

from helpers.fakes import FakeClock
from mavbridge.commands.check import camera as check_camera
from mavbridge.commands.check.camera import CameraNeeds, CameraView, camera_rows, judge
from mavbridge.commands.check.rows import CheckRow
from mavbridge.config.flight import CameraConfig
from mavbridge.core.clock import NS_PER_MS, MonotonicClock
from mavbridge.core.records import Frame

FRAME_NS = 33_333_333
SCENE = np.random.default_rng(0).integers(0, 255, (224, 224, 3)).astype(np.uint8)


def needs(source: str = "shm:fpv", **changed: object) -> CameraNeeds:
    values: dict[str, object] = {
        "name": "",
        "rate_hz": 30.0,
        "size_px": (224, 224),
        "max_age_s": 0.3,
    }
    return CameraNeeds(source=source, **(values | changed))  # type: ignore[arg-type]


def seen(
    *, age_ms: float = 15.0, period_ns: int = FRAME_NS, image: np.ndarray = SCENE, **changed: object
) -> CameraView:
    ages_ns = [round(age_ms * NS_PER_MS)] * 60
    stamps_ns = [k * period_ns for k in range(60)]
    values: dict[str, object] = {"captured_ns": stamps_ns, "ages_ns": ages_ns, "is_stamped": True}
    return CameraView(image=image, **(values | changed))  # type: ignore[arg-type]


def rows(need: CameraNeeds, what: CameraView, latency_ms: float = 0.0) -> dict[str, CheckRow]:
    """By the last words of their names."""
    told = judge(need, what, latency_ms=latency_ms)
    return {row.name.removeprefix(need.source).strip(): row for row in told}


def test_a_camera_that_does_all_that_is_needed_is_a_go() -> None:
    told = rows(needs(), seen())
    assert {row.verdict for row in told.values()} == {"go"}
    assert (told["rate"].found, told["image"].found) == ("30.0 Hz", "224x224")


@pytest.mark.parametrize(
    ("need", "what", "latency_ms", "row", "verdict"),
    [
        (needs(), seen(period_ns=2 * FRAME_NS), 0.0, "rate", "warn"),
        (needs(), seen(period_ns=2 * FRAME_NS, dropped=59), 0.0, "rate", "go"),  # passed over
        (needs(), seen(silent_ns=600 * NS_PER_MS), 0.0, "", "no-go"),  # it has stopped
        (needs(rate_hz=1.0), seen(silent_ns=600 * NS_PER_MS), 0.0, "rate", "go"),
        (needs("pipe:cat"), seen(is_stamped=False), 0.0, "age when read", "warn"),  # on arrival
        (needs("pipe:cat"), seen(is_stamped=False), 120.0, "age when read", "go"),
        (needs(), seen(age_ms=0.1), 0.0, "age when read", "go"),  # its writer stamps the exposure
        (needs("0"), seen(age_ms=25.0), 0.0, "age when read", "go"),  # the driver's stamps
        (needs(), seen(age_ms=400.0), 0.0, "age when read", "no-go"),
        (needs(), seen(image=np.zeros_like(SCENE)), 0.0, "image", "no-go"),
        (needs(is_flown_by=False), seen(image=np.zeros_like(SCENE)), 0.0, "image", "warn"),
        (needs(), seen(image=SCENE[:160, :160]), 0.0, "image", "warn"),  # it is enlarged
        (needs(size_px=(160, 224)), seen(image=SCENE[:160]), 0.0, "image", "go"),
        (needs(size_px=(160, 224)), seen(image=SCENE[:, :160]), 0.0, "image", "warn"),
    ],
)
def test_what_a_policy_cannot_fly_by_is_told(
    need: CameraNeeds, what: CameraView, latency_ms: float, row: str, verdict: str
) -> None:
    assert rows(need, what, latency_ms)[row].verdict == verdict


def test_frames_that_nobody_read_before_the_first_one_do_not_count(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    clock = FakeClock()

    class Camera:
        dropped_frames = 0

        def read(self, _timeout_ns: int) -> Frame:
            clock.advance_ns(2 * FRAME_NS)
            self.dropped_frames = 30  # while another camera was opened
            return Frame(frame_id=1, captured_ns=clock.now_ns(), rgb=SCENE)

        def close(self) -> None:
            pass

    monkeypatch.setattr(check_camera, "open_camera", lambda *_, **__: Camera())
    assert camera_rows([needs()], CameraConfig(), clock)[0].found == "15.0 Hz"


def test_a_camera_that_is_not_there_is_one_row(tmp_path: Path) -> None:
    told = camera_rows(
        [needs("shm:nobody-writes-this"), needs(str(tmp_path / "none.mp4"))],
        CameraConfig(camera_timeout=0.1),
        MonotonicClock(),
    )
    assert [row.verdict for row in told] == ["no-go", "no-go"]
    assert "there is none" in told[0].advice
    assert "no such file" in told[1].advice
