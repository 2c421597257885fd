"""Shared code of all engines: wrap a policy as a ``PolicyRunner`` and try it before it flies."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any, Literal

import numpy as np

from policy.contract import ACTION_DIM, QUATERNION, CameraImage, Contract, FloatArray
from policy.errors import NoChunkError, PolicyError, user_code
from policy.preprocess import image_to_input
from policy.protocol import (
    DualRatePolicy,
    PolicyRunner,
    SingleRatePolicy,
    StepwisePolicy,
    predict_by_pair,
)

EngineName = Literal["auto", "torch", "openvino", "cuda-graph"]
Precision = Literal["bf16", "f32"]
Act = Callable[[FloatArray, FloatArray, FloatArray], FloatArray]
"""Type of ``PolicyRunner.act``."""


@dataclass(frozen=True, kw_only=True)
class ExecutionSettings:
    """Engine-independent settings of an execution."""

    name: str
    """The policy's name in messages."""
    device: str = "cpu"
    num_diffusion_steps: int = 10
    dual_rate: bool = True
    """``encode`` runs the image path; needs a ``DualRatePolicy``."""


ArrayFunction = Callable[..., FloatArray]
"""Function that takes float32 arrays and returns an array owned by the caller."""
Shape = tuple[int, ...]
Compile = Callable[[Callable[..., Any], Sequence[Shape]], ArrayFunction]
"""(function of the engine's array type, shapes of its float32 inputs) -> compiled function."""


def make_runner(
    policy: SingleRatePolicy,
    compile_vision: Compile,
    compile_action: Compile,
    *,
    engine: str,
    settings: ExecutionSettings,
    compile_end: Compile | None = None,
) -> PolicyRunner:
    """Compile a policy's methods for the loops and try them on a dummy sample.

    With ``compile_end``, for ``to_chunk``, only the network of a ``StepwisePolicy`` is compiled.
    """
    contract, steps = policy.contract, settings.num_diffusion_steps
    rest = ((1, *contract.state_shape), (1, *contract.history_shape))
    if compile_end is not None and isinstance(policy, StepwisePolicy):
        encode = _encoders(policy, compile_vision)
        act = _solver(policy, compile_action, compile_end, settings)
        if settings.dual_rate:
            return assemble(contract, encode, act, engine, settings)
        return assemble(contract, (), _on_images(encode, act, contract), engine, settings)
    if not settings.dual_rate:
        predict = compile_action(
            lambda i, s, h: policy.predict(i, s, h, steps), ((1, *contract.image_shape), *rest)
        )
        return assemble(contract, (), predict, engine, settings)
    if not isinstance(policy, DualRatePolicy):
        raise PolicyError(
            f"{settings.name} has no encode_visual and predict_fast: fly it single-rate"
        )
    encode, sampler = _encoders(policy, compile_vision), policy
    fast = ((1, *contract.feature_shape), *rest)
    act = compile_action(lambda e, s, h: sampler.predict_fast(e, s, h, steps), fast)
    return assemble(contract, encode, act, engine, settings)


def _encoders(policy: DualRatePolicy, compile_vision: Compile) -> list[ArrayFunction]:
    """Compile ``encode_visual`` for each camera, as a function of the image alone."""
    contract = policy.contract
    encode: Callable[..., Any] = policy.encode_visual
    methods = [encode]
    if (cameras := len(contract.cameras)) > 1:
        methods = [lambda image, camera=i: encode(image, camera) for i in range(cameras)]
    return [compile_vision(method, ((1, *contract.image_shape[-3:]),)) for method in methods]


def _solver(
    policy: StepwisePolicy,
    compile_action: Compile,
    compile_end: Compile,
    settings: ExecutionSettings,
) -> Act:
    """Run the solver around the compiled network, in numpy."""
    contract = policy.contract
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

    return act


def _on_images(encode: Sequence[ArrayFunction], act: Act, contract: Contract) -> Act:
    """Single rate: apply ``act`` to images [1, *contract.image_shape] instead of their features."""
    pair: Any = SimpleNamespace(
        contract=contract,
        encode_visual=lambda image, camera=0: encode[camera](image),
        predict_fast=lambda feature, state, history, _: act(feature, state, history),
    )
    return lambda images, state, history: predict_by_pair(pair, images, state, history, 0)


def to_numpy(array: Any) -> FloatArray:
    """Return a float32 copy of an array of any library, on any device.

    Raises PolicyError unless it holds floats: numpy parses texts, and drops masks and imaginary
    parts. V is the kind of bfloat16 there.
    """
    is_tensor = hasattr(array, "cpu")
    is_float = array.is_floating_point() if is_tensor else array.dtype.kind in "fV"
    if not is_float or np.ma.is_masked(array):
        raise PolicyError(
            f"{'an array' if not is_float else 'a masked array'} of {array.dtype}, and the "
            "contract's numbers are floats: return the continuous actions"
        )
    # numpy has no bfloat16 of its own.
    return np.array(array.cpu().float().numpy() if is_tensor else array, np.float32)


def make_numpy_runner(policy: SingleRatePolicy, settings: ExecutionSettings) -> PolicyRunner:
    """Wrap a numpy policy for the loops; tried once."""
    run = run_in_numpy(settings.name)
    return make_runner(policy, run, run, engine="numpy", settings=settings)


def run_in_numpy(name: str) -> Compile:
    """Return an adapter of numpy functions: checks their results, copies in and out."""
    # In C order, unlike numpy.copy: sums over another order of axes round differently.
    return run_as(name, np.ndarray.copy, np.ndarray, "numpy arrays")


