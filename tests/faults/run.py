"""Flies a scenario with real processes, and judges it by the vehicle's own record."""

import os
import signal
import tempfile
from contextlib import ExitStack
from pathlib import Path

from faults.link import Carrier, SerialCarrier, TcpCarrier
from faults.processes import StageError, leaks, thread_names
from faults.props import StallWatch, Transmitter, Viewer
from faults.record import NoVerdictError
from faults.scenario import Scenario, Variant
from faults.stage import CATALOGUE, Stage, faulty_policy, staged
from faults.verdict import Verdict, judge
from sitl.clock import Clock

FLY = ("--dual-rate", "--arm")
SETTLE_S = 1.0
"""Time after the last step in which nothing must come back."""
END_S = 20.0
FLY_ON_S = 10.0
"""Time of the vehicle's own flight after the end, by which the end is judged, and of the guard's
hold before a pilot takes over."""
MOST_STALL_MS = 30.0
"""A longer stall of the computer during a run invalidates the run's times."""
RUNS = 3


def fly_scenario(
    scenario: Scenario, variant: Variant, *, slack_ms: float = 0.0, fly_on_s: float = FLY_ON_S
) -> Verdict:
    """Fly and judge a scenario; up to ``RUNS`` times if the computer stalls meanwhile.

    ``slack_ms`` is added to the limits, for a computer shared with others.
    """
    for run in range(1, RUNS + 1):
        verdict = Verdict(scenario=scenario.name, variant=variant, runs=run)
        with tempfile.TemporaryDirectory(prefix="faults-") as name, StallWatch() as stalls:
            try:
                _fly_once(scenario, verdict, Path(name), slack_ms, fly_on_s)
            except (StageError, NoVerdictError) as error:
                verdict.late.append(str(error))
            verdict.stall_ms = max(verdict.stall_ms, stalls.longest_ms)
        if verdict.passed or verdict.stall_ms <= MOST_STALL_MS:
            break
    return verdict


def _fly_once(
    scenario: Scenario, verdict: Verdict, folder: Path, slack_ms: float, fly_on_s: float
) -> None:
    variant, threads = verdict.variant, thread_names()
    vehicle = ["--autopilot", variant.autopilot, "--receiver", variant.receiver]
    vehicle += ["--fly-on", f"{fly_on_s:g}"]
    transmitter = Transmitter(variant.receiver) if scenario.transmitter else None
    if transmitter is not None:
        vehicle += transmitter.flags
    at_ns, leans = 0, False
    with ExitStack() as stack:
        carrier = _carrier(scenario)
        stage = stack.enter_context(staged(folder, *vehicle, renders=False, carrier=carrier))
        stage.transmitter = transmitter
        flags = _equip(stage, scenario, stack)
        if scenario.before or transmitter:
            stage.prepare = lambda: _prepare(scenario, stage)
        flags = ("--mode", variant.mode, "--policy", faulty_policy(scenario.policy), *flags)
        is_read = not any(step.do == "terminal" for step in scenario.steps)
        stage.start(*FLY, *flags, is_read=is_read)
        if scenario.outcome != "refused":
            at_ns = _perform(scenario, stage)
            leans = stage.relay.is_leaning(1)
            _end(scenario, stage, verdict, fly_on_s)
        elif scenario.steps:
            _perform(scenario, stage)
            stage.kill_group(signal.SIGINT)
        verdict.exit, verdict.output = stage.end()
    verdict.stall_ms = stage.relay.longest_silence_ms
    judge(verdict, scenario, stage, at_ns, leans, slack_ms)
    left = leaks(stage.processes, stage.memory, stage.temporary, threads)
    verdict.late += [f"it left {rest}" for rest in left]


def _carrier(scenario: Scenario) -> Carrier | None:
    if scenario.carrier == "udp":
        return None
    return TcpCarrier() if scenario.carrier == "tcp" else SerialCarrier(scenario.baud, Clock())


def _equip(stage: Stage, scenario: Scenario, stack: ExitStack) -> tuple[str, ...]:
    """Give a flight the variables and the viewer that it requires; return its flags."""
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
    """Bring the vehicle into its state before the start of the bridge."""
    if stage.transmitter is not None:
        stage.transmitter.switch_on()
    for step in scenario.before:
        step.perform(stage)


def _perform(scenario: Scenario, stage: Stage) -> int:
    """Run the steps. Return the time of the first fault [ns], 0 if there was none."""
    if scenario.outcome != "refused":
        stage.wait_for_lean()
    moments = [step.perform(stage) for step in scenario.steps]
    stage.observe(SETTLE_S)
    return next((moment for moment in moments if moment is not None), 0)


def _end(scenario: Scenario, stage: Stage, verdict: Verdict, hold_s: float) -> None:
    """End everything; take over from a guard that holds the vehicle for lack of a receiver."""
    guard = stage.guard
    stage.kill_group(signal.SIGCONT)
    verdict.ended_ns = stage.kill_group(signal.SIGINT)
    if -signal.SIGKILL in scenario.exits:
        stage.kill(signal.SIGKILL)
    if not guard.has_ended(hold_s):
        verdict.taken_over_ns = stage.relay.set_mode("POSCTL" if stage.is_px4 else "LOITER")
        if not guard.has_ended(END_S):
            verdict.wrong.append(f"the guard still runs {END_S:.0f} s after a takeover")
