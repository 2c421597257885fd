"""A program as a user names it, behind ``scripted:``."""

from collections.abc import Callable, Sequence
from typing import get_args

from policy.contract import ActionKind, Contract
from policy.errors import PolicyError
from policy.scripted.policy import ScriptedPolicy

IN_AIR = "air"


def make_scripted(
    options: Sequence[str], now_s: Callable[[], float], *, contract: Contract
) -> ScriptedPolicy:
    """The policy that ``[PROGRAM][:ACTION][:air]``, split at the colons, names.

    Without a program it hovers, without a kind of action it moves sticks. ``air``: it begins in the
    air, and keeps the altitude of then.
    """
    starts_in_air = options[-1:] == [IN_AIR]
    named = [*options[: len(options) - starts_in_air], "", ""]
    program, action, *rest = named[0] or "hover", named[1] or "sticks", *filter(None, named[2:])
    kind = next((kind for kind in get_args(ActionKind) if kind == action), None)
    if kind is None or rest:
        raise PolicyError(
            f"scripted:{':'.join(options)}: after the program comes one of "
            f"{', '.join(get_args(ActionKind))}, then perhaps {IN_AIR}; got {[action, *rest]}"
        )
    return ScriptedPolicy(
        program, now_s, action=kind, starts_in_air=starts_in_air, contract=contract
    )
