"""Loading of the user's ``--policy`` and ``--checkpoint``: returns a runner, or says what is wrong.

``adapters.user_class.FORMS`` lists the forms. torch is imported only if a policy needs it.
"""

from collections.abc import Callable, Iterator
from contextlib import ExitStack, chdir, contextmanager, suppress
from dataclasses import replace
from functools import partial
from inspect import isasyncgenfunction, iscoroutinefunction, isgeneratorfunction
from pathlib import Path

import numpy as np

from policy.adapters.description import Description, OnnxFiles, find_onnx_files, read_description
from policy.adapters.lerobot.plan import Plan, read_plan
from policy.adapters.user_class import check_user_class, load_user_class
from policy.adapters.websocket.kind import SCHEMES, check_server, load_server_policy
from policy.checkpoints.header import detect, read_contract
from policy.contract import Contract
from policy.engines.runner import ExecutionSettings, make_numpy_runner, require_device
from policy.errors import PolicyError, user_code, warned
from policy.files import user_path
from policy.loading.builtin import builtin_checkpoint, load_builtin, parse_builtin
from policy.loading.request import (
    LoadedPolicy,
    PolicyRequest,
    default_contract,
    measure_times,
    unit_notes,
)
from policy.motion.scripted import IN_AIR, ScriptedPolicy, make_scripted
from policy.motion.stick_loop import by_rates, flown_by_rates
from policy.nets.names import BUILTIN_KINDS
from policy.protocol import DualRatePolicy, PolicyRunner, SingleRatePolicy, no_op

LEROBOT, ONNX, TORCHSCRIPT = "lerobot", "onnx", "torchscript"
FORMS = {LEROBOT: "lerobot:DIR", ONNX: "onnx:DIR or onnx:FILE", TORCHSCRIPT: "torchscript:FILE.pt"}
"""Forms of --policy for files of other programs."""
AS_WRITTEN = (
    "engine torch: it runs as it is written; if it depends on its inputs and weights alone, "
    "network.engine=openvino converts it into a faster graph"
)
_NOT_PLAIN = (iscoroutinefunction, isgeneratorfunction, isasyncgenfunction)
"""Kinds of functions of which a call runs nothing."""
Engine = tuple[PolicyRunner, tuple[str, ...]]


def check_request(request: PolicyRequest) -> Contract | None:
    """Run the checks that take milliseconds, before weights, torch or a user's code is loaded.

    Checks the spec, the checkpoint's file and contract, the image size and the device. torch is
    imported only to look for a device other than the CPU. Returns the policy's contract, if its
    files contain one.
    """
    kind, *options = request.spec.split(":")
    _require_flags_of_kind(kind, request)
    contract: Contract | None = None
    if kind == "scripted":
        contract = _scripted(options, request, lambda: 0.0).contract
    elif kind in BUILTIN_KINDS:
        parse_builtin(kind, options)
        default_contract(request.image_size)
        if (checkpoint := builtin_checkpoint(request)) is not None:
            contract = read_contract(checkpoint)
    elif kind == LEROBOT:
        contract = _plan(request).interface.contract
    elif kind in SCHEMES:
        check_server(request.spec, request.contract_file, request.checkpoint)
    elif kind == ONNX:
        contract = _onnx_files(request).description.interface.contract
    elif kind == TORCHSCRIPT:
        contract = _archive(request).interface.contract
    else:
        _require_no_path(request.spec)
        check_user_class(request.spec)
    if contract is not None:
        _require_image_size(contract, request.image_size)
    require_device(request.device)
    return contract


@contextmanager
def _process_kept() -> Iterator[None]:
    """Context manager: restore numpy's errors, and the folder that output files are relative to."""
    with ExitStack() as stack:
        stack.enter_context(np.errstate())
        with suppress(OSError):  # it was deleted, or is closed to this user
            stack.enter_context(chdir(Path.cwd()))
        yield


@_process_kept()
def read_policy_contract(request: PolicyRequest) -> Contract:
    """Return the contract of a policy, without loading a built-in network."""
    contract = check_request(request)
    if request.spec.partition(":")[0] in BUILTIN_KINDS:
        contract = contract or default_contract(request.image_size)
        return by_rates(contract) if request.by_rates else contract
    if contract is None:
        policy, _ = _find_other(request, lambda: 0.0)
        _life_method(policy, "close", request.spec)()
        contract = policy.contract
    return contract


