"""Flies a scenario by real processes, and judges it by the vehicle's own record."""

import os
import signal
import tempfile
from contextlib import ExitStack
from pathlib import Path

from sitl.clock import Clock
from sitl.faults.record import NoVerdictError
from sitl.faults.scenario import Scenario, Variant
from sitl.faults.stage.carriers import Carrier, SerialCarrier, TcpCarrier
from sitl.faults.stage.leftovers import leftovers, thread_names
from sitl.faults.stage.processes import StageError
from sitl.faults.stage.stage import CATALOGUE, Stage, faulty_policy, free_port, staged
from sitl.faults.stage.stalls import StallWatch
from sitl.faults.stage.transmitter import Transmitter
from sitl.faults.stage.viewer import Viewer
from sitl.faults.steps.common import Terminal
from sitl.faults.verdict import Verdict, find_failures

FLY = ("--dual-rate", "--arm")
SETTLE_S = 1.0
"""After the last step: what must not come back has time to."""
END_S = 20.0
FLY_ON_S = 10.0
"""The vehicle's own flight after the end, by which the end is judged."""
MOST_STALL_MS = 30.0
"""A computer that stood still for longer during a run proves nothing about its times."""
RUNS = 3


def fly_scenario(scenario: Scenario, variant: Variant, *, slack_ms: float = 0.0) -> Verdict:
    """Fly a scenario, and judge it; on a computer that stood still meanwhile, up to ``RUNS`` times.

    Args:
        scenario: the fault.
        variant: the vehicle.
        slack_ms: added to the limits, for a computer that others use.
    """
    for run in range(1, RUNS + 1):
        verdict = _fly_once(scenario, variant, slack_ms)
        verdict.runs = run
        if verdict.passed or verdict.stall_ms <= MOST_STALL_MS:
            break
    return verdict


def _fly_once(scenario: Scenario, variant: Variant, slack_ms: float) -> Verdict:
    verdict = Verdict(scenario=scenario.name, variant=variant)
    vehicle: tuple[str, ...] = ("--autopilot", variant.autopilot, "--receiver", variant.receiver)
    vehicle += ("--fly-on", f"{FLY_ON_S:g}")
    transmitter = Transmitter(free_port(), variant.receiver) if scenario.transmitter else None
    if transmitter is not None:
        vehicle += transmitter.flags
    with tempfile.TemporaryDirectory(prefix="faults-") as name, StallWatch() as stalls:
        folder, threads = Path(name), thread_names()
        policy = faulty_policy(scenario.policy)
        try:
            with ExitStack() as stack:
                stage = stack.enter_context(
                    staged(folder, *vehicle, renders=False, carrier=_carrier(scenario))
                )
                stage.transmitter = transmitter
                flags = _equip(stage, scenario, stack)
                if scenario.before or transmitter:
                    stage.prepare = lambda: _prepare(scenario, stage)
                flags = ("--mode", variant.mode, "--policy", policy, *flags)
                is_read = not any(isinstance(step, Terminal) for step in scenario.steps)
                stage.start(*FLY, *flags, is_read=is_read)
                if scenario.outcome == "refused":
                    at_ns, leans = 0, False
                    if scenario.steps:
                        _perform(scenario, stage)
                        stage.kill_group(signal.SIGINT)
                    verdict.exit, verdict.output = stage.end()
                else:
                    at_ns = _perform(scenario, stage)
                    leans = _leans(stage)
                    _end(scenario, stage, verdict)
            verdict.failures += find_failures(verdict, scenario, stage, at_ns, leans, slack_ms)
            verdict.failures += [f"it left {rest}" for rest in leftovers(stage, threads)]
        except (StageError, NoVerdictError) as error:
            verdict.failures.append(str(error))
        verdict.stall_ms = stalls.longest_ms
    return verdict


def _carrier(scenario: Scenario) -> Carrier | None:
    match scenario.carrier:
        case "udp":
            return None
        case "tcp":
            return TcpCarrier()
        case "serial":
            return SerialCarrier(scenario.baud, Clock())


def _equip(stage: Stage, scenario: Scenario, stack: ExitStack) -> tuple[str, ...]:
    """Give a flight the variables and the viewer that it names; returns its flags."""
    path = os.environ.get("PYTHONPATH", "")
    stage.variables = {
        name: value.format(folder=stage.folder, catalogue=CATALOGUE, path=path)
        for name, value in scenario.environment.items()
    }
    if any("{viewer}" in flag for flag in scenario.flags):
        stage.viewer = stack.enter_context(Viewer())
    viewer = stage.viewer.target if stage.viewer else ""
    return tuple(flag.format(folder=stage.folder, viewer=viewer) for flag in scenario.flags)


def _prepare(scenario: Scenario, stage: Stage) -> None:
    """Bring the vehicle into the state in which the bridge shall find it."""
    if stage.transmitter is not None:
        stage.transmitter.switch_on()
    for step in scenario.before:
        step.perform(stage)


def _perform(scenario: Scenario, stage: Stage) -> int:
    """Carry the steps out; returns the moment of the fault, 0 if none of them is one."""
    if scenario.outcome != "refused":
        stage.wait_for_lean()
    moments = [step.perform(stage) for step in scenario.steps]
    stage.observe(SETTLE_S)
    return next((moment for moment in moments if moment is not None), 0)


def _leans(stage: Stage) -> bool:
    """The newest sticks are still the policy's."""
    return stage.relay.is_leaning(1)


def _end(scenario: Scenario, stage: Stage, verdict: Verdict) -> None:
    """Let everything end; a guard that holds the vehicle for want of a receiver is taken over."""
    guard = stage.guard
    stage.kill_group(signal.SIGCONT)
    verdict.ended_ns = stage.kill_group(signal.SIGINT)
    if -signal.SIGKILL in scenario.exits:
        stage.kill(signal.SIGKILL)
    if not guard.has_ended(FLY_ON_S):
        landing = "AUTO.LAND" if stage.is_px4 else "LAND"
        verdict.taken_over_ns = stage.relay.set_mode(landing)
        if not guard.has_ended(END_S):
            verdict.failures.append(f"the guard still runs {END_S:.0f} s after a takeover")
    verdict.exit, verdict.output = stage.end()
