"""Judges a flown scenario by the vehicle's own record and the bridge's messages."""

import re
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field

from faults.record import Aftermath, Ending, VehicleReport, aftermath, ending
from faults.relay import Sent
from faults.scenario import Scenario, Variant
from faults.stage import Stage
from mavbridge.core.errors import ExitCode

MOST_IMPACT_MPS = 1.0
"""Both firmwares touch down at 0.5 to 0.7 m/s (LAND_SPEED, MPC_LAND_SPEED)."""
MOST_LOST_M = 2.0
"""BRAKE stops within 1.8 m from 2.5 m/s of descent."""


@dataclass(kw_only=True)
class Verdict:
    """Measurements and failures of a run."""

    scenario: str
    variant: Variant
    aftermath: Aftermath | None = None
    """Only of a flight that lost its sticks."""
    last_stick_ms: float | None = None
    """Time from the fault to the policy's last steering message that left; negative: before it."""
    ended_ns: int = 0
    """Time at which everything was told to end, CLOCK_MONOTONIC; 0: before it flew."""
    taken_over_ns: int | None = None
    """Time at which a pilot ended the bridge's hold of the vehicle."""
    ending: Ending | None = None
    """Only of a flight that the bridge ended."""
    exit: int | None = None
    runs: int = 1
    """Number of flights up to this one."""
    stall_ms: float = 0.0
    """Longest stall of this computer."""
    late: list[str] = field(default_factory=list)
    """Failures that a busy computer can cause."""
    wrong: list[str] = field(default_factory=list)
    """Failures that a busy computer cannot cause."""
    output: str = ""

    @property
    def failures(self) -> list[str]:
        return [*self.wrong, *self.late]

    @property
    def passed(self) -> bool:
        return not self.failures


def judge(
    verdict: Verdict, scenario: Scenario, stage: Stage, at_ns: int, leans: bool, slack_ms: float
) -> None:
    """Fill in the measurements and the failures of a verdict.

    ``stage`` has ended, and the vehicle has written its report. ``at_ns`` is the time of the fault,
    CLOCK_MONOTONIC. ``leans``: the newest sticks were the policy's when the steps were over. Raise
    NoVerdictError if the vehicle did not fly at the fault, or was never safe after it.
    """
    report, sent = stage.vehicle_report(), stage.relay.sent
    verdict.wrong += _wrong(verdict, report, sent)
    verdict.late += _other(verdict, scenario, stage)
    if scenario.outcome == "refused":
        if report["armed_s"] > 0 or any(row.leans for row in sent):
            verdict.late.append("it flew")
        return
    if scenario.outcome == "keeps" and not leans:
        verdict.late.append("the policy has lost the sticks")
    safe_ms = 0.0
    if scenario.outcome == "loses":
        safe_ms = _judge_loss(verdict, scenario, stage, report, at_ns, slack_ms)
    if scenario.judges_end and not scenario.is_silent:
        is_loss = scenario.outcome == "loses"
        since_ns = at_ns + round(safe_ms * 1e6) if is_loss else verdict.ended_ns
        until_ns = verdict.taken_over_ns or sys.maxsize
        start_ns = report["start_ns"]
        end = ending(report, (since_ns - start_ns) / 1e9, (until_ns - start_ns) / 1e9)
        verdict.ending = end
        if end.impact_mps > MOST_IMPACT_MPS:
            verdict.late.append(f"it hit the ground at {end.impact_mps:.1f} m/s, in {end.mode}")
        if end.lost_m > MOST_LOST_M:
            verdict.late.append(f"it lost {end.lost_m:.1f} m of height, in {end.mode}")


def _wrong(verdict: Verdict, report: VehicleReport, sent: list[Sent]) -> Iterator[str]:
    if "Traceback" in verdict.output:
        yield "it prints a traceback"
    outcome = re.search(r"^\s*ended by a signal", verdict.output, re.M)
    if verdict.exit == ExitCode.FAULT and outcome is not None:
        yield "it ended by a fault, and blames a signal"
    if "the guard process has died" in verdict.output and ", now armed in" in verdict.output:
        yield "it claims to know the mode without a guard"
    if report["refused_messages"]:
        yield f"the vehicle refused {report['refused_messages']} messages"
    if wild := [row.message for row in sent if not row.is_within_limits]:
        yield f"{len(wild)} sticks outside their limits, such as {wild[0]}"


def _other(verdict: Verdict, scenario: Scenario, stage: Stage) -> Iterator[str]:
    if verdict.exit not in scenario.exits:
        yield f"exit status {verdict.exit}, not {scenario.exits}"
    if scenario.says not in verdict.output:
        yield f"it does not say {scenario.says!r}"
    if scenario.code and scenario.code not in (codes := stage.release_codes()):
        yield f"its reasons are {sorted(codes)}, not {scenario.code}"


def _judge_loss(
    verdict: Verdict,
    scenario: Scenario,
    stage: Stage,
    report: VehicleReport,
    at_ns: int,
    slack_ms: float,
) -> float:
    """Judge how the policy lost the sticks; return when the vehicle was safe [ms]."""
    variant, sent, late = verdict.variant, stage.relay.sent, verdict.late
    others = tuple(scenario.others_us)
    measured = aftermath(report, at_ns, variant.receiver, variant.mode, others)
    policys = [row.at_ns for row in sent if (row.holds if scenario.is_silent else row.leans)]
    last_ms = (policys[-1] - at_ns) / 1e6
    verdict.aftermath, verdict.last_stick_ms = measured, last_ms
    if scenario.is_silent and any(row.asks_mode and row.at_ns > at_ns for row in sent):
        late.append("it asks for a mode after a takeover")
    safe_ms = measured.final_safe_ms if others else measured.safe_ms
    if safe_ms > scenario.limit_ms + slack_ms:
        late.append(f"safe after {safe_ms:.0f} ms, not {scenario.limit_ms:.0f}")
    if last_ms > scenario.last_stick_limit_ms + slack_ms:
        limit_ms = scenario.last_stick_limit_ms
        late.append(f"last stick of the policy after {last_ms:.0f} ms, not {limit_ms:.0f}")
    if measured.flew_again and not others:
        verdict.wrong.append(f"the policy flew again, until {measured.final_safe_ms:.0f} ms")
    has_release = variant.autopilot == "ardupilot" and variant.receiver != "none"
    if has_release and scenario.releases and any(stage.relay.overrides[-1]):
        late.append(f"the last sticks are no release: {stage.relay.overrides[-1]}")
    return measured.safe_ms
