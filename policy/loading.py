"""From what a user wrote (``--policy``, ``--checkpoint``) to an executable, or a clear refusal.

    toge[:SIZE][:BACKBONE]   TOGE, e.g. toge, toge:medium, toge:small:resnet18
    resnet-unet[:SIZE]       ResNet-UNet, single-rate
    scripted[:PROGRAM]       a fixed program, e.g. scripted:square
    package.module:Class     any class that keeps contract.SingleRatePolicy or DualRatePolicy

torch is imported only where a policy needs it.
"""

import importlib
import inspect
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from policy.contract import Contract, DualRatePolicy, Executable, SingleRatePolicy, WarmStartPolicy
from policy.engines.executable import EngineName, Settings
from policy.errors import PolicyError
from policy.scripted import ScriptedPolicy
from policy.user_code import user_code

if TYPE_CHECKING:
    from policy.checkpoints.policy_file import BuiltinConfig, BuiltinPolicy

SHIPPED = Path(__file__).parent / "weights" / "toge.safetensors"
"""Flown by ``toge`` where no other weights are named; its card is beside it."""
_FORMS = "toge[:SIZE][:BACKBONE], resnet-unet[:SIZE], scripted[:PROGRAM] or package.module:Class"


@dataclass(frozen=True, kw_only=True)
class LoadedPolicy:
    """A policy that may fly, and what a person should know of it."""

    executable: Executable
    notes: tuple[str, ...]
    """Lines to show before take-off."""


def load_policy(
    spec: str,
    *,
    checkpoint: Path | None,
    allow_untrained: bool,
    engine: EngineName = "auto",
    device: str,
    vision_device: str | None = None,
    action_device: str | None = None,
    dual_rate: bool,
    num_diffusion_steps: int,
    head_steps: int | None = None,
    image_size: int | None,
    seed: int,
    now_s: Callable[[], float],
) -> LoadedPolicy:
    """Find, build, load and try the policy that ``spec`` names.

    Args:
        spec: one of the forms in the module's docstring.
        checkpoint: weights; a user's class gets it as ``Class(checkpoint=path)``. Without it,
            ``toge`` takes the shipped ones.
        allow_untrained: whether seeded random weights will do where there is no checkpoint.
        engine: what runs the network; auto = the fastest that passes the parity gate.
        device: torch's name of where to run: cpu, cuda, cuda:0, mps.
        vision_device: where to encode images, if that is another one.
        action_device: where to sample chunks, if that is another one.
        dual_rate: asked for; a policy without a fast path is made single-rate, with a note.
        num_diffusion_steps: denoising steps of a full solve.
        head_steps: denoising steps of a solve from the last chunk; None = all solves are full.
        image_size: height and width that the policy takes; None leaves it to the contract.
        seed: of untrained weights and of the flight's initial noise.
        now_s: monotonic seconds, for scripted programs.

    Raises:
        PolicyError: with what was wrong, what was available and what to do.
    """
    kind, *options = spec.split(":")
    policy: SingleRatePolicy
    if kind == "scripted":
        policy = _scripted(options, checkpoint, image_size, now_s)
        notes = [f"{spec}: flies a fixed program, the camera is not looked at"]
    elif kind in ("toge", "resnet-unet"):
        config = _config(kind, options, image_size)
        if spec == "toge" and not allow_untrained and SHIPPED.is_file():
            checkpoint = checkpoint or SHIPPED
        if checkpoint is not None:
            policy, notes = _trained(config, options, checkpoint, seed)
        elif allow_untrained:
            policy, notes = _untrained(config, seed)
        else:
            raise PolicyError(
                f"{kind} needs trained weights: give --checkpoint FILE, or --allow-untrained for "
                "seeded random ones (timing and bring-up), or fly --policy scripted"
            )
    else:
        policy = _user_class(spec, checkpoint)
        notes = [f"{spec}: a class of yours"]
    _require_image_size(policy.contract, image_size)
    if dual_rate and not isinstance(policy, DualRatePolicy):
        dual_rate = False
        notes.append(
            f"warning: {spec} has no fast path (encode_visual and predict_fast), so it flies in "
            "single-rate mode, the whole network for every action"
        )
    if head_steps is not None and not (dual_rate and isinstance(policy, WarmStartPolicy)):
        notes.append(
            f"warning: --head-steps {head_steps} is not used: it takes --dual-rate and a policy "
            "with denoise_fast, such as toge; every solve is a full one"
        )
    settings = Settings(
        name=spec,
        vision_device=vision_device or device,
        action_device=action_device or device,
        num_diffusion_steps=num_diffusion_steps,
        head_steps=head_steps,
        dual_rate=dual_rate,
    )
    executable, engine_notes = _executable(policy, engine, settings)
    return LoadedPolicy(executable=executable, notes=(*notes, *engine_notes))