@_process_kept()
def load_policy(request: PolicyRequest, *, now_s: Callable[[], float]) -> LoadedPolicy:
    """Find, load, try and time a policy; ``now_s`` (monotonic seconds) also drives programs."""
    check_request(request)
    policy, notes, make_runner = _find(request, now_s)
    reset, close = (_life_method(policy, name, request.spec) for name in ("reset", "close"))
    try:
        settings = _settings(policy, request, notes)
        runner, engine_notes = (make_runner or partial(_on_engine, policy, request))(settings)
        if not runner.has_state:  # engines that keep the state bring their own reset
            runner = replace(runner, reset=reset)
        times, doubts = measure_times(runner, now_s), unit_notes(runner)
        runner.reset()  # forget the dummy samples
    except BaseException:
        with suppress(PolicyError):
            close()
        raise
    runner = replace(runner, close=close)
    return LoadedPolicy(runner=runner, notes=(*notes, *engine_notes, *doubts), times=times)


def _settings(
    policy: SingleRatePolicy, request: PolicyRequest, notes: list[str]
) -> ExecutionSettings:
    """Return how to execute the policy; ``notes`` gets deviations from the request."""
    _require_image_size(policy.contract, request.image_size)
    dual_rate = request.dual_rate and isinstance(policy, DualRatePolicy)
    if request.dual_rate and not dual_rate:
        lack = f"{request.spec} has no fast path (encode_visual and predict_fast)"
        effect = "it flies in single-rate mode, the whole network for every action"
        notes.append(warned(f"{lack}, so {effect} (--single-rate: as intended)"))
    return ExecutionSettings(
        name=request.spec,
        device=request.device,
        num_diffusion_steps=request.num_diffusion_steps,
        dual_rate=dual_rate,
    )


def _on_engine(
    policy: SingleRatePolicy, request: PolicyRequest, settings: ExecutionSettings
) -> Engine:
    """Return the policy on its engine, tried once, and notes."""
    if policy.contract.arrays == "numpy":
        if request.engine != "auto":
            raise PolicyError(
                f"{request.spec} computes in numpy, which network.engine={request.engine} cannot "
                "run: leave it out"
            )
        return make_numpy_runner(policy, settings), ()
    from policy.adapters.modules import ForwardPolicy
    from policy.engines.choose import choose_runner
    from policy.engines.torch_engines import modules_of

    kind = request.spec.partition(":")[0]
    is_ours = kind in (*BUILTIN_KINDS, LEROBOT, TORCHSCRIPT) or isinstance(policy, ForwardPolicy)
    if request.engine == "auto" and not is_ours:  # methods of the user's own may do anything
        runner, engine_notes = choose_runner(policy, "torch", settings)
        if settings.device == "cpu" and modules_of(policy) and not hasattr(policy, "reset"):
            engine_notes = (AS_WRITTEN,)
        return runner, engine_notes
    runner, engine_notes = choose_runner(policy, request.engine, settings)
    if kind in BUILTIN_KINDS and (request.by_rates or policy.contract.action == "rates"):
        runner = flown_by_rates(runner)
    return runner, engine_notes


def _find(
    request: PolicyRequest, now_s: Callable[[], float]
) -> tuple[SingleRatePolicy, list[str], Callable[[ExecutionSettings], Engine] | None]:
    """Create the policy, notes for the user, and its own choice of an engine if it has one."""
    if not request.spec.startswith(f"{ONNX}:"):
        return *_find_other(request, now_s), None
    from policy.adapters.onnx import OnnxGraphs

    graphs = OnnxGraphs(_onnx_files(request), request.seed)
    in_float32 = graphs.at("f32", "f32")
    notes = [graphs.describe(request.num_diffusion_steps)]
    return in_float32[0], notes, partial(graphs.make_runner, in_float32)


def _find_other(
    request: PolicyRequest, now_s: Callable[[], float]
) -> tuple[SingleRatePolicy, list[str]]:
    kind, *options = request.spec.split(":")
    if kind == "scripted":
        note = f"{request.spec}: flies a fixed program, the camera is not looked at"
        return _scripted(options, request, now_s), [note]
    if kind in BUILTIN_KINDS:
        return load_builtin(request)
    if kind in SCHEMES:
        return load_server_policy(request.spec, request.contract_file)
    if kind == LEROBOT:
        from policy.adapters.lerobot.policy import load_policy_of

        steps = request.num_diffusion_steps
        return load_policy_of(_plan(request), seed=request.seed, num_diffusion_steps=steps)
    if kind == TORCHSCRIPT:
        from policy.adapters.modules import load_torchscript

        path = _path(request)
        policy = load_torchscript(request.spec, path, _archive(request), request.seed)
        return policy, [f"TorchScript archive {path}"]
    policy = load_user_class(request.spec, request.checkpoint, seed=request.seed)
    return policy, [f"{request.spec}: a class of yours"]


