"""Settings of a policy, shared by every command that flies one."""

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from mavbridge.config.flags import POLICY, RARE, Between, Ranged, hidden

STEPS, TOGE_STEPS = 10, 1
"""DDIM steps by default, and those of toge and toge-rates, which fly as well in one
(docs/dev/study.md)."""
Engine = Literal["auto", "torch", "openvino", "cuda-graph"]


@Parameter(name="*", group=POLICY)
@dataclass(frozen=True, kw_only=True)
class PolicyConfig(Ranged):
    """The policy, its weights, and what runs it."""

    policy: str = "toge"
    """toge, toge-rates, FILE.py:Class, lerobot:DIR, onnx:DIR, ws://..."""
    checkpoint: Path | None = None
    """Weights: .safetensors, .pt or .ckpt; toge and toge-rates come with theirs."""
    contract: Path | None = None
    """TOML file with what a foreign policy's files omit; see mavbridge contract."""
    dual_rate: Annotated[
        bool | None, Parameter(negative=("--no-dual-rate", "--single-rate"), show_default=False)
    ] = None
    """Encode images at a rate of their own; default: if the policy can."""
    num_diffusion_steps: Annotated[
        int | None, Parameter(show_default=False), Between(1, 100, "steps")
    ] = None
    """DDIM steps of the action head; default: 10, and 1 for toge and toge-rates."""
    allow_untrained: Annotated[bool, hidden("network.allow-untrained")] = False
    """Fly TOGE with random weights, for timing and bring-up only."""
    by_rates: bool = False
    """Fly a stick policy by thrust and body rates, its attitude loop closed here."""
    image_size: Annotated[int | None, hidden("network.image-size"), Between(32, 1024, "pixels")] = (
        None
    )
    """Side of the encoder's input in pixels; default: the contract's (224)."""
    engine: Annotated[Engine, hidden("network.engine")] = "auto"
    """Inference engine; auto: the fastest that agrees with torch."""
    device: str = "cpu"
    """torch device: cpu, cuda, cuda:1, mps."""
    seed: Annotated[int, Parameter(group=RARE), Between(0, 2**63 - 1)] = 0
    """Seed of random weights, diffusion noise and simulated courses."""

    def given(self, *apart: str) -> list[str]:
        """Return the names of the settings that were changed, apart from these."""
        return [
            each.name
            for each in fields(self)
            if each.name not in apart and getattr(self, each.name) != each.default
        ]

    @property
    def kind(self) -> str:
        """First word of ``policy``: toge, scripted, onnx, ..."""
        return self.policy.partition(":")[0]

    @property
    def may_be_dual(self) -> bool:
        """True if the policy may fly at two rates, as far as is known before it is loaded."""
        return self.dual_rate is not False and self.kind != "resnet-unet"

    @property
    def steps(self) -> int:
        """DDIM steps from noise."""
        if self.num_diffusion_steps is not None:
            return self.num_diffusion_steps
        return TOGE_STEPS if self.kind in ("toge", "toge-rates") else STEPS
