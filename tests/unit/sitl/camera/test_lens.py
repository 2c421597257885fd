import numpy as np

from sitl.camera.lens import LensDirt
from sitl.vehicle.conditions import Conditions


def test_drops_blur_the_view_where_they_are_and_nowhere_else():
    """Of noise, since blur takes its contrast."""
    view = np.random.default_rng(1).integers(0, 256, (90, 120, 3), dtype=np.uint8)
    lens = LensDirt(Conditions(lens_drops=8.0, seed=3), 120, 90)
    changed = np.abs(lens.cover(view).astype(int) - view).max(axis=2) > 1
    assert 0.02 < changed.mean() < 0.5
    other = view[::-1].copy()
    again = np.abs(lens.cover(other).astype(int) - other).max(axis=2) > 1
    assert (again == changed).mean() > 0.97
