"""From what a user wrote (``--policy``, ``--checkpoint``) to an executable, or a clear refusal.

    toge[:SIZE][:BACKBONE]   TOGE, e.g. toge, toge:medium, toge:small:resnet18
    resnet-unet[:SIZE]       ResNet-UNet, single-rate
    scripted[:PROGRAM][:ACTION][:air]
                             a fixed program in any kind of action, e.g. scripted:square:velocity;
                             air: begin in the air, without the climb
    package.module:Class     any class that keeps contract.SingleRatePolicy or DualRatePolicy

torch is imported only where a policy needs it.
"""

import inspect
import sys
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from policy.checkpoints.header import read_contract
from policy.contract import (
    Contract,
    DualRatePolicy,
    Executable,
    SingleRatePolicy,
    WarmStartPolicy,
    keep_nothing,
)
from policy.engines.executable import EngineName, ExecutionSettings, make_numpy_executable
from policy.errors import PolicyError, user_code
from policy.nets.names import BACKBONE_NAMES, SIZE_NAMES, BackboneName, Size
from policy.scripted.spec import IN_AIR, make_scripted
from policy.user_class import FORMS, load_user_class, user_class_name

if TYPE_CHECKING:
    from policy.checkpoints.policy_file import BuiltinConfig, BuiltinPolicy

SHIPPED = Path(__file__).parent / "weights" / "toge.safetensors"
"""Flown by ``toge`` where no other weights are named; its card is beside it."""
BUILTIN_KINDS = ("toge", "resnet-unet")


@dataclass(frozen=True, kw_only=True)
class PolicyRequest:
    """The policy that a user asked for, and how it is to run."""

    spec: str
    """One of the forms in the module's docstring."""
    checkpoint: Path | None = None
    """Weights; a user's class gets them as ``Class(checkpoint=path)``. Without any, ``toge`` takes
    the shipped ones."""
    allow_untrained: bool = False
    """Accept seeded random weights where there is no checkpoint."""
    engine: EngineName = "auto"
    """Engine that runs the network; auto = the fastest that passes the parity gate."""
    device: str = "cpu"
    """torch's name of where to run: cpu, cuda, cuda:0, mps."""
    vision_device: str | None = None
    """Where to encode images, if that is another one."""
    action_device: str | None = None
    """Where to sample chunks, if that is another one."""
    dual_rate: bool = True
    """A policy without a fast path is made single-rate, with a note."""
    num_diffusion_steps: int = 10
    head_steps: int | None = None
    """Denoising steps of a solve from the last chunk; None = all solves are full."""
    image_size: int | None = None
    """Height and width that the policy takes; None leaves it to the contract."""
    seed: int = 0
    """Seed of untrained weights and of the flight's initial noise."""
    starts_in_air: bool = False
    """The vehicle flies already when the policy takes over: a scripted program does not climb."""


@dataclass(frozen=True, kw_only=True)
class LoadedPolicy:
    """A policy that may fly, and notes about it for the user."""

    executable: Executable
    notes: tuple[str, ...]


def check_request(request: PolicyRequest) -> None:
    """Refuse what can be refused in milliseconds: before weights, torch or a user's code is loaded.

    That is the spec, the checkpoint's file and contract, the image size, and the device. Only to
    look for a device other than the CPU is torch imported.

    Raises:
        PolicyError: with what was wrong, what was available and what to do.
    """
    kind, *options = request.spec.split(":")
    if kind == "scripted":
        _scripted(options, request, lambda: 0.0)
    elif kind in BUILTIN_KINDS:
        _parse_builtin(kind, options)
        _contract(request.image_size)
        checkpoint = _checkpoint(request)
        if checkpoint is not None and (contract := read_contract(checkpoint)) is not None:
            _require_image_size(contract, request.image_size)
        _require_devices(request)
    else:
        package = user_class_name(request.spec)[0].partition(".")[0]
        if package not in sys.modules and find_spec(package) is None:
            raise PolicyError(
                f"--policy {request.spec}: there is no module {package}; put its folder on "
                f"PYTHONPATH or install it, or write {FORMS}"
            )


def read_policy_contract(request: PolicyRequest) -> Contract:
    """Contract of a policy; a network of ours is not loaded for it.

    Raises:
        PolicyError: as ``check_request``; or a user's class cannot be made.
    """
    check_request(request)
    if request.spec.partition(":")[0] not in BUILTIN_KINDS:
        return _find(request, lambda: 0.0)[0].contract
    checkpoint = _checkpoint(request)
    contract = None if checkpoint is None else read_contract(checkpoint)
    return contract or _contract(request.image_size)


