"""Judges a flown scenario by the vehicle's own record and by what left the bridge."""

import sys
from dataclasses import dataclass, field

from sitl.faults.record import Aftermath, Ending, VehicleReport, aftermath, ending
from sitl.faults.scenario import Scenario, Variant
from sitl.faults.stage.relay import Sent
from sitl.faults.stage.stage import Stage

MOST_IMPACT_MPS = 1.0
"""Both firmwares touch down at 0.5 to 0.7 m/s (LAND_SPEED, MPC_LAND_SPEED)."""
MOST_LOST_M = 2.0
"""BRAKE stops within 1.8 m from 2.5 m/s of descent."""


@dataclass(kw_only=True)
class Verdict:
    """What a run has shown."""

    scenario: str
    variant: Variant
    aftermath: Aftermath | None = None
    """Only of a flight that lost its sticks."""
    last_stick_ms: float | None = None
    """From the fault to the last steering message of the policy that left the bridge; negative:
    before it."""
    ended_ns: int = 0
    """When everything was told to end, CLOCK_MONOTONIC; 0: before it flew."""
    taken_over_ns: int | None = None
    """When a pilot ended the bridge's holding of the vehicle."""
    ending: Ending | None = None
    """Only of a flight whose end is the bridge's doing."""
    exit: int | None = None
    runs: int = 1
    """Flights until this one."""
    stall_ms: float = 0.0
    """Longest time for which this computer stood still."""
    failures: list[str] = field(default_factory=list)
    output: str = ""

    @property
    def passed(self) -> bool:
        """Everything was as it must be."""
        return not self.failures


def find_failures(
    verdict: Verdict, scenario: Scenario, stage: Stage, at_ns: int, leans: bool, slack_ms: float
) -> list[str]:
    """Whatever was not as it must be; fills the measurements of the verdict in.

    Args:
        verdict: with exit status and output.
        scenario: what must come of it.
        stage: after its end, when the vehicle has written its report.
        at_ns: when the fault began, CLOCK_MONOTONIC.
        leans: whether the newest sticks were the policy's when the steps were over.
        slack_ms: added to the limits.

    Raises:
        NoVerdictError: the vehicle did not fly at the fault, or was never safe after it.
    """
    report, sent = stage.vehicle_report(), stage.relay.sent
    failures = [*_wrong_words(verdict, scenario), *_wrong_messages(report, sent)]
    if scenario.outcome == "refused":
        if report["armed_s"] > 0 or any(row.leans for row in sent):
            failures.append("it flew")
    elif scenario.outcome in ("keeps", "either"):
        if not leans and scenario.outcome == "keeps":
            failures.append("the policy has lost the sticks")
    else:
        variant = verdict.variant
        others = tuple(scenario.others_us)
        measured = aftermath(report, at_ns, variant.receiver, variant.mode, others)
        verdict.aftermath = measured
        policys = [row.at_ns for row in sent if (row.holds if scenario.is_silent else row.leans)]
        verdict.last_stick_ms = (policys[-1] - at_ns) / 1e6
        if scenario.is_silent and any(row.asks_mode and row.at_ns > at_ns for row in sent):
            failures.append("it asks for a mode after a takeover")
        failures += _too_late(measured, verdict.last_stick_ms, scenario, slack_ms)
        has_release = variant.autopilot == "ardupilot" and variant.receiver != "none"
        if has_release and scenario.releases and any(stage.relay.overrides[-1]):
            failures.append(f"the last sticks are no release: {stage.relay.overrides[-1]}")
    if scenario.outcome != "refused" and scenario.judges_end and not scenario.is_silent:
        safe_ns = at_ns + round((verdict.aftermath.safe_ms if verdict.aftermath else 0.0) * 1e6)
        since_ns = safe_ns if verdict.aftermath else verdict.ended_ns
        until_ns = verdict.taken_over_ns or sys.maxsize
        verdict.ending = ending(
            report,
            since_s=(since_ns - report["start_ns"]) / 1e9,
            until_s=(until_ns - report["start_ns"]) / 1e9,
        )
        failures += _bad_end(verdict.ending)
    return failures


def _bad_end(end: Ending) -> list[str]:
    failures = []
    if end.impact_mps > MOST_IMPACT_MPS:
        failures.append(f"it hit the ground at {end.impact_mps:.1f} m/s, in {end.mode}")
    if end.lost_m > MOST_LOST_M:
        failures.append(f"it lost {end.lost_m:.1f} m of height, in {end.mode}")
    return failures


def _wrong_words(verdict: Verdict, scenario: Scenario) -> list[str]:
    failures = []
    if verdict.exit not in scenario.exits:
        failures.append(f"exit status {verdict.exit}, not {scenario.exits}")
    if scenario.says not in verdict.output:
        failures.append(f"it does not say {scenario.says!r}")
    if "Traceback" in verdict.output:
        failures.append("it prints a traceback")
    return failures


def _wrong_messages(report: VehicleReport, sent: list[Sent]) -> list[str]:
    failures = []
    if report["refused_messages"]:
        failures.append(f"the vehicle refused {report['refused_messages']} messages")
    if wild := [row.message for row in sent if not row.is_within_limits]:
        failures.append(f"{len(wild)} sticks outside their limits, such as {wild[0]}")
    return failures


def _too_late(
    measured: Aftermath, last_stick_ms: float, scenario: Scenario, slack_ms: float
) -> list[str]:
    failures = []
    safe_ms = measured.final_safe_ms if scenario.others_us else measured.safe_ms
    if safe_ms > scenario.limit_ms + slack_ms:
        failures.append(f"safe after {safe_ms:.0f} ms, not {scenario.limit_ms:.0f}")
    if last_stick_ms > scenario.last_stick_limit_ms + slack_ms:
        limit_ms = scenario.last_stick_limit_ms
        failures.append(
            f"last stick of the policy after {last_stick_ms:.0f} ms, not {limit_ms:.0f}"
        )
    if measured.flew_again and not scenario.others_us:
        failures.append(f"the policy flew again, until {measured.final_safe_ms:.0f} ms")
    if scenario.modes and measured.mode not in scenario.modes:
        failures.append(f"mode {measured.mode}, not {' or '.join(scenario.modes)}")
    return failures
