"""The catalogue: scenarios in TOML, each a fault with what must come of it."""

import tomllib
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from sitl import UsageError
from sitl.faults.record import Receiver
from sitl.faults.stage.carriers import CarrierName
from sitl.faults.stage.stage import CATALOGUE
from sitl.faults.steps.common import Step, make, make_step
from sitl.vehicle.config import AutopilotName

Outcome = Literal["loses", "keeps", "either", "refused"]
"""The policy loses the sticks until the next explicit act, keeps them, either of these as chance
has it, or never gets them."""
EXITS: dict[Outcome, list[int]] = {"loses": [4], "keeps": [0], "either": [0, 4], "refused": [2]}


@dataclass(frozen=True, kw_only=True)
class Scenario:
    """A fault, how to bring it about, and what must come of it."""

    name: str
    group: str
    """Its file: link, vehicle, host, images or policy."""
    what: str
    """One line for a reader."""
    steps: tuple[Step, ...]
    """The first that is more than a wait is the fault."""
    before: tuple[Step, ...] = ()
    """Carried out on the vehicle before the bridge starts."""
    outcome: Outcome
    limit_ms: float = 0.0
    """From the fault until the vehicle is safe by its own record; only for ``loses``. A fault that
    can be known only after a while has that while in it."""
    stick_limit_ms: float = 0.0
    """From the fault until the last stick of the policy leaves the bridge; 0: ``limit_ms``."""
    exit: list[int] = field(default_factory=list)
    """Allowed exit statuses of the flight process; a signal is negative. Empty: by the outcome."""
    says: str = ""
    """The bridge prints this."""
    modes: list[str] = field(default_factory=list)
    """Allowed first mode after the fault; empty: any, also none."""
    receivers: list[Receiver] = field(default_factory=list)
    """Empty: mid and none, and idle where the policy loses the sticks and the bridge ends it."""
    autopilots: list[AutopilotName] = field(default_factory=lambda: ["ardupilot", "px4"])
    others_us: list[int] = field(default_factory=list)
    """Four sticks of somebody else, who may share the vehicle with the policy until the limit."""
    is_silent: bool = False
    """A takeover: no request for a mode may follow, and beyond the limit no stick of any kind."""
    judges_end: bool = True
    """The vehicle must hold its height or land after the end, unless it was a takeover."""
    releases: bool = True
    """The bridge can still give an ArduPilot with a receiver its sticks back."""
    transmitter: bool = False
    """The pilot has one, which steps can move; its switches are on at the start."""
    carrier: CarrierName = "udp"
    """The bridge's link."""
    baud: int = 115_200
    """Bits a second of a serial port."""
    policy: str = "Leaning"
    """Class in ``catalogue/policies.py``."""
    flags: list[str] = field(default_factory=list)
    """More flags of the bridge; ``{folder}`` is a folder for the files of this run, ``{viewer}`` a
    viewer's address for ``--rerun``."""
    environment: dict[str, str] = field(default_factory=dict)
    """More variables for the bridge; ``{folder}`` as above, ``{catalogue}`` that of the scenarios,
    ``{path}`` the PYTHONPATH so far."""
    untested: str = ""
    """Why the tests leave it out; empty: they fly it."""

    @property
    def exits(self) -> list[int]:
        """Allowed exit statuses."""
        return self.exit or EXITS[self.outcome]

    @property
    def last_stick_limit_ms(self) -> float:
        """Latest last stick of the policy after the fault."""
        return self.stick_limit_ms or self.limit_ms

    @property
    def variants(self) -> "list[Variant]":
        """Vehicles that it is flown with; PX4 has a receiver only where one is wanted alone."""
        receivers: list[Receiver] = self.receivers or ["mid", "none"]
        if not self.receivers and self.outcome == "loses" and not self.is_silent:
            receivers = ["mid", "idle", "none"]
        return [
            Variant(autopilot=autopilot, receiver=receiver)
            for autopilot in self.autopilots
            for receiver in receivers
            if autopilot == "ardupilot" or receiver == "none" or "none" not in receivers
        ]


@dataclass(frozen=True, kw_only=True)
class Variant:
    """The vehicle of one run."""

    autopilot: AutopilotName
    receiver: Receiver

    @property
    def text(self) -> str:
        """For tables and messages."""
        receiver = "no receiver" if self.receiver == "none" else f"receiver {self.receiver}"
        return f"{self.autopilot}, {receiver}"

    @property
    def mode(self) -> str:
        """The mode in which the policy's sticks fly."""
        return "ALT_HOLD" if self.autopilot == "ardupilot" else "ALTCTL"


def load_catalogue(folder: Path = CATALOGUE) -> dict[str, Scenario]:
    """Every scenario by its name, in the order of the files.

    Raises:
        UsageError: a file is no TOML, or a scenario has unknown or missing keys.
    """
    return {
        scenario.name: scenario
        for path in sorted(folder.glob("*.toml"))
        for scenario in _read(path)
    }


def _read(path: Path) -> Iterator[Scenario]:
    try:
        tables: dict[str, dict[str, Any]] = tomllib.loads(path.read_text())
    except tomllib.TOMLDecodeError as error:
        raise UsageError(f"{path}: {error}") from error
    for name, table in tables.items():
        where = f"{path}: [{name}]"
        for key in ("steps", "before"):
            table[key] = tuple(make_step(step, where) for step in table.get(key, []))
        yield make(Scenario, {"name": name, "group": path.stem, **table}, where)
