"""Protocols of a policy, and the runner of a policy on one engine."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any, Protocol, runtime_checkable

import numpy as np

from policy.contract import CameraImage, Contract, FloatArray


@runtime_checkable
class SingleRatePolicy(Protocol):
    """Minimal policy: image, state and history in, a chunk out.

    Shapes, float32: image [B, *contract.image_shape] normalised by the contract, state [B,
    *contract.state_shape] in SI units, action_history [B, *contract.history_shape]; returns [B,
    horizon, 4] actions of ``contract.action``. Arrays are numpy or torch, by ``contract.arrays``.
    Any class with these members fits; no base class is needed.

    Two more methods, without arguments, are optional. ``reset()`` is called once after loading and
    at the start of each flight; ``close()`` once at the end, also after an error.

    The main thread creates the policy, tries each method on a dummy sample, and closes the policy
    after the other threads have ended; a hanging thread may still be running then. During a flight,
    the vision threads call ``encode_visual``, never for two images at once; the policy thread calls
    the other methods and ``reset``, so ``reset`` must not change state of ``encode_visual`` without
    a lock.

    Without a chunk for the current state, ``predict`` or ``predict_fast`` raises
    ``policy.errors.NoChunkError``, and so does ``encode_visual`` to skip an image; any other
    exception ends the flight.
    """

    contract: Contract

    def predict(self, image: Any, state: Any, action_history: Any, num_diffusion_steps: int) -> Any:
        """Encode the image and sample one chunk."""


@runtime_checkable
class DualRatePolicy(SingleRatePolicy, Protocol):
    """Policy whose image path can run slower than its action path.

    With several cameras, ``encode_visual(image, camera)`` also gets the camera's index in
    ``contract.cameras``; it is called for each camera at that camera's rate.
    """

    def encode_visual(self, image: Any) -> Any:
        """Encode an image [B, 3, H, W], or depth [B, 1, H, W] -> feature [B, F]."""

    def predict_fast(
        self, feature: Any, state: Any, action_history: Any, num_diffusion_steps: int
    ) -> Any:
        """Sample a chunk from cached features [B, *contract.feature_shape], states and history."""


def predict_by_pair(
    self: DualRatePolicy, image: Any, state: Any, action_history: Any, num_diffusion_steps: int
) -> Any:
    """``predict`` of a policy with a fast pair: encode every image, then sample one chunk."""
    contract, shape = self.contract, image.shape
    steps, cameras = contract.observation_steps, len(contract.cameras)
    encode: Callable[..., Any] = self.encode_visual
    if cameras == 1:
        images = image.reshape(len(image), steps, *shape[-3:])
        features = [encode(images[:, step]) for step in range(steps)]
    else:
        images = image.reshape(len(image), steps, cameras, *shape[-3:])
        pairs = product(range(steps), range(cameras))
        features = [encode(images[:, step, camera], camera) for step, camera in pairs]
    feature = features[0]
    if len(features) > 1:
        library: Any = np
        if not isinstance(feature, np.ndarray):
            import torch as library  # not for scripted policies
        feature = library.stack(features, 1).reshape(len(image), *contract.feature_shape)
    return self.predict_fast(feature, state, action_history, num_diffusion_steps)


class Encode(Protocol):
    """Type of ``PolicyRunner.encode``."""

    def __call__(self, image: CameraImage, camera: int = 0, /) -> FloatArray:
        """Encode an image of one of ``contract.cameras``."""


@runtime_checkable
class StepwisePolicy(DualRatePolicy, Protocol):
    """Diffusion policy that exposes single calls of its network.

    A compiling engine compiles only ``denoise``, once, and runs the solver around it: one copy of
    the weights, and seconds of conversion instead of minutes.
    """

    schedule: Any
    """``nets.diffusion.NoiseSchedule``, or another class with its ``ddim_steps`` and
    ``ddim_update``: the timesteps of a solve, and the meaning of the network's output."""

    @property
    def initial_noise(self) -> Any:
        """[1, L, A]: the initial noise of every solve in a flight, in the network's own layout."""

    def denoise(
        self, noisy: Any, timestep: Any, feature: Any, state: Any, action_history: Any
    ) -> Any:
        """Call the network once: noisy [B, L, A] at timesteps [B] in float32 -> [B, L, A], the
        quantity that the schedule defines."""

    def to_chunk(self, sample: Any) -> Any:
        """Convert the end of a solve [B, L, A] to a chunk [B, horizon, 4] of the contract."""


def predict_by_steps(
    self: StepwisePolicy, feature: Any, state: Any, action_history: Any, num_diffusion_steps: int
) -> Any:
    """``predict_fast`` of a diffusion policy of torch: run a whole solve."""
    sample = self.initial_noise.expand(len(feature), -1, -1)
    for step in self.schedule.ddim_steps(num_diffusion_steps):
        timestep = sample.new_full((1,), float(step.timestep))
        output = self.denoise(sample, timestep, feature, state, action_history)
        sample = self.schedule.ddim_update(step, sample, output)
    return self.to_chunk(sample)


def no_op() -> None:
    """Do nothing: the default of a runner's ``close`` and ``reset``."""


@dataclass(frozen=True, kw_only=True)
class PolicyRunner:
    """Policy on one engine, numpy in and numpy out, as the loops call it.

    ``encode`` runs in the camera threads, one image at a time, ``act`` and ``reset`` in the policy
    thread, ``close`` in the main thread. Without a fast path, ``encode`` only preprocesses and
    ``act`` does the rest.
    """

    contract: Contract
    name: str
    engine: str
    dual_rate: bool
    encode: Encode
    """Image of one camera, of any size -> float32 [1, feature_dim]; without a fast path, the image
    [1, 3, image_height, image_width] (depth: 1 channel). ``join`` combines these to the argument of
    ``act``."""
    act: Callable[[FloatArray, FloatArray, FloatArray], FloatArray]
    """(joined images [1, *contract.feature_shape], or without a fast path [1,
    *contract.image_shape]; state [1, *contract.state_shape]; history
    [1, *contract.history_shape]) -> chunk [1, horizon, 4]."""
    close: Callable[[], None] = no_op
    """Release the policy's resources; called once, after the last call of the other functions."""
    reset: Callable[[], None] = no_op
    """Forget earlier flights; called when a flight begins."""

    @property
    def has_state(self) -> bool:
        """True if the policy keeps something from chunk to chunk, so that it needs a reset."""
        return self.reset is not no_op

    def join(self, encoded: Sequence[Sequence[FloatArray]]) -> FloatArray:
        """Combine the encoded images of each camera at each observation, oldest first, for ``act``.

        A single image is returned unchanged.
        """
        combine = np.concatenate if self.dual_rate else np.stack
        rows = [row[0] if len(row) == 1 else combine(row, axis=1) for row in encoded]
        return rows[0] if len(rows) == 1 else np.stack(rows, axis=1)
