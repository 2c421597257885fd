"""Faulty policies as a user might write them; the bridge loads them."""

import ctypes
import os
import resource
import sys
import threading
import time
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from policy.contract import Contract

Array = NDArray[np.float32]
HANG_S = 20
"""Longer than any test waits."""


class Climbing:
    """Climbs; the smallest possible dual-rate policy."""

    contract = Contract(arrays="numpy", feature_dim=1)

    def __init__(self) -> None:
        self._calls = 0

    def encode_visual(self, image: Array) -> Array:
        return np.zeros((1, 1), dtype=np.float32)

    def predict_fast(self, feature: Array, state: Array, history: Array, steps: int) -> Array:
        self._calls += 1
        chunk = np.zeros((1, self.contract.horizon, 4), dtype=np.float32)
        chunk[..., 0] = 0.5
        return chunk

    def predict(self, image: Array, state: Array, history: Array, steps: int) -> Array:
        return self.predict_fast(image, state, history, steps)


class Leaning(Climbing):
    """Takes off, then leans, turns and climbs; ``misbehave`` is called once it leans steadily."""

    contract = Contract(arrays="numpy", feature_dim=1, image_height=32, image_width=32)
    lean_calls, fault_calls = 120, 200
    """Calls in flight after which it leans, and after which its fault begins. On the ground the
    count stays below the first."""
    least_climb_mps = 0.3
    """Climb rate that shows that it has left the ground; PX4 takes 2.4 s to get there."""

    def __init__(self) -> None:
        super().__init__()
        self._flown: int | None = None

    def reset(self) -> None:
        """Called when a flight begins, and at the end of loading."""
        self._flown = -1 if self._flown is None else 0

    def predict_fast(self, feature: Array, state: Array, history: Array, steps: int) -> Array:
        chunk = super().predict_fast(feature, state, history, steps)
        if self._flown is None or self._flown < 0:
            return chunk
        self._flown += 1
        if self._flown == self.lean_calls and -state[..., 2].min() < self.least_climb_mps:
            self._flown -= 1
        if self._flown > self.lean_calls:
            chunk[:] = (0.3, 0.25, 0.0, 0.5)
        if self.is_faulty:
            if self.has_begun and type(self).misbehave != Leaning.misbehave:
                mark_fault()
            self.misbehave(chunk)
        return chunk

    def misbehave(self, chunk: Array) -> None:
        """No-op: this policy has no fault."""

    @property
    def is_faulty(self) -> bool:
        return self._flown is not None and self._flown > self.fault_calls

    @property
    def has_begun(self) -> bool:
        return self._flown == self.fault_calls + 1


class Deliberate(Leaning):
    """Makes two chunks per second, each in 0.3 s, and plays each for one second."""

    contract = Contract(
        arrays="numpy", feature_dim=1, image_height=32, image_width=32, horizon=40, play_s=1.0
    )
    lean_calls = 8

    def predict_fast(self, feature: Array, state: Array, history: Array, steps: int) -> Array:
        time.sleep(0.3)  # noqa: TID251 - the slow policy itself
        return super().predict_fast(feature, state, history, steps)


def compute() -> None:
    deadline_ns = time.monotonic_ns() + HANG_S * 10**9
    while time.monotonic_ns() < deadline_ns:
        pass


def mark_fault() -> None:
    """Write the time of the fault for the catalogue."""
    path = Path(os.environ["FAULT_MARK"])
    draft = path.with_suffix(".draft")
    draft.write_text(str(time.monotonic_ns()))
    draft.rename(path)


