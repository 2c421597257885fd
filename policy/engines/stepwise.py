"""Diffusion policies of which only the network is compiled: the solver runs around it, in numpy."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from policy.contract import Contract, FloatArray
from policy.engines.runner import (
    Act,
    ArrayFunction,
    Compile,
    ExecutionSettings,
    assemble,
    encoders,
    make_runner,
)
from policy.errors import user_code
from policy.protocol import PolicyRunner, SingleRatePolicy, StepwisePolicy


def to_numpy(array: Any) -> FloatArray:
    """Return a float32 copy of an array of any library, on any device."""
    return np.array(array.cpu().numpy() if hasattr(array, "cpu") else array, np.float32)


def make_parts_runner(
    policy: SingleRatePolicy,
    compile_vision: Compile,
    compile_action: Compile,
    compile_end: Compile,
    *,
    engine: str,
    settings: ExecutionSettings,
) -> PolicyRunner:
    """Create a runner as ``runner.make_runner``; of a ``StepwisePolicy`` compile single steps.

    ``compile_end`` compiles ``to_chunk``.
    """
    if not isinstance(policy, StepwisePolicy):
        compilers = compile_vision, compile_action
        return make_runner(policy, policy, *compilers, engine=engine, settings=settings)
    contract = policy.contract
    image = ((1, *contract.image_shape[-3:]),)
    encode = [compile_vision(method, image) for method in encoders(policy)]
    with user_code(f"{settings.name} failed to prepare its solver"):
        noise = to_numpy(policy.initial_noise)
        shapes = (
            *(noise.shape, (1,), (1, *contract.feature_shape)),
            *((1, *contract.state_shape), (1, *contract.history_shape)),
        )
        denoise = compile_action(policy.denoise, shapes)
        to_chunk = compile_end(policy.to_chunk, (noise.shape,))
        steps = policy.schedule.ddim_steps(settings.num_diffusion_steps)
    timesteps = [np.array([step.timestep], np.float32) for step in steps]

    def act(encoded: FloatArray, state: FloatArray, history: FloatArray) -> FloatArray:
        noisy = noise
        for step, timestep in zip(steps, timesteps, strict=True):
            output = denoise(noisy, timestep, encoded, state, history)
            noisy = policy.schedule.ddim_update(step, noisy, output)
        return to_chunk(noisy)

    if settings.dual_rate:
        return assemble(contract, encode, act, engine, settings)
    return assemble(contract, (), _on_images(encode, act, contract), engine, settings)


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
