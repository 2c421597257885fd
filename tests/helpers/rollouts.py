"""A small and fast world model, flights to start from, and rollouts of both."""

import threading
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from helpers.factories import START_NS, TICK_NS, make_state, make_tick, make_vision_tick
from helpers.recordings import count_frames, write_recording
from mavbridge.commands.imagine import SCHEMA, StreamedOutput
from mavbridge.commands.imagine_rollout import (
    Decider,
    PolicyDecider,
    RolloutPlan,
    RolloutStart,
    Sampler,
    Segment,
    WorldModelDecider,
    rollout,
)
from mavbridge.core.clock import NS_PER_S
from mavbridge.core.records import FloatArray, ImageArray, Tick, VisionTick
from mavbridge.core.vehicle import Sticks
from mavbridge.recording.folder import FlightMeta
from mavbridge.simulation.clock import SteppedClock
from policy.contract import Contract
from policy.data.tables import read_table
from policy.nets.world_model.config import WorldModelConfig
from policy.nets.world_model.model import WorldModel
from policy.protocol import PolicyRunner

SIZE = 32
TINY = WorldModelConfig(
    image_size=SIZE,
    latent_channels=4,
    autoencoder_widths=(4, 4, 4),
    dynamics_width=32,
    dynamics_depth=1,
)


class TinyWorld(WorldModel):
    """Real world model with random weights that records the decoded frames and their threads."""

    def __init__(self, config: WorldModelConfig = TINY) -> None:
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(0)
            super().__init__(config)
            for weights in self.parameters():  # a new net outputs almost zero
                weights.data += 0.1 * torch.randn(weights.shape)
        self.eval()
        self.decoded: list[tuple[str, int]] = []
        """Thread and number of frames of every call."""

    def decode(self, latents: Tensor) -> Tensor:
        self.decoded.append((threading.current_thread().name, len(latents)))
        return super().decode(latents)

    @property
    def frames_decoded(self) -> int:
        return sum(count for _, count in self.decoded)


def noise_runner(contract: Contract | None = None) -> PolicyRunner:
    """Return a policy whose sticks depend on every pixel, the state and the history."""
    contract = contract or Contract(feature_dim=1, arrays="numpy")

    def encode(rgb: ImageArray, camera: int = 0) -> FloatArray:
        return np.array([[rgb.astype(np.int64).sum() % 9973]], np.float32)

    def act(feature: FloatArray, state: FloatArray, history: FloatArray) -> FloatArray:
        assert state.shape == (1, contract.state_dim)
        assert history.shape == (1, contract.history_len, 4)
        phase = feature[0, 0] + state.sum() + history.sum()
        steps = np.arange(contract.horizon)[:, None] + np.arange(4)
        return 0.8 * np.sin(phase + steps)[None].astype(np.float32)

    return PolicyRunner(
        contract=contract, name="noise", engine="numpy", dual_rate=True, encode=encode, act=act
    )


def make_start() -> RolloutStart:
    random = np.random.default_rng(0)
    shape = (TINY.context_frames, TINY.image_size, TINY.image_size, 3)
    return RolloutStart(
        images=random.integers(0, 255, shape).astype(np.uint8),
        states=np.stack([make_state().values] * TINY.context_frames),
        newest_ns=START_NS,
        sent=((START_NS - NS_PER_S, Sticks(0.1, 0.2, 0.3, 0.4)),),
    )


def make_plan(**changes: int) -> RolloutPlan:
    plan = RolloutPlan(iterations=3, frames=16, exe_steps=1, seed=7)
    return replace(plan, **changes)


def make_decider(name: str, sampler: Sampler) -> Decider:
    if name == "toge":
        return PolicyDecider(noise_runner(), sampler, SteppedClock(START_NS))
    return WorldModelDecider(sampler, from_pixels="pixels" in name)


def make_sampler(model: WorldModel | None = None) -> Sampler:
    return Sampler(model or TinyWorld(), ddim_steps=1)


@dataclass(frozen=True)
class Finished:
    sha256: str
    model: TinyWorld
    output: StreamedOutput


def run(
    out: Path,
    plan: RolloutPlan,
    *,
    decider: str = "world-model",
    decode_video: bool = True,
    model: TinyWorld | None = None,
) -> Finished:
    model = model or TinyWorld()
    sampler = make_sampler(model)
    output = StreamedOutput(out, sampler, plan, decode_video=decode_video)
    with closing(output):
        for segment in segments(sampler, plan, decider):
            output.put(segment)
        output.finish()
    return Finished(output.sha256, model, output)


def read_rows(out: Path) -> Any:
    """Rows of a rollout, finished or cut off: as many as its video has frames."""
    table = read_table(out, SCHEMA)
    return table.slice(0, count_frames(out)) if out.exists() else table


def segments(sampler: Sampler, plan: RolloutPlan, decider: str) -> Iterator[Segment]:
    return rollout(sampler, make_decider(decider, sampler), make_start(), plan)


def write_flight(
    folder: Path,
    *,
    ticks: bool = True,
    frames: bool = True,
    meta: FlightMeta | None = None,
    refused: range = range(0),
) -> Path:
    """Write a second of a flight: frame k is ``grey(k)``, tick j has velocity x = j / 100."""
    events = [*map(_tick, range(100 * ticks)), *map(_frame, range(30 * frames))]
    for index in refused:
        events[index] = replace(events[index], sent=None)
    return write_recording(folder, events, meta=meta)


def _tick(index: int) -> Tick:
    at_ns = START_NS + index * TICK_NS
    values = make_state().values.copy()
    values[0] = index / 100
    sticks = Sticks(throttle=0.0, yaw=index / 1000, pitch=0.0, roll=0.0)
    return make_tick(index, state=make_state(at_ns, values=values), sent=sticks, sent_ns=at_ns)


def _frame(index: int) -> VisionTick:
    rgb = np.full((48, 64, 3), grey(index), np.uint8)
    captured_ns = START_NS + round(index / 30 * NS_PER_S)
    return make_vision_tick(index + 1, captured_ns=captured_ns, rgb=rgb)


def grey(frame: int) -> int:
    return 20 + 7 * (frame % 30)