def load_policy(request: PolicyRequest, *, now_s: Callable[[], float]) -> LoadedPolicy:
    """Find, build, load and try a policy; ``now_s``, monotonic seconds, is for scripted programs.

    Raises:
        PolicyError: with what was wrong, what was available and what to do.
    """
    check_request(request)
    policy, notes = _find(request, now_s)
    reset = _reset(policy, request.spec)
    _require_image_size(policy.contract, request.image_size)
    dual_rate = request.dual_rate and isinstance(policy, DualRatePolicy)
    if request.dual_rate and not dual_rate:
        notes.append(
            f"warning: {request.spec} has no fast path (encode_visual and predict_fast), so it "
            "flies in single-rate mode, the whole network for every action"
        )
    if request.head_steps is not None and not (dual_rate and isinstance(policy, WarmStartPolicy)):
        notes.append(
            f"warning: --head-steps {request.head_steps} is not used: it takes --dual-rate and a "
            "policy with denoise_fast, such as toge; every solve is a full one"
        )
    settings = ExecutionSettings(
        name=request.spec,
        vision_device=request.vision_device or request.device,
        action_device=request.action_device or request.device,
        num_diffusion_steps=request.num_diffusion_steps,
        head_steps=request.head_steps,
        dual_rate=dual_rate,
    )
    executable, engine_notes = _executable(policy, request, settings)
    reset()  # of what the trial on dummy samples left behind
    return LoadedPolicy(executable=replace(executable, reset=reset), notes=(*notes, *engine_notes))


def builtin_config(spec: str, *, image_size: int) -> "BuiltinConfig":
    """The built-in network that ``spec`` names, with the default contract at that image size.

    Raises:
        PolicyError: it names none.
    """
    kind, *options = spec.split(":")
    if kind not in BUILTIN_KINDS:
        raise PolicyError(
            f"--policy {spec} cannot be trained here: use toge[:SIZE][:BACKBONE], "
            "resnet-unet[:SIZE]; a world model has a command of its own, train-world-model"
        )
    return _config(kind, options, image_size)


def _find(request: PolicyRequest, now_s: Callable[[], float]) -> tuple[SingleRatePolicy, list[str]]:
    kind, *options = request.spec.split(":")
    if kind == "scripted":
        note = f"{request.spec}: flies a fixed program, the camera is not looked at"
        return _scripted(options, request, now_s), [note]
    if kind not in BUILTIN_KINDS:
        return load_user_class(request.spec, request.checkpoint), [
            f"{request.spec}: a class of yours"
        ]
    config, checkpoint = _config(kind, options, request.image_size), _checkpoint(request)
    if checkpoint is None:
        return _untrained(config, request.seed)
    return _trained(config, options, checkpoint, request.seed)


def _checkpoint(request: PolicyRequest) -> Path | None:
    """The weights of a network of ours; None where random ones will do."""
    if request.checkpoint is not None or request.allow_untrained:
        return request.checkpoint
    if request.spec == "toge" and SHIPPED.is_file():
        return SHIPPED
    raise PolicyError(
        f"{request.spec} needs trained weights: give --checkpoint FILE, or --allow-untrained for "
        "seeded random ones (timing and bring-up), or fly --policy scripted"
    )


def _executable(
    policy: SingleRatePolicy, request: PolicyRequest, settings: ExecutionSettings
) -> tuple[Executable, tuple[str, ...]]:
    """An engine that takes the policy's kind of arrays, and notes about the choice."""
    if policy.contract.arrays == "numpy":
        if request.engine != "auto":
            raise PolicyError(
                f"{request.spec} computes in numpy, which --engine {request.engine} cannot run: "
                "leave the flag out"
            )
        return make_numpy_executable(policy, settings), ()
    from policy.engines.choose import choose_executable

    _require_devices(request)
    return choose_executable(policy, request.engine, settings)


def _scripted(
    options: list[str], request: PolicyRequest, now_s: Callable[[], float]
) -> SingleRatePolicy:
    if request.checkpoint is not None:
        raise PolicyError(
            f"scripted policies have no weights: leave out --checkpoint {request.checkpoint}"
        )
    contract = _contract(request.image_size)
    if request.starts_in_air and options[-1:] != [IN_AIR]:
        options = [*(options or ["hover"]), IN_AIR]
    return make_scripted(options, now_s, contract=contract)


def _parse_builtin(kind: str, options: list[str]) -> tuple[Size, BackboneName | None]:
    """Size and backbone that a spec asks for; a checkpoint that says more overrules them."""
    rest: list[Any] = list(options)
    size: Size = rest.pop(0) if rest and rest[0] in SIZE_NAMES else "small"
    if len(rest) > (1 if kind == "toge" else 0):
        raise PolicyError(f"--policy {kind} does not take {':'.join(rest)!r}: write {FORMS}")
    if rest and rest[0] not in BACKBONE_NAMES:
        raise PolicyError(
            f"--policy toge:{':'.join(options)}: {rest[0]!r} is neither a size "
            f"({', '.join(SIZE_NAMES)}) nor an encoder ({', '.join(BACKBONE_NAMES)})"
        )
    return size, rest[0] if rest else None


