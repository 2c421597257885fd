"""One long flight with a fault every few seconds, to find growth and losses."""

import json
import random
import signal
import tomllib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median
from typing import NamedTuple

from faults.processes import StageError, status_of
from faults.props import Transmitter
from faults.relay import logged_overrides
from faults.stage import ORDERLY, Stage, faulty_policy, staged
from faults.steps import Step, make_step
from mavbridge.core.reasons import Code, because
from sitl.clock import NS_PER_S

POLICY = "Wandering"
SWITCH, LOW_US, HIGH_US = 7, 1000, 2000
"""Channel of the engage switch, and its end positions."""
REST_S = 2.5
"""Time for which the switch stays low: going high counts as an act only after 1.8 s of rest."""
SETTLE_S = 1.5
"""Time from the end of a fault until the policy must have lost the sticks."""
QUIET_NS = NS_PER_S // 2
"""Last part of ``SETTLE_S``, in which no leaning stick is allowed to leave the bridge."""
LEANING_ROWS = 50
"""Consecutive messages of leaning sticks that show that the policy has the sticks."""
SETTLED = 0.3
"""Share of a soak after which everything needed has been loaded and allocated."""


class Usage(NamedTuple):
    """Memory, descriptors and threads of a process."""

    rss_mb: float
    descriptors: int
    threads: int


MOST_GROWTH = {
    "flight": Usage(rss_mb=40.0, descriptors=2, threads=0),
    "guard": Usage(rss_mb=4.0, descriptors=1, threads=0),
}
"""Growth of a process that is not yet a leak: allocators keep freed memory."""
REPORT_EVERY = 20
ENGAGE_S = 10.0
ENGAGE_TRIES = 6


class Fault(NamedTuple):
    """A fault of ``soak.toml``."""

    steps: tuple[Step, ...]
    keeps: bool


def load_faults() -> dict[str, Fault]:
    """Return the faults of a soak by name."""
    tables = tomllib.loads(Path(__file__).with_suffix(".toml").read_text())
    return {
        name: Fault(tuple(make_step(step, name) for step in table["steps"]), "keeps" in table)
        for name, table in tables.items()
    }


@dataclass(kw_only=True)
class SoakResult:
    """Counts and failures of a soak."""

    minutes: float
    faults: dict[str, int] = field(default_factory=dict)
    """Number of faults by name."""
    sent: int = 0
    """Overrides and releases that left the bridge."""
    growth: dict[str, Usage] = field(default_factory=dict)
    """Growth of the flight process and of the guard, after they had settled."""
    stalls: int = 0
    """Faults that the policy should have survived, but a busy machine took the sticks from it."""
    failures: list[str] = field(default_factory=list)


def soak(minutes: float, folder: Path, report: Callable[[str], None]) -> SoakResult:
    """Fly for some minutes, with a random fault every few seconds, always in the same order.

    ``folder`` is empty and gets the recording; ``report`` is called with a line now and then.
    """
    result = SoakResult(minutes=minutes)
    transmitter = Transmitter("mid")
    recording = folder / "recording"
    with staged(folder, "--receiver", "mid", *transmitter.flags, renders=False) as stage:
        stage.start(
            "--dual-rate", "--mode", "ALT_HOLD", "--policy", faulty_policy(POLICY),
            "--set-config", "envelope.height=0", "--set-config", "envelope.distance=0",
            "--engage-channel", str(SWITCH), "--record", str(recording),
        )  # fmt: skip
        if not stage.wait_for(str(because(Code.NOT_ENGAGED))):
            raise StageError("the bridge is not ready to engage")
        stage.guard.has_ended(0)  # finds it while its parent lives
        _engage(stage, transmitter)
        usages = _fly(stage, transmitter, result, minutes, random.Random(0), report)
        stage.kill_group(signal.SIGINT)
        stage.observe(SETTLE_S)
        stage.relay.disarm()
        stage.guard.has_ended(30.0)
        status, output = stage.end()
        result.sent += len(stage.relay.overrides)
    if status not in ORDERLY or "Traceback" in output:
        result.failures.append(f"exit status {status}:\n{output}")
    result.growth = {name: growth(samples) for name, samples in usages.items()}
    for name, grown in result.growth.items():
        most = MOST_GROWTH[name]
        if any(value > limit for value, limit in zip(grown, most, strict=True)):
            result.failures.append(f"the {name} process grew by {grown}")
    result.failures += _lost(recording, result)
    return result


