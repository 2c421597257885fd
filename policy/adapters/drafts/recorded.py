"""What flights say of a policy that is trained on them: under which terms its sticks flew."""

import json
from collections.abc import Mapping, Sequence
from typing import Any

from policy.adapters.drafts.entries import Entry, Origin
from policy.adapters.interface import UNANSWERED
from policy.contract import ENVELOPE_TERMS, Contract

_STICKS = (
    *("modes", "full_lean_deg", "full_yaw_rate_degps", "full_climb_mps", "full_descent_mps"),
    *("lean_dead_zone", "yaw_dead_zone", "throttle_dead_zone"),
)
"""What full sticks did, and in which modes: written into every draft."""
_LIMITS = (
    *("max_state_age_s", "max_velocity_age_s", "max_feature_age_s", "max_chunk_age_s"),
    *("max_stall_s", *ENVELOPE_TERMS),
)
"""Written where the flights had others than the usual ones."""


def recorded_entries(contracts: Sequence[Mapping[str, Any]]) -> list[Entry]:
    """The terms that all flights share; what they differ in is asked of the user.

    ``contracts`` are those of the flights' ``meta.json``; entries that an older one lacks have the
    default.
    """
    usual = json.loads(Contract().to_json())
    entries = []
    for name in (*_STICKS, *_LIMITS):
        found = {json.dumps(each.get(name, usual[name])) for each in contracts}
        values = [json.loads(value) for value in sorted(found)]
        if len(values) > 1:
            why = f"the flights were flown with different ones: {', '.join(sorted(found))}"
            entries.append(_entry(name, UNANSWERED, why))
        elif name in _STICKS or values not in ([], [usual[name]]):
            value = values[0] if values else usual[name]
            entries.append(_entry(name, value, "as the flights were flown"))
    return entries


def _entry(name: str, value: Any, why: str) -> Entry:
    origin: Origin = "to answer" if value == UNANSWERED else "read"
    return Entry(table="contract", name=name, value=value, origin=origin, why=why)
