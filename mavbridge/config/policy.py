"""A policy and the rates at which it runs [Hz], as every command that flies one takes them."""

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from mavbridge.config.flags import POLICY, RARE, RATES, Ranged, hidden
from policy.fields import Between
from policy.nets.names import BUILTIN_KINDS

STEPS, TOGE_STEPS = 10, 1
"""DDIM steps by default, and those of toge and toge-rates, which fly as well in one
(docs/dev/study.md)."""
Engine = Literal["auto", "torch", "openvino", "cuda-graph"]
LEAST_HZ = 0.5
ACTION_HZ, SINGLE_HZ = 100.0, 30.0
"""Default maximum of chunks per second, at two rates and at one."""
SOLVES_PER_PLAY = 2.0
"""Chunks computed per play time: a new chunk arrives before the last one ends, even if a solve is
late."""
STATE_HZ = 50.0
"""Lowest requested telemetry rate, however slow the actions: age limits are in seconds."""


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
    def steps(self) -> int:
        """DDIM steps from noise."""
        if self.num_diffusion_steps is not None:
            return self.num_diffusion_steps
        return TOGE_STEPS if self.kind in BUILTIN_KINDS else STEPS


@dataclass(frozen=True, slots=True, kw_only=True)
class LoopRates:
    """Rates of the two loops of a flight."""

    action_hz: float
    vision_hz: float

    @property
    def state_hz(self) -> float:
        """Telemetry rate to request from the vehicle."""
        return max(self.action_hz, STATE_HZ)


@Parameter(name="*", group=RATES)
@dataclass(frozen=True, kw_only=True)
class Rates(Ranged):
    """Loop rates in Hz."""

    visual_rate: Annotated[float, hidden("rates.visual"), Between(0.5, 240, "Hz")] = 30.0
    """Most images encoded per second (dual rate)."""
    action_rate: Annotated[float | None, hidden("rates.action"), Between(LEAST_HZ, 500, "Hz")] = (
        None
    )
    """Most chunks of actions per second (dual rate), each from the newest attitude; default: 100,
    or 2 / play_s for slow policies."""
    rate: Annotated[float | None, hidden("rates.single"), Between(LEAST_HZ, 500, "Hz")] = None
    """Most chunks of actions per second (single rate), each from the newest image; default: 30, or
    2 / play_s for slow policies."""
    stick_rate: Annotated[float, hidden("rates.stick"), Between(20, 400, "Hz")] = 100.0
    """Commands sent to the autopilot per second, independent of the policy's rate."""
    realtime: Annotated[bool, hidden("scheduling.realtime")] = True
    """Real-time scheduling (SCHED_FIFO) of the guard and of the policy, where the system permits
    it."""

    def loops(self, *, is_dual: bool, play_s: float = 0.0) -> LoopRates:
        """Return the rates of both loops, for a policy that plays each chunk for up to ``play_s``.

        At a single rate, images are only resized when they arrive. A chunk takes the newest image,
        so that they arrive at the visual rate even if chunks are slower: the image must not be old
        when it is used.
        """
        action_hz = self.action_rate if is_dual else self.rate
        if action_hz is None:
            action_hz = ACTION_HZ if is_dual else SINGLE_HZ
            if play_s > 0:
                action_hz = max(LEAST_HZ, min(action_hz, SOLVES_PER_PLAY / play_s))
        vision_hz = self.visual_rate if is_dual else max(action_hz, self.visual_rate)
        return LoopRates(action_hz=action_hz, vision_hz=vision_hz)
