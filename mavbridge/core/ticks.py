"""The guard's report of one step. No arrays, so importing needs no numpy."""

from dataclasses import dataclass

from mavbridge.core.reasons import Reason
from mavbridge.core.vehicle import Action, ActionTrace, FlightEnd


@dataclass(frozen=True, slots=True, kw_only=True)
class GuardTick:
    """One send of the guard, or one slot without anything to send."""

    serial: int = 0
    """Number among all ticks of the flight. A gap is a tick that a reader could not take."""
    index: int
    """Number of the slot on the stick grid; -1 between slots."""
    is_slot: bool = True
    """True: sent in a slot of the stick grid. False: sent between two slots, for a new chunk."""
    due_ns: int
    woke_ns: int
    decided_ns: int | None = None
    """Time for which the action was computed: the slot, or the arrival of a chunk between two
    slots. None in old records."""
    sent_ns: int
    """Time at which the datagram had been handed to the kernel."""
    missed_slots: int
    """Missed slots of the stick grid since the last report."""
    is_coasting: bool = False
    """True if the chunk was stale and flown only for the grace period."""
    chunk_serial: int | None = None
    """Number of the chunk that was flown; None if none was."""
    trace: ActionTrace | None
    sent: Action | None
    """The action as sent, rounded by the message; None if released, read-only or refused."""
    phase: str
    """A ``guard.values.Phase``."""
    release_reason: Reason | None
    """Why the policy does not fly; None while it does, or if the guard has not said why."""
    starting_ns: int = 0
    """Time since which only the policy's first chunk is missing: it gets control with the first
    chunk that follows a reset at or after this time; 0: not starting. Not recorded."""
    end: FlightEnd | None = None
    """How the policy's last flight ended; None during a flight and before the first. Not
    recorded."""
