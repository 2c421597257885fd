"""Judges a fault at a known time by the vehicle's report (docs/formats.md)."""

from collections.abc import Sequence
from itertools import takewhile
from typing import Literal, NamedTuple, TypedDict

Receiver = Literal["idle", "mid", "none"]
Four = tuple[int, int, int, int]
NEUTRAL_US: Four = (1500, 1500, 1500, 1500)
RECEIVER_US: dict[Receiver, Four] = {"idle": (1500, 1500, 1000, 1500), "mid": NEUTRAL_US}
"""Sticks of a receiver by its flag; a receiver ``none`` has no sticks."""
DITHER_US = 8
"""Largest movement of a channel by the bridge's echo check: two steps of 4 us."""
LANDINGS = ("LAND", "RTL", "AUTO.LAND", "AUTO.RTL")
"""Modes in which a vehicle descends autonomously."""


class StickEntry(TypedDict):
    t_s: float
    us: Four
    mode: str
    armed: bool
    failsafe: bool
    lean_deg: float
    climb_mps: float
    height_m: float


class FinalState(TypedDict):
    mode: str
    armed: bool
    landed: bool


class VehicleReport(TypedDict):
    """Keys of the report that are used to judge a fault."""

    start_ns: int
    sticks: Sequence[StickEntry]
    refused_messages: int
    crashed: bool
    armed_s: float
    impact_speed_mps: float
    max_altitude_m: float
    final: FinalState


class Aftermath(NamedTuple):
    """Reaction of the vehicle to a fault."""

    safe_ms: float
    """Time until the first entry with safe sticks or another mode."""
    final_safe_ms: float
    """Time from which all entries are safe."""
    mode: str | None
    """First mode that differs from that of the flight; None: the mode did not change."""
    mode_s: float | None
    """Time of that mode change."""
    most_lean_deg: float

    @property
    def flew_again(self) -> bool:
        """True if the policy's sticks came back."""
        return self.final_safe_ms > self.safe_ms


class Ending(NamedTuple):
    """Flight from the policy's loss of the sticks to a pilot's takeover."""

    mode: str
    """Last mode."""
    lost_m: float
    """Height lost, from the policy's loss of the sticks to the lowest point before a landing."""
    impact_mps: float
    """Speed of the hardest touchdown of the flight; 0.0: it never touched the ground again."""


class NoVerdictError(Exception):
    """The vehicle's record lacks data that a verdict needs."""


def aftermath(
    report: VehicleReport,
    at_ns: int,
    receiver: Receiver,
    mode: str = "ALT_HOLD",
    others_us: tuple[int, ...] = (),
) -> Aftermath:
    """Read the sticks of a vehicle that flew in ``mode`` under the policy at ``at_ns``.

    ``others_us`` are four sticks of another source, which count as safe, too.

    Raises:
        NoVerdictError: it did not fly then, or was never safe afterwards.
    """
    how = (receiver, mode, others_us)
    fault_s = (at_ns - report["start_ns"]) / 1e9
    entries = [entry for entry in report["sticks"] if entry["t_s"] >= fault_s]
    before = [entry for entry in report["sticks"] if entry["t_s"] < fault_s][-1:]
    if not before or is_safe(before[0], *how):
        raise NoVerdictError(f"the policy does not fly at {fault_s:.3f} s: {before}")
    first = last = None
    for previous, entry in zip([*before, *entries], entries, strict=False):
        if is_safe(entry, *how) and not is_safe(previous, *how):
            first, last = first or entry["t_s"], entry["t_s"]
    if first is None or last is None:
        raise NoVerdictError("the vehicle was never safe after the fault")
    if not is_safe(entries[-1], *how):
        raise NoVerdictError(f"the vehicle is not safe at the end: {entries[-1]}")
    changed = next((entry for entry in entries if entry["mode"] != mode), None)
    return Aftermath(
        safe_ms=(first - fault_s) * 1e3,
        final_safe_ms=(last - fault_s) * 1e3,
        mode=changed["mode"] if changed else None,
        mode_s=changed["t_s"] - fault_s if changed else None,
        most_lean_deg=max(entry["lean_deg"] for entry in entries),
    )


def ending(report: VehicleReport, since_s: float, until_s: float) -> Ending:
    """Read the end of a flight between two times on the report's clock."""
    entries = [entry for entry in report["sticks"] if since_s <= entry["t_s"] < until_s]
    held = list(takewhile(lambda entry: entry["mode"] not in LANDINGS, entries))
    heights_m = [entry["height_m"] for entry in held] or [0.0]
    return Ending(
        mode=entries[-1]["mode"] if entries else report["final"]["mode"],
        lost_m=heights_m[0] - min(heights_m),
        impact_mps=report["impact_speed_mps"],
    )


def is_safe(
    entry: StickEntry, receiver: Receiver, mode: str, others_us: tuple[int, ...] = ()
) -> bool:
    """True for neutral sticks, the receiver's or another's, another mode, or disarmed."""
    allowed = {NEUTRAL_US, RECEIVER_US.get(receiver, NEUTRAL_US), others_us or NEUTRAL_US}
    is_stick = any(
        all(abs(a - b) <= DITHER_US for a, b in zip(entry["us"], us, strict=True)) for us in allowed
    )
    return is_stick or entry["mode"] != mode or not entry["armed"]
