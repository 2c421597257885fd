"""The built-in network: TOGE, trained or with random weights."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

from policy.adapters.user_class import FORMS
from policy.errors import PolicyError, warned
from policy.loading.request import PolicyRequest, default_contract
from policy.nets.names import BACKBONE_NAMES, BUILTIN_KINDS, SIZE_NAMES, BackboneName, Size

if TYPE_CHECKING:
    from policy.nets.toge import Toge, TogeConfig

SHIPPED = Path(__file__).parents[1] / "weights" / "toge.safetensors"
"""Default weights of ``toge``; its model card is beside it."""
SHIPPED_RATES = SHIPPED.with_name("toge-rates.safetensors")
"""Default weights of ``toge-rates``, which flies by thrust and body rates."""


def builtin_config(spec: str, *, image_size: int | None) -> "TogeConfig":
    """Return the built-in network of ``spec``, with the default contract at that image size."""
    from policy.nets.toge import TogeConfig

    kind, *options = spec.split(":")
    if kind not in BUILTIN_KINDS:
        raise PolicyError(
            f"--policy {spec} cannot be trained here: use toge[:SIZE][:BACKBONE]; a world model "
            "has a command of its own, train-world-model"
        )
    size, backbone = parse_builtin(kind, options)
    contract = default_contract(image_size)
    return TogeConfig(size=size, backbone=backbone or TogeConfig.backbone, contract=contract)


def load_builtin(request: PolicyRequest) -> tuple["Toge", list[str]]:
    """Build a network and load its weights, or seeded random ones; return notes too."""
    import torch

    from policy.nets.toge import Toge

    config = builtin_config(request.spec, image_size=request.image_size)
    kind, *options = request.spec.split(":")
    if (checkpoint := builtin_checkpoint(request)) is not None:
        policy, notes = _trained(config, options, checkpoint, request.seed)
        if kind == "toge-rates" and policy.contract.action != "rates":
            raise PolicyError(
                f"{checkpoint} flies by {policy.contract.action}, not by rates as toge-rates does: "
                "write --policy toge, with --by-rates to close its attitude loop here"
            )
        return policy, notes
    if kind == "toge-rates":
        raise PolicyError("there is no untrained toge-rates: write --policy toge")
    with torch.random.fork_rng(devices=[]):  # leaves the global random state unchanged
        torch.manual_seed(request.seed)
        policy = Toge(config).eval()
    policy.head.seed_noise(request.seed)
    note = f"untrained: seeded random weights (seed {request.seed}, noise too); for bring-up only"
    return policy, [note]


def builtin_checkpoint(request: PolicyRequest) -> Path | None:
    """Return the weights of a built-in network; None if random weights are accepted."""
    if request.checkpoint is not None or request.allow_untrained:
        return request.checkpoint
    shipped = shipped_weights(request.spec)
    if shipped is not None and shipped.is_file():
        return shipped
    raise PolicyError(
        f"{request.spec} needs trained weights: give --checkpoint FILE, or "
        "network.allow_untrained=true for seeded random ones (timing and bring-up), or fly "
        "--policy scripted"
    )


def shipped_weights(spec: str) -> Path | None:
    """Return the shipped weights for a spec; None if there are none."""
    return {"toge": SHIPPED, "toge-rates": SHIPPED_RATES}.get(spec)


def parse_builtin(kind: str, options: list[str]) -> tuple[Size, BackboneName | None]:
    """Return the size and backbone of a spec; a checkpoint's own values take precedence."""
    rest: list[Any] = list(options)
    size: Size = rest.pop(0) if rest and rest[0] in SIZE_NAMES else "small"
    if len(rest) > 1:
        raise PolicyError(f"--policy {kind} does not take {':'.join(rest)!r}: write {FORMS}")
    if rest and rest[0] not in BACKBONE_NAMES:
        raise PolicyError(
            f"--policy {kind}:{':'.join(options)}: {rest[0]!r} is neither a size "
            f"({', '.join(SIZE_NAMES)}) nor an encoder ({', '.join(BACKBONE_NAMES)})"
        )
    return size, rest[0] if rest else None


def _trained(
    config: "TogeConfig", options: list[str], checkpoint: Path, seed: int
) -> tuple["Toge", list[str]]:
    from policy.checkpoints.networks import load_checkpoint

    policy = load_checkpoint(checkpoint, fallback=config)
    parts = (policy.config.size, policy.config.backbone)
    if contradicted := [option for option in options if option not in parts]:
        raise PolicyError(
            f"{checkpoint} holds {':'.join(parts)}, not {':'.join(contradicted)}: leave that out"
        )
    policy.head.seed_noise(seed)
    notes = [f"weights of {checkpoint} ({', '.join(parts)}); noise of seed {seed}"]
    if checkpoint.suffix != ".safetensors":
        contract, schedule = policy.contract, policy.config.schedule
        told = (
            f"{checkpoint} holds no contract; it is flown with frame {contract.state_frame}, "
            f"image {contract.image_width}x{contract.image_height}, "
            f"chunk of {contract.horizon} every {contract.chunk_dt_s:g} s, history of "
            f"{contract.history_len} every {contract.history_dt_s:g} s, prediction of the sample, "
            f"{schedule.betas} betas: is that how it was trained?"
        )
        notes.append(warned(told))
    return policy, notes
