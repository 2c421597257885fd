"""The requested policy, and the loaded policy with its measured times."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import NamedTuple

import numpy as np

from policy.adapters.interface import ACTION_FIELDS
from policy.contract import ACTION_DIM, QUATERNION, RATE, VELOCITY, ActionKind, Contract
from policy.engines.runner import EngineName, dummy_sample, encode_all
from policy.errors import NoChunkError, PolicyError, warned
from policy.protocol import PolicyRunner

REPETITIONS = 5
MOST_S = 0.5
"""Stop repeating after this time: one run is enough to know that a policy is slow."""


_MOST: dict[ActionKind, tuple[float, ...]] = {
    "sticks": (10.0, 10.0, 10.0, 10.0),
    "rates": (10.0, 20.0, 20.0, 20.0),
    "attitude": (10.0, math.pi, math.pi, 20.0),
    "velocity": (100.0, 100.0, 100.0, 20.0),
}
"""Larger actions are in another unit: degrees, per cent, cm/s, microseconds of a pulse."""


class SolveTimes(NamedTuple):
    """Median times by the injected clock; zero if that clock stands still."""

    encode_s: float
    """One image of each camera; without a fast path, only its resizing."""
    act_s: float
    """One chunk."""


def measure_times(runner: PolicyRunner, now_s: Callable[[], float]) -> SolveTimes | None:
    """Time a policy, by single calls if the clock stands still; None if it had no chunk."""
    contract = runner.contract
    images, state, history = dummy_sample(contract)
    encode_s: list[float] = []
    act_s: list[float] = []
    begun_s = now_s()
    while len(act_s) < REPETITIONS and (not act_s or 0 < now_s() - begun_s < MOST_S):
        before_s = now_s()
        try:
            encoded = encode_all(runner, images)
            encoded_s = now_s()
            runner.act(encoded, state, history)
        except NoChunkError:
            return None
        encode_s.append((encoded_s - before_s) / contract.observation_steps)
        act_s.append(now_s() - encoded_s)
    return SolveTimes(encode_s=median(encode_s), act_s=median(act_s))


def unit_notes(runner: PolicyRunner) -> tuple[str, ...]:
    """Return a warning if the actions for a moving vehicle cannot be in the contract's units."""
    images, state, history = dummy_sample(runner.contract)
    state[..., VELOCITY], state[..., RATE] = 2.0, 0.5
    state[..., QUATERNION] = (0.96, 0.28, 0.0, 0.0)
    try:
        chunk = runner.act(encode_all(runner, images), state, history)
    except PolicyError:
        return ()  # it need not know this state
    largest = np.abs(chunk.reshape(-1, ACTION_DIM)).max(axis=0)
    kind = runner.contract.action
    found = [
        f"{name} {value:.4g}"
        for name, value, most in zip(ACTION_FIELDS[kind], largest, _MOST[kind], strict=True)
        if value > most
    ]
    if not found:
        return ()
    told = f"its {kind} reach {', '.join(found)}, far beyond any that fly, and would be clipped"
    return (warned(f"{told}: are they in the contract's units?"),)


@dataclass(frozen=True, kw_only=True)
class PolicyRequest:
    """The requested policy, and how to run it."""

    spec: str
    """One of ``adapters.user_class.FORMS``."""
    checkpoint: Path | None = None
    """Weights; a user's class gets ``Class(checkpoint=path)``. None: ``toge`` uses shipped ones."""
    contract_file: Path | None = None
    """Contract file of a policy that was trained elsewhere, see ``adapters.interface``."""
    allow_untrained: bool = False
    """Accept seeded random weights if there is no checkpoint."""
    engine: EngineName = "auto"
    """Engine for the network; auto: the fastest that passes the parity check."""
    device: str = "cpu"
    """torch device: cpu, cuda, cuda:0, mps."""
    dual_rate: bool = True
    """A policy without a fast path becomes single-rate, with a note."""
    num_diffusion_steps: int = 10
    image_size: int | None = None
    """Height and width of the policy's images; None: the contract's."""
    seed: int = 0
    """Seed of untrained weights and of the flight's initial noise."""
    by_rates: bool = False
    """Fly a built-in network, which computes sticks, by thrust and body rates."""
    starts_in_air: bool = False
    """The vehicle is already in the air at takeover: a scripted program does not climb."""


@dataclass(frozen=True, kw_only=True)
class LoadedPolicy:
    """A policy that may fly, and notes for the user.

    As a context manager it closes the policy once, in the thread that loaded it, after the policy's
    loops have ended. A failing close never hides the error that ended the flight.
    """

    runner: PolicyRunner
    notes: tuple[str, ...]
    times: SolveTimes | None = None
    """Measured on a dummy sample; None if the policy had no chunk for it."""

    def __enter__(self) -> "LoadedPolicy":
        """Return self."""
        return self

    def __exit__(self, _kind: object, failure: BaseException | None, _traceback: object) -> None:
        """Close the policy; raise PolicyError if that fails and no earlier error is under way."""
        try:
            self.runner.close()
        except PolicyError as error:
            if failure is None:
                raise
            failure.add_note(str(error))


def default_contract(image_size: int | None) -> Contract:
    """Return the default contract, at an image size if one is given."""
    if image_size is None:
        return Contract()
    return Contract(image_height=image_size, image_width=image_size)