class Heavy(Leaning):
    """Holds 500 MB, which the kernel frees before it closes the sockets of a dead process."""

    def __init__(self) -> None:
        super().__init__()
        self._ballast = np.ones(500 * 2**20 // 8)


class Segfaulting(Leaning):
    def misbehave(self, chunk: Array) -> None:
        ctypes.string_at(0)


class HangingNatively(Heavy):
    """Sleeps in C with the interpreter's lock held, so that no other Python thread runs."""

    def misbehave(self, chunk: Array) -> None:
        if self.has_begun:
            libc = ctypes.PyDLL(None)
            for _ in range(HANG_S * 10):
                libc.usleep(100_000)


class HangingInPython(Leaning):
    def misbehave(self, chunk: Array) -> None:
        if self.has_begun:
            compute()


class HangingEncoder(Leaning):
    """Policy whose encoder hangs once the flight leans."""

    def encode_visual(self, image: Array) -> Array:
        if self.is_faulty:
            mark_fault()
            time.sleep(HANG_S)  # noqa: TID251 - the hang itself
        return super().encode_visual(image)


class TwoEyed(Leaning):
    """Takes two images of each of two cameras; leans only if they are the expected ones."""

    contract = Contract(
        arrays="numpy",
        feature_dim=2,
        image_height=32,
        image_width=32,
        cameras=("front", "down"),
        camera_rates_hz=(30.0, 15.0),
        observation_steps=2,
        observation_dt_s=0.1,
    )

    def encode_visual(self, image: Array, camera: int = 0) -> Array:
        return np.full((1, 2), camera, np.float32)

    def predict_fast(self, feature: Array, state: Array, history: Array, steps: int) -> Array:
        if feature.tolist() != [[[0, 0, 1, 1]] * 2] or state.shape != (1, 2, 13):
            raise ValueError(f"features {feature.tolist()}, states {state.shape}")
        return super().predict_fast(feature, state, history, steps)


class HangingBelow(TwoEyed):
    """Policy whose encoder of the second camera hangs once the flight leans."""

    def encode_visual(self, image: Array, camera: int = 0) -> Array:
        if camera == 1 and self.is_faulty:
            mark_fault()
            time.sleep(HANG_S)  # noqa: TID251 - the hang itself
        return super().encode_visual(image, camera)


class AlwaysNan(Leaning):
    def misbehave(self, chunk: Array) -> None:
        chunk[:] = np.nan


class NanEveryOther(Leaning):
    def misbehave(self, chunk: Array) -> None:
        if self._flown is not None and self._flown % 2:
            chunk[:] = np.nan


class Slow(Leaning):
    """Policy whose calls take longer than its own contract allows."""

    def predict_fast(self, feature: Array, state: Array, history: Array, steps: int) -> Array:
        time.sleep(0.9)  # noqa: TID251 - the slow policy itself
        return super().predict_fast(feature, state, history, steps)


class SlowInFlight(Leaning):
    """Policy whose calls take 0.9 s once its fault has begun."""

    def misbehave(self, chunk: Array) -> None:
        time.sleep(0.9)  # noqa: TID251 - the slow policy itself


class Infinite(Leaning):
    def misbehave(self, chunk: Array) -> None:
        chunk[..., 3] = np.inf


class Misshapen(Leaning):
    """Returns chunks without their first dimension."""

    def predict_fast(self, feature: Array, state: Array, history: Array, steps: int) -> Array:
        chunk = super().predict_fast(feature, state, history, steps)
        if self.has_begun:
            mark_fault()
        return chunk[0] if self.is_faulty else chunk


class Erratic(Leaning):
    """Changes the sticks every tenth of a second, each to one of its limits; climbs on average."""

    def __init__(self) -> None:
        super().__init__()
        self._random = np.random.default_rng(0)
        self._sticks = np.zeros(4, np.float32)

    def misbehave(self, chunk: Array) -> None:
        if self._calls % 10 == 0 or self.has_begun:
            self._sticks = self._random.choice([-1, 1], 4).astype(np.float32)
            self._sticks[0] = self._random.choice([-1, 1, 1])
        chunk[:] = self._sticks


class Exploding(Leaning):
    def misbehave(self, chunk: Array) -> None:
        raise RuntimeError("the user's policy is broken")


class Leaving(Leaning):
    """Tries to end its process."""

    def misbehave(self, chunk: Array) -> None:
        sys.exit()


class Greedy(Leaning):
    """Allocates memory until none is left; its limit is the current size plus 64 MB."""

    def __init__(self) -> None:
        super().__init__()
        self._hoard: list[Array] = []

    def misbehave(self, chunk: Array) -> None:
        pages = int(Path("/proc/self/statm").read_text().split()[0])
        limit = pages * resource.getpagesize() + (64 << 20)
        resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
        for kilobytes in (1024, 64, 4):
            try:
                while True:
                    self._hoard.append(np.ones((kilobytes, 256), dtype=np.float32))
            except MemoryError:
                continue
        raise MemoryError("the policy has none left")


class Chatty(Leaning):
    """Prints a page at each call."""

    def misbehave(self, chunk: Array) -> None:
        for row in range(25):
            print(f"{row:3d} {'the policy thinks aloud ' * 5}")


class Hogging(Leaning):
    """A thread of the policy computes for ever, and releases the interpreter only on request."""

    def misbehave(self, chunk: Array) -> None:
        if self.has_begun:
            threading.Thread(target=self._compute, name="users-thread", daemon=True).start()

    def _compute(self) -> None:
        compute()


class HoggingNatively(Hogging):
    """A thread of the policy holds the interpreter for 0.4 s at a time."""

    def _compute(self) -> None:
        libc = ctypes.PyDLL(None)
        for _ in range(HANG_S * 2):
            libc.usleep(400_000)
            time.sleep(0.1)  # noqa: TID251 - let the other threads run