def builtin_config(spec: str, *, image_size: int) -> "BuiltinConfig":
    """The built-in network that ``spec`` names, with the default contract at that image size.

    Raises:
        PolicyError: it names none.
    """
    kind, *options = spec.split(":")
    if kind not in ("toge", "resnet-unet"):
        raise PolicyError(
            f"--policy {spec} cannot be trained here: use toge[:SIZE][:BACKBONE], "
            "resnet-unet[:SIZE] or world-model"
        )
    return _config(kind, options, image_size)


def _executable(
    policy: SingleRatePolicy, engine: EngineName, settings: Settings
) -> tuple[Executable, tuple[str, ...]]:
    """An engine that takes the policy's kind of arrays, and what to say of it."""
    if policy.contract.arrays == "numpy":
        from policy.engines.numpy_eager import make_numpy_executable

        if engine != "auto":
            raise PolicyError(
                f"{settings.name} computes in numpy, which --engine {engine} cannot run: leave "
                "the flag out"
            )
        return make_numpy_executable(policy, settings), ()
    from policy.engines.choose import choose_executable

    for device in (settings.vision_device, settings.action_device):
        _require_device(device)
    return choose_executable(policy, engine, settings)


def _scripted(
    options: list[str],
    checkpoint: Path | None,
    image_size: int | None,
    now_s: Callable[[], float],
) -> ScriptedPolicy:
    if checkpoint is not None:
        raise PolicyError(f"scripted policies have no weights: leave out --checkpoint {checkpoint}")
    program = ":".join(options) or "hover"
    return ScriptedPolicy(program, now_s, contract=_contract(image_size))


def _config(kind: str, options: list[str], image_size: int | None) -> "BuiltinConfig":
    """What the spec asks for; a checkpoint that says more overrules it."""
    from policy.nets.action_head import SIZE_NAMES
    from policy.nets.backbones import BACKBONE_NAMES
    from policy.nets.resnet_unet import ResnetUnetConfig
    from policy.nets.toge import TogeConfig

    rest: list[Any] = list(options)
    chosen_size: Any = rest.pop(0) if rest and rest[0] in SIZE_NAMES else "small"
    contract = _contract(image_size)
    if kind == "toge" and len(rest) <= 1:
        if rest and rest[0] not in BACKBONE_NAMES:
            raise PolicyError(
                f"--policy toge:{':'.join(options)}: {rest[0]!r} is neither a size "
                f"({', '.join(SIZE_NAMES)}) nor an encoder ({', '.join(BACKBONE_NAMES)})"
            )
        backbone = rest[0] if rest else TogeConfig.backbone
        return TogeConfig(size=chosen_size, backbone=backbone, contract=contract)
    if rest:
        raise PolicyError(f"--policy {kind} does not take {':'.join(rest)!r}: write {_FORMS}")
    return ResnetUnetConfig(size=chosen_size, contract=contract)


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
    policy.reset(seed)
    notes = [f"weights of {checkpoint} ({', '.join(parts)}); noise of seed {seed}"]
    if checkpoint.suffix != ".safetensors":
        notes.append(_assumptions(checkpoint, policy))
    return policy, notes


