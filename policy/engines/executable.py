"""What all engines share: the policy's methods as an ``Executable``, tried once before it flies."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from policy.contract import (
    ACTION_DIM,
    Contract,
    DualRatePolicy,
    Executable,
    FloatArray,
    PolicyError,
    SingleRatePolicy,
    WarmStartPolicy,
)
from policy.engines.warm_start import Refine, Sample, WarmStart
from policy.preprocess import image_to_input
from policy.user_code import user_code

EngineName = Literal["auto", "torch", "openvino", "cuda-graph"]
Precision = Literal["bf16", "f32"]


@dataclass(frozen=True, kw_only=True)
class Settings:
    """How a policy is to be executed, whatever the engine."""

    name: str
    """Of the policy, shown to people."""
    vision_device: str = "cpu"
    """torch's name of where images are encoded."""
    action_device: str = "cpu"
    """torch's name of where chunks are sampled."""
    num_diffusion_steps: int = 10
    """Of a full solve."""
    head_steps: int | None = None
    """Of a solve from the last chunk; None = always a full one."""
    dual_rate: bool = True
    """Whether encode runs the image path; needs a ``DualRatePolicy``."""


class Run(Protocol):
    """How an engine calls a method of a policy: arrays of its own kind in, numpy out."""

    def __call__(self, method: Callable[..., Any], *arrays: FloatArray) -> FloatArray:
        """Call ``method`` with the arrays, converted."""
        ...


def make_executable(
    vision: SingleRatePolicy,
    action: SingleRatePolicy,
    run_vision: Run,
    run_action: Run,
    *,
    engine: str,
    settings: Settings,
) -> Executable:
    """Wrap a policy's methods for the loops and try them on a dummy sample.

    Args:
        vision: the policy where images are encoded.
        action: the same policy where chunks are sampled.
        run_vision: how ``vision``'s methods are called.
        run_action: how ``action``'s methods are called.
        engine: its name.
        settings: what was asked for.

    Raises:
        PolicyError: no fast path where one was asked for, or the policy failed on the sample.
    """
    steps = settings.num_diffusion_steps
    if not settings.dual_rate:
        sample = partial(run_action, lambda e, s, h: action.predict(e, s, h, steps))
        return assemble(action.contract, lambda image: image, sample, None, engine, settings)
    if not isinstance(vision, DualRatePolicy) or not isinstance(action, DualRatePolicy):
        raise PolicyError(
            f"{settings.name} has no encode_visual and predict_fast: fly it single-rate"
        )
    fast = action
    sample = partial(run_action, lambda e, s, h: fast.predict_fast(e, s, h, steps))
    refine: Refine | None = None
    if isinstance(action, WarmStartPolicy) and settings.head_steps is not None:
        warm, head_steps = action, settings.head_steps
        refine = partial(
            run_action, lambda e, s, h, g: warm.refine_fast(e, s, h, g, steps, head_steps)
        )
    encode = partial(run_vision, vision.encode_visual)
    return assemble(action.contract, encode, sample, refine, engine, settings)


def assemble(
    contract: Contract,
    encode: Callable[[FloatArray], FloatArray],
    sample: Sample,
    refine: Refine | None,
    engine: str,
    settings: Settings,
) -> Executable:
    """An executable of an engine's three functions, tried on a dummy sample, which warms it up.

    Args:
        contract: of the policy.
        encode: normalised image [1, 3, H, W] -> what the others take.
        sample: full solve.
        refine: solve from a guess; None = there is none.
        engine: its name.
        settings: what was asked for.

    Raises:
        PolicyError: a function failed on the sample, or returned the wrong shape or no numbers.
    """

    warm = None if refine is None else WarmStart(sample, refine, chunk_dt_s=contract.chunk_dt_s)

    def encode_rgb(rgb: NDArray[np.uint8]) -> FloatArray:
        with user_code(f"{settings.name} failed on an image"):
            return encode(image_to_input(rgb, contract))

    def act(
        encoded: FloatArray, state: FloatArray, history: FloatArray, elapsed_s: float | None
    ) -> FloatArray:
        with user_code(f"{settings.name} failed on a state"):
            if warm is None:
                return sample(encoded, state, history)
            return warm(encoded, state, history, elapsed_s)

    executable = Executable(
        contract=contract,
        name=settings.name,
        engine=engine,
        dual_rate=settings.dual_rate,
        encode=encode_rgb,
        act=act,
    )
    _try(executable)
    return executable


def _try(executable: Executable) -> None:
    contract = executable.contract
    rgb = np.full((contract.image_height, contract.image_width, 3), 128, np.uint8)
    state = np.zeros((1, contract.state_dim), np.float32)
    state[0, 3] = 1.0  # level attitude
    history = np.zeros((1, contract.history_len, ACTION_DIM), np.float32)
    try:
        encoded = executable.encode(rgb)
        if executable.dual_rate:
            _require(executable, "encode_visual", encoded, (1, contract.feature_dim))
        chunks = [executable.act(encoded, state, history, elapsed_s) for elapsed_s in (None, 0.01)]
    except PolicyError as error:
        raise PolicyError(
            f"{error}; this was a dummy sample: image [1, 3, {contract.image_height}, "
            f"{contract.image_width}], state [1, {contract.state_dim}], action_history "
            f"[1, {contract.history_len}, {ACTION_DIM}], as {contract.arrays} arrays"
        ) from error
    for chunk in chunks:
        _require(executable, "the chunk", chunk, (1, contract.horizon, ACTION_DIM))


def _require(executable: Executable, what: str, array: FloatArray, shape: tuple[int, ...]) -> None:
    if array.shape != shape:
        raise PolicyError(
            f"{executable.name}: {what} must be {list(shape)} by its contract, got "
            f"{list(array.shape)}"
        )
    if not np.isfinite(array).all():
        raise PolicyError(f"{executable.name}: {what} holds NaN or infinity on a dummy sample")
