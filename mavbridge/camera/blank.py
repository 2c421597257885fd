"""No camera: black frames at a camera's rate, for policies that look at none."""

import numpy as np

from mavbridge.camera.deadlines import wait_until_due
from mavbridge.core.clock import NS_PER_S, Clock
from mavbridge.core.records import CameraImage, Frame

FRAME_NS = NS_PER_S // 30


class BlankCamera:
    """Delivers a black frame at each moment of a grid; one that nobody took in time is dropped."""

    def __init__(self, *, image_size: int, clock: Clock, is_depth: bool = False) -> None:
        self._clock = clock
        shape = (image_size, image_size, *(() if is_depth else (3,)))
        self._rgb: CameraImage = np.zeros(shape, np.uint16 if is_depth else np.uint8)
        self._rgb.flags.writeable = False
        self._due_ns = clock.now_ns()
        self._frame_id = 0
        self.dropped_frames = 0

    def read(self, timeout_ns: int) -> Frame | None:
        """See `mavbridge.core.ports.Camera`."""
        if not wait_until_due(self._clock, self._due_ns, timeout_ns):
            return None
        late = (self._clock.now_ns() - self._due_ns) // FRAME_NS
        captured_ns = self._due_ns + late * FRAME_NS
        self.dropped_frames += late
        self._frame_id += 1 + late
        self._due_ns = captured_ns + FRAME_NS
        return Frame(frame_id=self._frame_id, captured_ns=captured_ns, rgb=self._rgb)

    def close(self) -> None:
        """There is nothing to free."""