def _config(kind: str, options: list[str], image_size: int | None) -> "BuiltinConfig":
    from policy.nets.resnet_unet import ResnetUnetConfig
    from policy.nets.toge import TogeConfig

    size, backbone = _parse_builtin(kind, options)
    contract = _contract(image_size)
    if kind == "toge":
        return TogeConfig(size=size, backbone=backbone or TogeConfig.backbone, contract=contract)
    return ResnetUnetConfig(size=size, contract=contract)


def _trained(
    config: "BuiltinConfig", options: list[str], checkpoint: Path, seed: int
) -> tuple["BuiltinPolicy", list[str]]:
    from policy.checkpoints.policy_file import load_checkpoint

    policy = load_checkpoint(checkpoint, fallback=config)
    parts = (policy.config.size, getattr(policy.config, "backbone", "resnet18"))
    if contradicted := [option for option in options if option not in parts]:
        raise PolicyError(
            f"{checkpoint} holds {':'.join(parts)}, not {':'.join(contradicted)}: leave that out"
        )
    policy.seed_noise(seed)
    notes = [f"weights of {checkpoint} ({', '.join(parts)}); noise of seed {seed}"]
    if checkpoint.suffix != ".safetensors":
        contract, schedule = policy.contract, policy.config.schedule
        notes.append(
            f"warning: {checkpoint} may hold no contract; it is flown with frame "
            f"{contract.state_frame}, image {contract.image_width}x{contract.image_height}, "
            f"chunk of {contract.horizon} every {contract.chunk_dt_s:g} s, history of "
            f"{contract.history_len} every {contract.history_dt_s:g} s, prediction of the "
            f"{schedule.prediction}, {schedule.betas} betas: is that how it was trained?"
        )
    return policy, notes


def _untrained(config: "BuiltinConfig", seed: int) -> tuple["BuiltinPolicy", list[str]]:
    import torch

    from policy.checkpoints.policy_file import build_policy

    with torch.random.fork_rng(devices=[]):  # the process's own random stream stays as it was
        torch.manual_seed(seed)
        policy = build_policy(config).eval()
    policy.seed_noise(seed)
    note = f"untrained: seeded random weights (seed {seed}, noise too); for bring-up only"
    return policy, [note]


def _reset(policy: SingleRatePolicy, spec: str) -> Callable[[], None]:
    """The policy's own ``reset``, ready for the loops; one that does nothing where it has none."""
    method: object = getattr(policy, "reset", None)
    if method is None:
        return keep_nothing
    if not callable(method):
        raise PolicyError(
            f"--policy {spec}: reset must be a method without arguments, which is called when a "
            f"flight begins; it is {method!r}"
        )
    try:
        inspect.signature(method).bind()
    except (TypeError, ValueError) as error:
        raise PolicyError(
            f"--policy {spec}: reset is called without arguments when a flight begins, and cannot "
            f"be: {error}; give its parameters defaults, or give it another name"
        ) from error
    with_torch = policy.contract.arrays == "torch"

    def reset() -> None:
        with ExitStack() as stack:
            stack.enter_context(user_code(f"{spec} failed to reset"))
            if with_torch:
                import torch

                # As chunks are computed: torch refuses to change their tensors in place elsewhere.
                stack.enter_context(torch.inference_mode())
            method()

    return reset


def _contract(image_size: int | None) -> Contract:
    if image_size is None:
        return Contract()
    return Contract(image_height=image_size, image_width=image_size)


def _require_image_size(contract: Contract, image_size: int | None) -> None:
    height, width = contract.image_height, contract.image_width
    if image_size is not None and (height, width) != (image_size, image_size):
        raise PolicyError(
            f"--image-size {image_size} contradicts the policy's contract, which takes "
            f"{height}x{width}: leave the flag out"
        )


def _require_devices(request: PolicyRequest) -> None:
    wanted = {request.vision_device or request.device, request.action_device or request.device}
    if wanted == {"cpu"}:
        return
    import torch

    available = ["cpu", *(f"cuda:{index}" for index in range(torch.cuda.device_count()))]
    if torch.backends.mps.is_available():
        available.append("mps")
    for device in sorted(wanted):
        if (device if device != "cuda" else "cuda:0") not in available:
            raise PolicyError(f"device {device!r} is not available; this machine has {available}")
