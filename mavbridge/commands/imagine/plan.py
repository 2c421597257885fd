"""What a rollout is asked to do, and the seeds that follow from it."""

from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from mavbridge.core.errors import UserError

MAX_SEED = 2**63 - 1
"""What torch's generators take."""


class Stage(IntEnum):
    """Who draws noise in an iteration. A number here is part of every seed: never renumber."""

    DECIDE = 0
    SIMULATE = 1


@dataclass(frozen=True, kw_only=True)
class RolloutPlan:
    """One rollout.

    Raises:
        UserError: more steps are to be executed than are imagined.
    """

    iterations: int
    frames: int
    """Of each iteration's imagined frames, how many are shown: the first ones."""
    exe_steps: int
    """Of its actions, how many are executed before the next decision."""
    ddim_steps: int
    seed: int

    def __post_init__(self) -> None:
        """Refuse a plan that no iteration can keep."""
        if self.exe_steps > self.frames:
            raise UserError(
                f"--exe-steps {self.exe_steps} is more than --frames {self.frames}: only frames "
                "that are imagined can be gone through; lower the one or raise the other"
            )

    def stage_seed(self, iteration: int, stage: Stage) -> int:
        """Seed of one stage of one iteration of this rollout: independent of all others."""
        sequence = np.random.SeedSequence([self.seed, iteration, int(stage)])
        return int(sequence.generate_state(1, np.uint64)[0]) & MAX_SEED
