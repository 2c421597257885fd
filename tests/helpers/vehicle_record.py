"""What the vehicle's report (docs/formats/flight_report.md) says of a fault at a known time."""

import json
import os
from pathlib import Path
from typing import Any, NamedTuple

RECEIVER_US = {"idle": (1500, 1500, 1000, 1500), "mid": (1500, 1500, 1500, 1500), "none": None}
NEUTRAL_US = (1500, 1500, 1500, 1500)
NUDGE_US = 4
"""Steps of one channel by which the link finds out whether the vehicle still hears it."""
TABLE = "MAVBRIDGE_FAULT_TABLE"
"""Environment variable: a file to which each measurement is appended, a JSON object a line."""


class Aftermath(NamedTuple):
    """What happened to the vehicle after a fault."""

    safe_ms: float
    """Until the first entry with safe sticks or another mode."""
    final_safe_ms: float
    """The same, but from then on all entries are safe."""
    mode: str | None
    """The first other mode than that of the flight; None: it stayed."""
    mode_s: float | None
    most_lean_deg: float

    @property
    def flew_again(self) -> bool:
        return self.final_safe_ms > self.safe_ms


def aftermath(report: Any, at_ns: int, receiver: str, mode: str = "ALT_HOLD") -> Aftermath:
    """Read the sticks of a vehicle that flew under the policy at ``at_ns``."""
    fault_s = (at_ns - report["start_ns"]) / 1e9
    entries = [entry for entry in report["sticks"] if entry["t_s"] >= fault_s]
    before = [entry for entry in report["sticks"] if entry["t_s"] < fault_s][-1]
    assert not is_safe(before, receiver, mode), f"the policy does not fly at {fault_s} s: {before}"
    first = last = None
    for previous, entry in zip([before, *entries], entries, strict=False):
        if is_safe(entry, receiver, mode) and not is_safe(previous, receiver, mode):
            first, last = first or entry["t_s"], entry["t_s"]
    assert first is not None, "never safe"
    assert last is not None
    assert is_safe(entries[-1], receiver, mode), f"not safe at the end: {entries[-1]}"
    changed = next((entry for entry in entries if entry["mode"] != mode), None)
    return Aftermath(
        safe_ms=(first - fault_s) * 1e3,
        final_safe_ms=(last - fault_s) * 1e3,
        mode=changed["mode"] if changed else None,
        mode_s=changed["t_s"] - fault_s if changed else None,
        most_lean_deg=max(entry["lean_deg"] for entry in entries),
    )


def is_safe(entry: Any, receiver: str, mode: str) -> bool:
    """Neutral sticks, the receiver's, or out of the mode of the flight."""
    allowed = [NEUTRAL_US, RECEIVER_US[receiver]]
    is_stick = any(
        all(abs(a - b) <= NUDGE_US for a, b in zip(entry["us"], us, strict=True))
        for us in allowed
        if us is not None
    )
    return is_stick or entry["mode"] != mode or not entry["armed"]


def note(fault: str, receiver: str, measured: Aftermath, **more: object) -> None:
    """Print a measurement, and append it to the file that ``TABLE`` names."""
    row = {"fault": fault, "receiver": receiver, **measured._asdict()}
    row |= {"flew_again": measured.flew_again, **more}
    write_row(row)


def write_row(row: dict[str, object]) -> None:
    text = json.dumps(row)
    print(text)
    if TABLE in os.environ:
        with Path(os.environ[TABLE]).open("a") as file:
            file.write(text + "\n")