def _assumptions(checkpoint: Path, policy: "BuiltinPolicy") -> str:
    contract, schedule = policy.contract, policy.config.schedule
    return (
        f"warning: {checkpoint} may hold no contract; it is flown with frame "
        f"{contract.state_frame}, image {contract.image_width}x{contract.image_height}, "
        f"chunk of {contract.horizon} every {contract.chunk_dt_s:g} s, history of "
        f"{contract.history_len} every {contract.history_dt_s:g} s, prediction of the "
        f"{schedule.prediction}, {schedule.betas} betas: is that how it was trained?"
    )


def _untrained(config: "BuiltinConfig", seed: int) -> tuple["BuiltinPolicy", list[str]]:
    import torch

    from policy.checkpoints.policy_file import build_policy

    with torch.random.fork_rng(devices=[]):  # the process's own random stream stays as it was
        torch.manual_seed(seed)
        policy = build_policy(config).eval()
    policy.reset(seed)
    note = f"untrained: seeded random weights (seed {seed}, noise too); for bring-up only"
    return policy, [note]


def _user_class(spec: str, checkpoint: Path | None) -> SingleRatePolicy:
    module_name, _, class_name = spec.partition(":")
    names = (*module_name.split("."), class_name)
    if not all(name.isidentifier() for name in names):
        raise PolicyError(f"policy {spec!r} is unknown; write {_FORMS}")
    try:
        with user_code(f"importing {module_name} failed"):
            module = importlib.import_module(module_name)
    except PolicyError as error:
        raise PolicyError(
            f"--policy {spec}: {error}; put its folder on PYTHONPATH or install it, or write "
            f"{_FORMS}"
        ) from error
    found = getattr(module, class_name, None)
    if not isinstance(found, type):
        classes = sorted(name for name, value in vars(module).items() if isinstance(value, type))
        raise PolicyError(f"--policy {spec}: no class {class_name} there; it has {classes}")
    return _instance(spec, found, checkpoint)


def _instance(spec: str, found: type, checkpoint: Path | None) -> SingleRatePolicy:
    arguments: dict[str, Path] = {} if checkpoint is None else {"checkpoint": checkpoint}
    try:
        inspect.signature(found).bind(**arguments)
    except (TypeError, ValueError) as error:
        call = "Class()" if checkpoint is None else "Class(checkpoint=path)"
        raise PolicyError(f"--policy {spec}: cannot be made with {call}: {error}") from error
    with user_code(f"--policy {spec}: making it failed"):
        policy: object = found(**arguments)
    contract = getattr(policy, "contract", None)
    if not isinstance(policy, SingleRatePolicy) or not isinstance(contract, Contract):
        raise PolicyError(
            f"--policy {spec}: a policy needs a member contract (a policy.contract.Contract) and "
            "predict(image, state, action_history, num_diffusion_steps); for the dual-rate mode "
            "also encode_visual(image) and predict_fast(feature, state, action_history, "
            f"num_diffusion_steps). Missing or wrong here: {_lacking(policy)}"
        )
    if isinstance(policy, DualRatePolicy) and contract.feature_dim == 0:
        raise PolicyError(f"--policy {spec}: its contract needs feature_dim, F of encode_visual")
    return policy


def _lacking(policy: object) -> list[str]:
    lacking = [] if isinstance(getattr(policy, "contract", None), Contract) else ["contract"]
    return lacking + ([] if hasattr(policy, "predict") else ["predict"])


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


def _require_device(device: str) -> None:
    import torch

    available = ["cpu", *(f"cuda:{index}" for index in range(torch.cuda.device_count()))]
    if torch.backends.mps.is_available():
        available.append("mps")
    wanted = "cuda:0" if device == "cuda" else device
    if wanted not in available:
        raise PolicyError(f"device {device!r} is not available; this machine has {available}")
