"""What all engines share: the policy's methods as an ``Executable``, tried once before it flies."""

from collections.abc import Callable
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from policy.contract import (
    ACTION_DIM,
    STATE_DIM,
    DualRatePolicy,
    Executable,
    FloatArray,
    PolicyError,
    SingleRatePolicy,
)
from policy.preprocess import image_to_input


class Run(Protocol):
    """How an engine calls a method of a policy: arrays of its own kind in, numpy out."""

    def __call__(self, method: Callable[..., Any], *arrays: FloatArray) -> FloatArray:
        """Call ``method`` with the arrays, converted."""
        ...


def make_executable(
    policy: SingleRatePolicy,
    run: Run,
    *,
    name: str,
    engine: str,
    num_diffusion_steps: int,
    dual_rate: bool,
) -> Executable:
    """Wrap a policy for the loops and try it on a dummy sample, which also warms it up.

    Raises:
        PolicyError: no fast path where one was asked for, or the policy failed on the sample.
    """
    contract = policy.contract
    encode_visual: Callable[[Any], Any] | None = None
    predict: Callable[[Any, Any, Any, int], Any] = policy.predict
    if dual_rate:
        if not isinstance(policy, DualRatePolicy):
            raise PolicyError(f"{name} has no encode_visual and predict_fast: fly it single-rate")
        encode_visual, predict = policy.encode_visual, policy.predict_fast

    def predict_with_steps(observation: Any, state: Any, history: Any) -> Any:
        return predict(observation, state, history, num_diffusion_steps)

    def encode(rgb: NDArray[np.uint8]) -> FloatArray:
        image = image_to_input(rgb, contract)
        return image if encode_visual is None else run(encode_visual, image)

    def act(encoded: FloatArray, state: FloatArray, history: FloatArray) -> FloatArray:
        return run(predict_with_steps, encoded, state, history)

    executable = Executable(
        contract=contract, name=name, engine=engine, dual_rate=dual_rate, encode=encode, act=act
    )
    _try(executable)
    return executable


def _try(executable: Executable) -> None:
    contract = executable.contract
    rgb = np.full((contract.image_height, contract.image_width, 3), 128, np.uint8)
    state = np.zeros((1, STATE_DIM), np.float32)
    state[0, 3] = 1.0  # level attitude
    history = np.zeros((1, contract.history_len, ACTION_DIM), np.float32)
    try:
        encoded = executable.encode(rgb)
        if executable.dual_rate:
            _require(executable, "encode_visual", encoded, (1, contract.feature_dim))
        chunk = executable.act(encoded, state, history)
    except PolicyError:
        raise
    except (RuntimeError, ValueError, TypeError, AttributeError, LookupError) as error:
        raise PolicyError(
            f"{executable.name} failed on a dummy sample ({type(error).__name__}: {error}); it "
            f"gets image [1, 3, {contract.image_height}, {contract.image_width}], "
            f"state [1, {STATE_DIM}] and action_history [1, {contract.history_len}, {ACTION_DIM}] "
            f"as {contract.arrays} arrays"
        ) from error
    _require(executable, "the chunk", chunk, (1, contract.horizon, ACTION_DIM))


def _require(executable: Executable, what: str, array: FloatArray, shape: tuple[int, ...]) -> None:
    if array.shape != shape:
        raise PolicyError(
            f"{executable.name}: {what} must be {list(shape)} by its contract, got "
            f"{list(array.shape)}"
        )
    if not np.isfinite(array).all():
        raise PolicyError(f"{executable.name}: {what} holds NaN or infinity on a dummy sample")
