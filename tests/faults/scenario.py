"""The catalogue: scenarios in TOML, each a fault and its required outcome."""

import tomllib
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, get_args

from faults.record import Receiver
from faults.stage import CATALOGUE
from faults.steps import Step, make_step
from mavbridge.core.reasons import Code
from sitl import UsageError
from sitl.vehicle.config import AutopilotName

Outcome = Literal["loses", "keeps", "either", "refused"]
"""The policy loses the sticks until the next explicit act, keeps them, does either by chance, or
never gets them."""
EXITS: dict[Outcome, list[int]] = {"loses": [4], "keeps": [0], "either": [0, 4], "refused": [2]}


@dataclass(frozen=True, kw_only=True)
class Scenario:
    """A fault, the steps to cause it, and its required outcome."""

    name: str
    group: str
    """Name of its file: link, vehicle, host, images or policy."""
    what: str
    """Description in one line."""
    steps: tuple[Step, ...]
    """The first step that returns a time is the fault."""
    before: tuple[Step, ...] = ()
    """Steps performed on the vehicle before the bridge starts."""
    outcome: Outcome
    limit_ms: float = 0.0
    """Limit from the fault until the vehicle is safe by its own record; only for ``loses``. It
    includes the time until the fault can be detected."""
    stick_limit_ms: float = 0.0
    """Limit from the fault until the policy's last stick leaves the bridge; 0: ``limit_ms``."""
    exit: list[int] = field(default_factory=list)
    """Allowed exit statuses of the flight process; a signal is negative. Empty: by the outcome."""
    code: str = ""
    """``Code`` of a reason, in the bridge's report, for which the policy lost the sticks."""
    says: str = ""
    """Text that the bridge prints if no reason tells: a warning, refusal or foreign error."""
    receivers: list[Receiver] = field(default_factory=list)
    """Empty: mid and none, and also idle if the policy loses the sticks and the bridge ends it."""
    autopilots: list[AutopilotName] = field(default_factory=lambda: ["ardupilot", "px4"])
    others_us: list[int] = field(default_factory=list)
    """Four sticks of another source that can share the vehicle with the policy until the limit."""
    is_silent: bool = False
    """True for a takeover: then no mode request, and beyond the limit no stick of any kind."""
    judges_end: bool = True
    """True if the vehicle must hold its height or land after the end, unless it was a takeover."""
    releases: bool = True
    """True if the bridge can still give an ArduPilot with a receiver its sticks back."""
    transmitter: bool = False
    """True if the pilot has a transmitter that steps can move; its switches are initially on."""
    carrier: Literal["udp", "tcp", "serial"] = "udp"
    """Link of the bridge."""
    baud: int = 115_200
    policy: str = "Leaning"
    """Name of a class in ``catalogue/policies.py``."""
    flags: list[str] = field(default_factory=list)
    """Additional flags of the bridge. ``{folder}`` is a folder for the files of this run,
    ``{viewer}`` a viewer's address for ``--rerun``."""
    environment: dict[str, str] = field(default_factory=dict)
    """Additional variables for the bridge. ``{folder}`` is a folder for the files of this run,
    ``{catalogue}`` that of the scenarios, ``{path}`` the PYTHONPATH so far."""
    untested: str = ""
    """Why the tests leave it out; empty: they fly it."""

    @property
    def exits(self) -> list[int]:
        return self.exit or EXITS[self.outcome]

    @property
    def last_stick_limit_ms(self) -> float:
        return self.stick_limit_ms or self.limit_ms

    @property
    def variants(self) -> "list[Variant]":
        """Vehicles of this scenario; PX4 has a receiver only if ``none`` is not requested."""
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
    """Vehicle of one run."""

    autopilot: AutopilotName
    receiver: Receiver

    @property
    def text(self) -> str:
        receiver = "no receiver" if self.receiver == "none" else f"receiver {self.receiver}"
        return f"{self.autopilot}, {receiver}"

    @property
    def mode(self) -> str:
        """Mode in which the policy's sticks fly."""
        return "ALT_HOLD" if self.autopilot == "ardupilot" else "ALTCTL"


def load_catalogue() -> dict[str, Scenario]:
    """Return all scenarios by name, in the order of the files; raise UsageError if invalid.

    ``[default]`` holds keys of all scenarios of its file, and ``like`` names one whose keys a
    scenario takes over. A scenario's own keys replace both.
    """
    files = sorted(CATALOGUE.glob("*.toml"))
    return {scenario.name: scenario for path in files for scenario in _read(path)}


def _read(path: Path) -> Iterator[Scenario]:
    tables = tomllib.loads(path.read_text())
    default = tables.pop("default", {})
    for name, own in tables.items():
        where = f"{path.name}: [{name}]"
        like = own.pop("like", name)
        if like not in tables or "like" in tables[like]:
            raise UsageError(f"{where}: like = {like!r} is no earlier scenario of this file")
        table = default | tables[like] | own
        for key in ("steps", "before"):
            table[key] = tuple(make_step(step, where) for step in table.get(key, []))
        try:
            scenario = Scenario(name=name, group=path.stem, **table)
        except TypeError as error:
            raise UsageError(f"{where}: {error}") from error
        if scenario.outcome not in get_args(Outcome) or scenario.code not in ("", *Code):
            raise UsageError(f"{where}: outcome {scenario.outcome}, code {scenario.code}")
        yield scenario
