"""Shared by all engines: a policy becomes an ``Executable``, tried once before it flies."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from policy.contract import ACTION_DIM, Contract, FloatArray
from policy.engines.warm_start import Segment, WarmStart, make_solve
from policy.errors import PolicyError, user_code
from policy.preprocess import image_to_input
from policy.protocol import DualRatePolicy, Executable, SingleRatePolicy, WarmStartPolicy

EngineName = Literal["auto", "torch", "openvino", "cuda-graph"]
Precision = Literal["bf16", "f32"]
Act = Callable[[FloatArray, FloatArray, FloatArray, float | None], FloatArray]
"""``Executable.act``."""


@dataclass(frozen=True, kw_only=True)
class ExecutionSettings:
    """Settings of an execution that do not depend on the engine."""

    name: str
    """The policy's name in messages."""
    vision_device: str = "cpu"
    action_device: str = "cpu"
    num_diffusion_steps: int = 10
    head_steps: int | None = None
    """Denoising steps of a solve from the last chunk; None = always a full solve."""
    dual_rate: bool = True
    """``encode`` runs the image path; needs a ``DualRatePolicy``."""


ArrayFunction = Callable[..., FloatArray]
"""float32 arrays in, one of the caller's own out."""
Shape = tuple[int, ...]
Compile = Callable[[Callable[..., Any], Sequence[Shape]], ArrayFunction]
"""(function of the engine's own kind of arrays, shapes of its float32 inputs) -> compiled."""


def make_executable(
    vision: SingleRatePolicy,
    action: SingleRatePolicy,
    compile_vision: Compile,
    compile_action: Compile,
    *,
    engine: str,
    settings: ExecutionSettings,
) -> Executable:
    """Compile a policy's methods for the loops and try them on a dummy sample.

    ``vision`` encodes images and ``action`` samples chunks: one policy, perhaps on two devices.

    Raises:
        PolicyError: no fast path where one was asked for, or the policy failed on the sample.
    """
    contract, steps = action.contract, settings.num_diffusion_steps
    rest = ((1, *contract.state_shape), (1, contract.history_len, ACTION_DIM))
    if not settings.dual_rate:
        predict = compile_action(
            lambda i, s, h: action.predict(i, s, h, steps), ((1, *contract.image_shape), *rest)
        )
        return assemble(contract, lambda array: array, always_full(predict), engine, settings)
    if not isinstance(vision, DualRatePolicy) or not isinstance(action, DualRatePolicy):
        raise PolicyError(
            f"{settings.name} has no encode_visual and predict_fast: fly it single-rate"
        )
    encode = compile_vision(
        vision.encode_visual, ((1, 3, contract.image_height, contract.image_width),)
    )
    fast = ((1, *contract.feature_shape), *rest)
    if isinstance(action, WarmStartPolicy) and settings.head_steps is not None:
        act = _warm_started(action, fast, compile_action, settings, settings.head_steps)
    else:
        sampler = action
        sample = compile_action(lambda e, s, h: sampler.predict_fast(e, s, h, steps), fast)
        act = always_full(sample)
    return assemble(contract, encode, act, engine, settings)


def make_numpy_executable(policy: SingleRatePolicy, settings: ExecutionSettings) -> Executable:
    """Wrap a numpy policy for the loops; tried once.

    Raises:
        PolicyError: no fast path where one was asked for, or it failed on a dummy sample.
    """

    def compile_(method: Callable[..., Any], _shapes: Sequence[Shape]) -> ArrayFunction:
        def run(*arrays: FloatArray) -> FloatArray:
            # Copies in and out: what is published is read-only, and what is returned may be a
            # buffer that the policy writes to again.
            result = method(*(array.copy() for array in arrays))
            if not isinstance(result, np.ndarray):
                raise PolicyError(
                    f"{settings.name} returned {type(result).__name__}; its contract says numpy "
                    "arrays"
                )
            return np.array(result, np.float32)

        return run

    return make_executable(policy, policy, compile_, compile_, engine="numpy", settings=settings)


def _warm_started(
    policy: WarmStartPolicy,
    shapes: Sequence[Shape],
    compile_: Compile,
    settings: ExecutionSettings,
    head_steps: int,
) -> Act:
    steps = settings.num_diffusion_steps
    noisy = (1, policy.contract.horizon, ACTION_DIM)

    def segment(first: int, count: int) -> Segment:
        return compile_(
            lambda e, s, h, n: policy.denoise_fast(e, s, h, n, steps, first, count),
            (*shapes, noisy),
        )

    with user_code(f"{settings.name} failed to prepare its warm start"):
        solve = make_solve(policy, segment, steps, head_steps)
    return WarmStart(solve, chunk_dt_s=policy.contract.chunk_dt_s)


def always_full(sample: ArrayFunction) -> Act:
    """Every chunk by ``sample(encoded, state, history)``, whenever the last one was."""
    return lambda encoded, state, history, _elapsed_s: sample(encoded, state, history)


def assemble(
    contract: Contract,
    encode: Callable[[FloatArray], FloatArray],
    act: Act,
    engine: str,
    settings: ExecutionSettings,
) -> Executable:
    """An executable of an engine's two functions, tried on a dummy sample, which warms it up.

    ``encode`` takes a normalised image [1, 3, H, W], ``act`` is that of ``Executable``.

    Raises:
        PolicyError: a function failed on the sample, or returned the wrong shape or no numbers.
    """

    def encode_rgb(rgb: NDArray[np.uint8]) -> FloatArray:
        with user_code(f"{settings.name} failed on an image"):
            return encode(image_to_input(rgb, contract))

    def act_on(
        encoded: FloatArray, state: FloatArray, history: FloatArray, elapsed_s: float | None
    ) -> FloatArray:
        with user_code(f"{settings.name} failed on a state"):
            return act(encoded, state, history, elapsed_s)

    executable = Executable(
        contract=contract,
        name=settings.name,
        engine=engine,
        dual_rate=settings.dual_rate,
        encode=encode_rgb,
        act=act_on,
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
