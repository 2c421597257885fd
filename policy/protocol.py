"""The methods of a policy, and a policy that is ready to run on one engine."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np

from policy.contract import CameraImage, Contract, FloatArray


@runtime_checkable
class SingleRatePolicy(Protocol):
    """The minimum that flies: image, state and history in, a chunk out.

    Shapes, float32: image [B, *contract.image_shape] normalised by the contract, state
    [B, *contract.state_shape] in SI units, action_history [B, K, 4]; returns [B, horizon, 4]
    actions of ``contract.action``. Arrays are numpy or torch, as ``contract.arrays`` says. Any
    class with these members will do; nothing is inherited.

    Two more methods, without arguments, are optional. ``reset()`` is called once after loading, and
    whenever a flight begins; ``close()`` once at the end, also after an error. The main thread
    makes the policy, tries each method on a dummy sample, and closes it when the other threads have
    ended; if one hangs, while that one still runs. In between the vision threads call
    ``encode_visual``, never for two images at once; the policy thread calls the other methods and
    ``reset``, so what ``encode_visual`` keeps is not for ``reset`` to change without a lock. Where
    there is no chunk for now, ``predict`` or ``predict_fast`` raises
    ``policy.errors.NoChunkError``; any other exception ends the flight.
    """

    contract: Contract

    def predict(self, image: Any, state: Any, action_history: Any, num_diffusion_steps: int) -> Any:
        """Encode the image and sample one chunk."""


@runtime_checkable
class DualRatePolicy(SingleRatePolicy, Protocol):
    """A policy whose image path can run slower than its action path.

    With several cameras ``encode_visual(image, camera)`` gets the camera's place in
    ``contract.cameras`` as well, and is called for each at its own rate.
    """

    def encode_visual(self, image: Any) -> Any:
        """Image [B, 3, H, W], or of depth [B, 1, H, W] -> feature [B, F]."""

    def predict_fast(
        self, feature: Any, state: Any, action_history: Any, num_diffusion_steps: int
    ) -> Any:
        """Cached features [B, *contract.feature_shape], states and history -> chunk."""


class Encode(Protocol):
    """``PolicyRunner.encode``."""

    def __call__(self, image: CameraImage, camera: int = 0, /) -> FloatArray:
        """Image of one of ``contract.cameras`` -> its encoded image."""


@runtime_checkable
class StepwisePolicy(DualRatePolicy, Protocol):
    """A diffusion policy that can be asked for one call of its network at a time.

    An engine that compiles compiles ``denoise`` alone, once, and runs the solver around it: that
    is one copy of the weights, and seconds to convert in place of minutes.
    """

    schedule: Any
    """A ``nets.diffusion.NoiseSchedule``, or another with its ``ddim_steps`` and ``ddim_update``:
    the timesteps of a solve, and what an output means."""

    @property
    def initial_noise(self) -> Any:
        """[1, L, A]: what every solve of a flight starts from, in the network's own form."""

    def denoise(
        self, noisy: Any, timestep: Any, feature: Any, state: Any, action_history: Any
    ) -> Any:
        """One network call: noisy [B, L, A] at the timestep [B], float32 -> [B, L, A], what the
        schedule says that the network predicts."""

    def to_chunk(self, sample: Any) -> Any:
        """The end of a solve, [B, L, A] -> chunk [B, horizon, 4] of the contract."""


def keep_nothing() -> None:
    """Reset a policy that keeps nothing between chunks."""


@dataclass(frozen=True, kw_only=True)
class PolicyRunner:
    """A policy ready to run on one engine, numpy in and numpy out, as the loops call it.

    ``encode`` runs in the threads of the cameras, one image at a time, ``act`` and ``reset`` in the
    policy thread, ``close`` in the main thread. Without a fast path ``encode`` only preprocesses
    and ``act`` does the rest.
    """

    contract: Contract
    name: str
    engine: str
    dual_rate: bool
    encode: Encode
    """Image of any size of one camera -> float32 [1, feature_dim], or without a fast path the image
    [1, 3, image_height, image_width] (depth: 1 for 3); ``join`` makes of them what ``act`` takes.
    """
    act: Callable[[FloatArray, FloatArray, FloatArray], FloatArray]
    """(joined images [1, *contract.feature_shape], or without a fast path [1,
    *contract.image_shape]; state [1, *contract.state_shape]; history [1, K, 4]) -> chunk
    [1, horizon, 4]."""
    close: Callable[[], None] = keep_nothing
    """Ends what the policy has opened; called once, after the last call of the others."""
    reset: Callable[[], None] = keep_nothing
    """Forgets earlier flights; called when a flight begins."""

    def join(self, encoded: Sequence[Sequence[FloatArray]]) -> FloatArray:
        """``encode``'s value of each camera, at each observation from the oldest on -> for ``act``.

        The same array where there is only one.
        """
        rows = [row[0] if len(row) == 1 else self._side_by_side(row) for row in encoded]
        return rows[0] if len(rows) == 1 else np.stack(rows, axis=1)

    def _side_by_side(self, row: Sequence[FloatArray]) -> FloatArray:
        return np.concatenate(row, axis=1) if self.dual_rate else np.stack(row, axis=1)