def _fly(
    stage: Stage,
    transmitter: Transmitter,
    result: SoakResult,
    minutes: float,
    chance: random.Random,
    report: Callable[[str], None],
) -> dict[str, list[Usage]]:
    """Break the flight repeatedly; return the usage of both processes after each fault."""
    pids = {"flight": stage.bridge_pid, "guard": stage.guard.pid}
    usages: dict[str, list[Usage]] = {name: [] for name in pids}
    faults = list(load_faults().items())
    end_ns = stage.clock.now_ns() + round(minutes * 60 * NS_PER_S)
    while stage.clock.now_ns() < end_ns:
        name, fault = chance.choice(faults)
        result.faults[name] = result.faults.get(name, 0) + 1
        for step in fault.steps:
            step.perform(stage)
        stage.observe(SETTLE_S)
        quiet_ns = stage.clock.now_ns() - QUIET_NS
        newest = stage.relay.newest_steering(LEANING_ROWS)
        has_lost = not any(sent.leans for sent in newest if sent.at_ns > quiet_ns)
        if not fault.keeps and not has_lost:
            result.failures.append(f"{name}: the policy kept the sticks")
        if has_lost and fault.keeps:
            result.stalls += 1  # a busy machine, or a lasting loss: the flight ended in order
        result.sent += stage.relay.forget()
        if has_lost:
            _engage(stage, transmitter)
        for process, pid in pids.items():
            usages[process].append(read_usage(pid))
        if sum(result.faults.values()) % REPORT_EVERY == 0:
            held = {name: usages[name][-1] for name in pids}
            report(f"{sum(result.faults.values())} faults, {held}")
    return usages


def _engage(stage: Stage, transmitter: Transmitter) -> None:
    """Arm, and turn the switch off and on, repeatedly if the machine is busy."""
    for _ in range(ENGAGE_TRIES):
        transmitter.move(SWITCH, LOW_US)
        stage.relay.set_mode("ALT_HOLD")
        stage.relay.arm()
        stage.observe(REST_S)
        transmitter.move(SWITCH, HIGH_US)
        if stage.relay.wait_until(lambda: stage.relay.is_leaning(LEANING_ROWS), ENGAGE_S):
            return
    raise StageError(f"the policy did not get the sticks by the switch:\n{stage.output}")


def _lost(recording: Path, result: SoakResult) -> list[str]:
    """Return the gaps in the recording, in words."""
    meta = json.loads((recording / "meta.json").read_text())
    failures = [
        f"{key} is {meta[key]}"
        for key in ("ticks_dropped", "frames_dropped", "packets_dropped")
        if meta[key] != 0
    ]
    if not meta["finished"]:
        failures.append("the recording is not finished")
    logged = sum(1 for _ in logged_overrides(recording / "link.tlog"))
    if logged != result.sent:
        failures.append(f"link.tlog has {logged} of {result.sent} overrides")
    return failures


def read_usage(pid: int) -> Usage:
    status = status_of(pid)
    descriptors = sum(1 for _ in Path(f"/proc/{pid}/fd").iterdir())
    return Usage(int(status["VmRSS"].split()[0]) / 1024, descriptors, int(status["Threads"]))


def growth(samples: Sequence[Usage]) -> Usage:
    """Return the growth between the medians of the first and last third of the settled samples.

    Medians, because a sample can fall into a moment in which a file or a thread is in use.
    """
    settled = samples[round(len(samples) * SETTLED) :]
    third = max(len(settled) // 3, 1)
    first, last = zip(*settled[:third], strict=True), zip(*settled[-third:], strict=True)
    rss, *counts = (median(b) - median(a) for a, b in zip(first, last, strict=True))
    return Usage(rss, *map(round, counts))


def make_summary(result: SoakResult) -> str:
    """Return the result for a person, in a few lines."""
    lines = [f"{result.minutes:g} minutes, {result.sent} overrides and releases"]
    lines += [f"{count:5d} times {name}" for name, count in sorted(result.faults.items())]
    lines += [
        f"{name}: {grown.rss_mb:+.1f} MB, {grown.descriptors:+d} descriptors, "
        f"{grown.threads:+d} threads"
        for name, grown in result.growth.items()
    ]
    if result.stalls:
        lines.append(f"{result.stalls} times a fault to be survived ended the flight in order")
    return "\n".join([*lines, *(f"FAILED: {failure}" for failure in result.failures)])
