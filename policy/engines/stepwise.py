"""Diffusion policies of which only the network is compiled: the solver runs around it, in numpy."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from policy.contract import ACTION_DIM, Contract, FloatArray
from policy.engines.runner import (
    Act,
    ArrayFunction,
    Compile,
    ExecutionSettings,
    assemble,
    encoders,
)
from policy.errors import user_code
from policy.protocol import PolicyRunner, StepwisePolicy

Segment = Callable[[FloatArray, FloatArray, FloatArray, FloatArray], FloatArray]
"""(encoded image, state, history, noisy chunk [1, horizon, 4]) -> less noisy chunk."""


def to_numpy(array: Any) -> FloatArray:
    """Return a float32 copy of an array of any library, on any device."""
    return np.array(array.cpu().numpy() if hasattr(array, "cpu") else array, np.float32)


def make_stepwise_runner(
    policy: StepwisePolicy,
    compile_vision: Compile,
    compile_action: Compile,
    compile_end: Compile,
    *,
    engine: str,
    settings: ExecutionSettings,
) -> PolicyRunner:
    """Create a runner as ``runner.make_runner``; ``compile_end`` compiles ``to_chunk``."""
    contract = policy.contract
    image = ((1, *contract.image_shape[-3:]),)
    encode = [compile_vision(method, image) for method in encoders(policy)]
    with user_code(f"{settings.name} failed to prepare its solver"):
        act = _act(policy, compile_action, compile_end, settings)
    if settings.dual_rate:
        return assemble(contract, encode, act, engine, settings)
    return assemble(contract, (), _on_images(encode, act, contract), engine, settings)


def _act(
    policy: StepwisePolicy,
    compile_action: Compile,
    compile_end: Compile,
    settings: ExecutionSettings,
) -> Act:
    contract, steps = policy.contract, settings.num_diffusion_steps
    noise = to_numpy(policy.initial_noise)
    denoise = compile_action(
        policy.denoise,
        (
            *(noise.shape, (1,), (1, *contract.feature_shape)),
            *((1, *contract.state_shape), (1, contract.history_len, ACTION_DIM)),
        ),
    )
    solve = solver_segment(denoise, policy.schedule, steps)
    to_chunk = compile_end(policy.to_chunk, (noise.shape,))
    return lambda e, s, h: to_chunk(solve(e, s, h, noise))


def _on_images(encode: Sequence[ArrayFunction], act: Act, contract: Contract) -> Act:
    """Single rate: apply ``act`` to images [1, *contract.image_shape] instead of their features."""

    def act_on_images(images: FloatArray, state: FloatArray, history: FloatArray) -> FloatArray:
        steps = images.reshape(-1, len(encode), 1, *images.shape[-3:])
        features = [
            encode_one(step[camera]) for step in steps for camera, encode_one in enumerate(encode)
        ]
        feature = np.concatenate(features, axis=1).reshape(1, *contract.feature_shape)
        return act(feature, state, history)

    return act_on_images


def solver_segment(denoise: ArrayFunction, schedule: Any, num_diffusion_steps: int) -> Segment:
    """Return a function that runs the DDIM steps of a solve around the network call ``denoise``.

    ``denoise`` and ``schedule`` are as in ``protocol.StepwisePolicy``.
    """
    steps = schedule.ddim_steps(num_diffusion_steps)
    timesteps = [np.array([step.timestep], np.float32) for step in steps]

    def run(
        encoded: FloatArray, state: FloatArray, history: FloatArray, noisy: FloatArray
    ) -> FloatArray:
        for step, timestep in zip(steps, timesteps, strict=True):
            output = denoise(noisy, timestep, encoded, state, history)
            noisy = schedule.ddim_update(step, noisy, output)
        return noisy

    return run
