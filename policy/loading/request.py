"""The policy that a user asked for, and the one that was loaded for it, with its times here."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from statistics import median

import numpy as np

from policy.contract import ACTION_DIM, Contract
from policy.engines.runner import EngineName, encode_all, level_state
from policy.errors import NoChunkError, PolicyError
from policy.preprocess import dummy_images
from policy.protocol import PolicyRunner

REPETITIONS = 5
MOST_S = 0.5
"""No further repetition after so much time: a slow policy is known to be slow after one."""


@dataclass(frozen=True, kw_only=True)
class SolveTimes:
    """Medians, by the clock that they were measured with: zero on one that stands still."""

    encode_s: float
    """One image of each camera; without a fast path that is resizing alone."""
    act_s: float
    """One chunk."""


def measure_times(runner: PolicyRunner, now_s: Callable[[], float]) -> SolveTimes | None:
    """Time a policy that was tried before; None if it had no chunk for the dummy sample.

    By a clock that stands still, as in simulations, it is asked only once.
    """
    contract = runner.contract
    images, state = dummy_images(contract), level_state(contract)
    history = np.zeros((1, contract.history_len, ACTION_DIM), np.float32)
    encode_s: list[float] = []
    act_s: list[float] = []
    begun_s = now_s()
    while len(act_s) < REPETITIONS and (not act_s or 0 < now_s() - begun_s < MOST_S):
        before_s = now_s()
        encoded = encode_all(runner, images)
        encoded_s = now_s()
        try:
            runner.act(encoded, state, history)
        except NoChunkError:
            return None
        encode_s.append((encoded_s - before_s) / contract.observation_steps)
        act_s.append(now_s() - encoded_s)
    return SolveTimes(encode_s=median(encode_s), act_s=median(act_s))


@dataclass(frozen=True, kw_only=True)
class PolicyRequest:
    """The policy that a user asked for, and how it is to run."""

    spec: str
    """One of the forms in the module's docstring."""
    checkpoint: Path | None = None
    """Weights; a user's class gets them as ``Class(checkpoint=path)``. Without any, ``toge`` takes
    the shipped ones."""
    contract_file: Path | None = None
    """What the files of a policy that was trained elsewhere do not say: ``adapters.interface``."""
    allow_untrained: bool = False
    """Accept seeded random weights where there is no checkpoint."""
    engine: EngineName = "auto"
    """Engine that runs the network; auto = the fastest that passes the parity check."""
    device: str = "cpu"
    """torch's name of where to run: cpu, cuda, cuda:0, mps."""
    vision_device: str | None = None
    """Where to encode images, if that is another one."""
    action_device: str | None = None
    """Where to sample chunks, if that is another one."""
    dual_rate: bool = True
    """A policy without a fast path is made single-rate, with a note."""
    num_diffusion_steps: int = 10
    image_size: int | None = None
    """Height and width that the policy takes; None leaves it to the contract."""
    seed: int = 0
    """Seed of untrained weights and of the flight's initial noise."""
    by_rates: bool = False
    """A network of ours that computes sticks flies by thrust and body rates."""
    starts_in_air: bool = False
    """The vehicle flies already when the policy takes over: a scripted program does not climb."""


@dataclass(frozen=True, kw_only=True)
class LoadedPolicy:
    """A policy that may fly, and notes about it for the user.

    As a context manager it closes the policy: after its loops have ended, in the thread that
    loaded it, once. A policy that fails to close never hides why the flight failed.
    """

    runner: PolicyRunner
    notes: tuple[str, ...]
    times: SolveTimes | None = None
    """Measured on a dummy sample; None where it had no chunk for that."""

    def __enter__(self) -> "LoadedPolicy":
        """Return itself."""
        return self

    def __exit__(self, _kind: object, failure: BaseException | None, _traceback: object) -> None:
        """Close the policy; raises PolicyError if that fails, unless something failed before."""
        try:
            self.runner.close()
        except PolicyError as error:
            if failure is None:
                raise
            failure.add_note(str(error))


def default_contract(image_size: int | None) -> Contract:
    """The default contract, at an image size if one is given."""
    if image_size is None:
        return Contract()
    return Contract(image_height=image_size, image_width=image_size)
