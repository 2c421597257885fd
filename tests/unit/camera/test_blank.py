from helpers.fakes import FakeClock
from mavbridge.camera.blank import FRAME_NS
from mavbridge.camera.open import check_camera, open_camera


def test_black_frames_come_on_a_grid_and_late_ones_are_dropped() -> None:
    clock = FakeClock()
    check_camera("none")
    camera = open_camera("none", image_size=32, clock=clock)
    first = camera.read(FRAME_NS)
    assert first is not None
    assert first.rgb.shape == (32, 32, 3)
    assert not first.rgb.any()
    assert camera.read(FRAME_NS // 2) is None
    second = camera.read(FRAME_NS)
    assert second is not None
    assert second.captured_ns - first.captured_ns == FRAME_NS
    clock.advance_ns(3 * FRAME_NS + FRAME_NS // 4)
    third = camera.read(FRAME_NS)
    assert third is not None
    assert third.captured_ns - second.captured_ns == 3 * FRAME_NS
    assert (third.frame_id, camera.dropped_frames) == (5, 2)
    camera.close()