def run_as(name: str, convert: Callable[[FloatArray], Any], kind: type, said: str) -> Compile:
    """Return an adapter of functions of one library's arrays, which ``convert`` copies to it.

    It checks results, and copies in and out: published arrays are read-only, and a returned array
    may be a buffer that the policy overwrites.
    """

    def compile_(method: Callable[..., Any], _shapes: Sequence[Shape]) -> ArrayFunction:
        def run(*arrays: FloatArray) -> FloatArray:
            result = method(*map(convert, arrays))
            if not isinstance(result, kind):
                raise PolicyError(
                    f"{name} returned {type(result).__name__}; its contract says {said}"
                )
            return to_numpy(result)

        return run

    return compile_


def assemble(
    contract: Contract,
    encode: Sequence[ArrayFunction],
    act: Act,
    engine: str,
    settings: ExecutionSettings,
) -> PolicyRunner:
    """Build a runner from an engine's functions and try it on a dummy sample, which warms it up.

    ``encode`` has one function per camera, which takes a normalised image [1, 3, H, W]; it is empty
    without a fast path. ``act`` is that of ``PolicyRunner``.
    """

    def encode_image(image: CameraImage, camera: int = 0, /) -> FloatArray:
        with user_code(f"{settings.name} failed on an image"):
            planes = image_to_input(image, contract)
            return encode[camera](planes) if encode else planes

    def act_on(encoded: FloatArray, state: FloatArray, history: FloatArray) -> FloatArray:
        with user_code(f"{settings.name} failed on a state"):
            return act(encoded, state, history)

    runner = PolicyRunner(
        contract=contract,
        name=settings.name,
        engine=engine,
        dual_rate=settings.dual_rate,
        encode=encode_image,
        act=act_on,
    )
    _try(runner)
    return runner


def encode_all(runner: PolicyRunner, images: CameraImage) -> FloatArray:
    """Encode one image of each camera at each observation; return the argument of ``act``.

    ``images`` has the axes of ``dummy_sample``, and may have another size.
    """
    contract = runner.contract
    steps, cameras = contract.observation_steps, len(contract.cameras)
    images = images.reshape(steps, cameras, *images.shape[-len(contract.picture_shape) :])
    return runner.join(
        [[runner.encode(image, camera) for camera, image in enumerate(row)] for row in images]
    )


def dummy_sample(contract: Contract) -> tuple[CameraImage, FloatArray, FloatArray]:
    """Return grey images, or depth images of 2000 units, a level state and neutral actions.

    The images' leading axes are as in ``Contract.image_shape``, the last ``picture_shape``.
    """
    shape = (*contract.image_shape[:-3], *contract.picture_shape)
    images = np.full(shape, 2000, np.uint16) if contract.is_depth else np.full(shape, 128, np.uint8)
    history = np.zeros((1, *contract.history_shape), np.float32)
    return images, level_state(contract), history


def level_state(contract: Contract) -> FloatArray:
    """Return the state [1, *state_shape] of a level vehicle at rest: zeros but the attitude."""
    state = np.zeros((1, *contract.state_shape), np.float32)
    state[..., QUATERNION.start] = 1.0
    return state


def _try(runner: PolicyRunner) -> None:
    contract = runner.contract
    images, state, history = dummy_sample(contract)
    try:
        if runner.dual_rate:
            for camera in range(len(contract.cameras)):
                image = images.reshape(-1, *contract.picture_shape)[0]
                feature = runner.encode(image, camera)
                _require(runner, "encode_visual", feature, (1, contract.feature_dim))
        encoded = encode_all(runner, images)
        chunk = runner.act(encoded, state, history)
    except NoChunkError:
        return  # it may have one for the next state
    except PolicyError as error:
        told = str(error) if runner.name in str(error) else f"{runner.name}: {error}"
        raise PolicyError(
            f"{told}; this was a dummy sample: image {[1, *contract.image_shape]}, state "
            f"{[1, *contract.state_shape]}, action_history "
            f"{[1, *contract.history_shape]}, as {contract.arrays} arrays"
        ) from error
    require_chunk(runner, chunk)


def require_chunk(runner: PolicyRunner, chunk: FloatArray) -> None:
    """Raise PolicyError if a flight could not use a chunk of a dummy sample."""
    _require(runner, "the chunk", chunk, (1, runner.contract.horizon, ACTION_DIM))


def _require(runner: PolicyRunner, what: str, array: FloatArray, shape: tuple[int, ...]) -> None:
    if array.shape != shape:
        raise PolicyError(
            f"{runner.name}: {what} must be {list(shape)} by its contract, got {list(array.shape)}"
        )
    if not np.isfinite(array).all():
        raise PolicyError(f"{runner.name}: {what} holds NaN or infinity on a dummy sample")


def require_device(device: str) -> None:
    """Raise PolicyError if a device is missing; imports torch only for one other than cpu."""
    if device == "cpu":
        return
    import torch

    available = ["cpu", *(f"cuda:{index}" for index in range(torch.cuda.device_count()))]
    if torch.backends.mps.is_available():
        available.append("mps")
    if (device if device != "cuda" else "cuda:0") not in available:
        built = ""
        if device.startswith("cuda") and torch.version.cuda is None:
            built = f" (torch {torch.__version__} is built without CUDA)"
        raise PolicyError(
            f"--device {device} is not available: this computer has {', '.join(available)}{built}"
        )