def _path(request: PolicyRequest) -> Path:
    kind, _, path = request.spec.partition(":")
    if not path or request.checkpoint is not None:
        form = FORMS[kind]
        raise PolicyError(f"--policy {request.spec}: write {form}, and leave out --checkpoint")
    return user_path(path)


def _plan(request: PolicyRequest) -> Plan:
    return read_plan(_path(request), request.contract_file)


def _onnx_files(request: PolicyRequest) -> OnnxFiles:
    path = _path(request)
    if request.engine not in ("auto", "openvino") or request.device != "cpu":
        flags = "network.engine and --device"
        raise PolicyError(f"--policy {request.spec} runs in OpenVINO on the CPU: leave out {flags}")
    return find_onnx_files(request.spec, path, request.contract_file)


def _archive(request: PolicyRequest) -> Description:
    path = _path(request)
    if not path.is_file():
        raise PolicyError(f"--policy {request.spec}: there is no file {path}")
    return read_description(request.spec, path, request.contract_file)


def _scripted(
    options: list[str], request: PolicyRequest, now_s: Callable[[], float]
) -> ScriptedPolicy:
    if request.checkpoint is not None:
        raise PolicyError(
            f"scripted policies have no weights: leave out --checkpoint {request.checkpoint}"
        )
    contract = default_contract(request.image_size)
    if request.starts_in_air and options[-1:] != [IN_AIR]:
        options = [*(options or ["hover"]), IN_AIR]
    return make_scripted(options, now_s, contract=contract)


def _life_method(policy: SingleRatePolicy, name: str, spec: str) -> Callable[[], None]:
    """Return the policy's own ``reset`` or ``close``, ready to call; a no-op if it has none."""
    with user_code(f"{spec} failed to {name}"):
        method: Callable[[], object] | None = getattr(policy, name, None)
        with_torch = policy.contract.arrays == "torch"
    if method is None:
        return no_op
    if any(is_kind(method) for is_kind in _NOT_PLAIN):
        raise PolicyError(f"{spec}: {name} is async or a generator: make it a plain method")

    def call() -> None:
        with ExitStack() as stack:
            stack.enter_context(user_code(f"{spec} failed to {name}"))
            if with_torch:
                import torch

                # As for chunks: outside, torch refuses in-place changes to inference tensors.
                stack.enter_context(torch.inference_mode())
            method()

    return call


def _require_flags_of_kind(kind: str, request: PolicyRequest) -> None:
    """Raise PolicyError for inapplicable flags, and for a file of another kind than the spec's."""
    if request.by_rates and kind not in BUILTIN_KINDS:
        raise PolicyError(
            f"--by-rates is for {' and '.join(BUILTIN_KINDS)}, whose sticks are known to the "
            f"degree: {request.spec} flies by what its contract says"
        )
    if kind in FORMS:
        path = user_path(request.spec.partition(":")[2])
        sentence = detect(path) if path.is_file() else None
        own = tuple(f"--policy {kind}:{each}" for each in (path, path.parent))
        if sentence is not None and not sentence.endswith(own):
            raise PolicyError(f"--policy {request.spec}: {sentence}")
    elif kind not in SCHEMES and request.contract_file is not None:
        raise PolicyError(
            f"--policy {request.spec} has a contract of its own, and --contract "
            f"{request.contract_file} is for files and servers that say too little: leave it out"
        )


def _require_no_path(spec: str) -> None:
    """Raise PolicyError for a bare path as the policy; the message names the form that flies it."""
    path = Path(spec)
    if not spec or ":" in spec or path.suffix == ".py":
        return
    if path.exists():
        advice = f"{spec} is a file: give weights of ours as --checkpoint {spec}"
        raise PolicyError(f"--policy {detect(path) or advice}")
    if path.name != spec:
        raise PolicyError(
            f"--policy {spec}: there is no such file or folder; a model of the Hugging Face hub is "
            f"downloaded first (hf download {spec} --local-dir DIR), and a policy of LeRobot then "
            "flies as lerobot:DIR"
        )


def _require_image_size(contract: Contract, image_size: int | None) -> None:
    height, width = contract.image_height, contract.image_width
    if image_size is not None and (height, width) != (image_size, image_size):
        raise PolicyError(
            f"network.image_size={image_size} contradicts the policy's contract, which takes "
            f"{height}x{width}: leave the flag out"
        )
