"""The policy that a user asked for, and the one that was loaded for it."""

from dataclasses import dataclass
from pathlib import Path

from policy.contract import Contract
from policy.engines.runner import EngineName
from policy.errors import PolicyError
from policy.loading.timing import SolveTimes
from policy.protocol import PolicyRunner


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
