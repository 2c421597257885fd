"""``lerobot:DIR``: an ACT or DiffusionPolicy that LeRobot trained."""

from typing import TYPE_CHECKING

from policy.adapters.lerobot.plan import Plan, read_plan
from policy.errors import PolicyError
from policy.files import user_path
from policy.loading.request import PolicyRequest

if TYPE_CHECKING:
    from policy.adapters.lerobot.policy import LeRobotPolicy

LEROBOT = "lerobot"


def check_lerobot(request: PolicyRequest) -> Plan:
    """All that its folder and the contract file say, in milliseconds; the weights are not read."""
    folder = request.spec.partition(":")[2]
    if not folder or request.checkpoint is not None:
        raise PolicyError(
            f"--policy {request.spec}: name the folder of config.json and its weights, as "
            "lerobot:DIR, and leave out --checkpoint"
        )
    return read_plan(user_path(folder), request.contract_file)


def load_lerobot(request: PolicyRequest) -> tuple["LeRobotPolicy", list[str]]:
    """The policy with its weights, and notes for the user; raises as ``check_lerobot``."""
    from policy.adapters.lerobot.policy import load_policy_of

    return load_policy_of(
        check_lerobot(request),
        seed=request.seed,
        num_diffusion_steps=request.num_diffusion_steps,
    )
