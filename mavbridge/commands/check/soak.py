"""``check --soak``: this policy at the bundled vehicle for a while, measured on this computer.

A policy that crashes its vehicle could not be measured for long. Therefore each chunk is computed
in full, and then its values are replaced by the sticks of a slow level climb.
"""

import sys
from contextlib import ExitStack
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

from mavbridge.camera.open import NO_CAMERA
from mavbridge.commands.check.computer import (
    Computer,
    Usage,
    hottest_c,
    read_usage,
    this_computer,
)
from mavbridge.commands.check.policy import HELD
from mavbridge.commands.check.rows import CheckRow
from mavbridge.commands.output import number
from mavbridge.config.flight import CameraConfig, EnvelopeConfig, FlyConfig, LinkConfig
from mavbridge.core.clock import NS_PER_MS, NS_PER_S, Clock
from mavbridge.core.errors import MavbridgeError, PeerError, UserError
from mavbridge.core.processes import end, free_port, log_tail, running
from mavbridge.core.reasons import Kind, Reason
from mavbridge.core.records import Event, Tick
from mavbridge.flight.app import fly_policy
from mavbridge.flight.guard_process import start_guard
from mavbridge.flight.plan import FlightPlan, plan_flight
from mavbridge.flight.policies import load_configured_policy
from mavbridge.observe.output import patient_console
from mavbridge.observe.timing import FlightTiming, ObserverDrops, TimingReport, report_document
from policy.contract import Contract, FloatArray
from policy.protocol import PolicyRunner

CLIMB_STICK = 0.3
"""Stick for 0.3 m/s up in ALT_HOLD: beyond the dead zone, some 20 m per minute."""
NO_CEILING = EnvelopeConfig(max_height=0.0)
"""Ten minutes of that climb exceed the usual 120 m."""
MAX_AGE_S = 5.0
"""Age limit far above any engine's need, so that a slow engine is measured, not released."""
LEAST_SHARE = 0.95
"""Minimum share of the requested duration; a flight that ended earlier is no measurement."""
USAGE_NS = NS_PER_S // 4
"""Time between two readings of processor times and temperature."""


@dataclass(frozen=True, kw_only=True)
class Soak:
    """Result of a soak."""

    computer: Computer
    timing: TimingReport
    cpu_cores: dict[str, float]
    """Processor time over elapsed time of the processes "flight" and "guard", and, as
    "flight/NAME", of each thread of the flight process."""
    guard_waited_ms: float
    """Time in which the guard was runnable, but the kernel ran others."""
    host_took_ms: float
    """Time in which the hypervisor gave this machine's processors to others."""
    hottest_c: float | None
    """Highest temperature [degrees Celsius]; None: this system tells none."""

    def document(self) -> dict[str, object]:
        """Return all figures as a JSON object; ``timing`` is as in a flight's report."""
        return asdict(self) | {"timing": report_document(self.timing)}

    def row(self) -> CheckRow:
        """Return the row of the check: a warning if a slot was missed or a rate was not held."""
        sticks, action, vision = self.timing.sticks, self.timing.action, self.timing.vision
        slow = [
            name
            for name, part in (("chunks", action), ("images", vision))
            if part.rate_hz is not None and part.rate_hz < HELD * part.target_hz
        ]
        warnings = [f"this computer does not hold the rate of {' and '.join(slow)}"] if slow else []
        if sticks.missed_slots:
            warnings.append("the guard was late: see missed slots in docs/timing.md")
        heat = "" if self.hottest_c is None else f", {self.hottest_c:.0f} degrees"
        cores = self.cpu_cores["flight"] + self.cpu_cores["guard"]
        return CheckRow(
            "computer",
            "soak",
            f"{sticks.flying_s:.0f} s, {sticks.missed_slots} of {sticks.slots} slots missed; "
            f"chunks {number(action.rate_hz, 1)} Hz, images {number(vision.rate_hz, 1)} Hz, "
            f"{cores:.2f} of {self.computer.cores} cores{heat}",
            f"no slot missed, {action.target_hz:g} and {vision.target_hz:g} Hz",
            warn="; ".join(warnings),
        )


class FlightMeter:
    """``TickSink`` that measures from the policy's first action on.

    Waiting, handshake and arming consist of cheap, punctual ticks that would flatter a slow engine.
    """

    def __init__(
        self, plan: FlightPlan, runner: PolicyRunner, *, clock: Clock, guard_pid: int
    ) -> None:
        self._runner = runner
        self._clock = clock
        self._guard_pid = guard_pid
        self._timing = FlightTiming(
            stick_hz=plan.config.rates.stick_rate,
            action_hz=plan.loops.action_hz,
            vision_hz=plan.image_rates_hz[0],
        )
        self._first: Usage | None = None
        self._last: Usage | None = None
        self._hottest_c: float | None = None
        self.release_reason: Reason | None = None
        """Reason why the policy lost the sticks early; None if it kept them."""

    def emit(self, event: Event) -> None:
        """Count the event."""
        if isinstance(event, Tick) and event.trace is not None:
            self._read_usage()
        if self._first is not None:
            self._timing.emit(event)
            reason = event.release_reason if isinstance(event, Tick) else None
            if reason is not None and reason.kind is not Kind.END:
                self.release_reason = self.release_reason or reason

    def _read_usage(self) -> None:
        if self._last is not None and self._clock.now_ns() - self._last.at_ns < USAGE_NS:
            return
        self._last = read_usage(self._clock, self._guard_pid)
        self._first = self._first or self._last
        heats_c = [heat_c for heat_c in (self._hottest_c, hottest_c()) if heat_c is not None]
        self._hottest_c = max(heats_c, default=None)

    def report(self) -> TimingReport:
        """Return the figures of the flight so far, without those of its link."""
        return self._timing.report(
            mode="dual" if self._runner.dual_rate else "single",
            engine=self._runner.engine,
            policy=self._runner.name,
            autopilot=None,
            link=None,
            observer_drops=ObserverDrops(rerun=None, recorder=None),
        )

    def figures(self) -> Soak:
        """Return all figures of the flight.

        Raises:
            PeerError: the policy never had the sticks.
        """
        first, last = self._first, self._last
        if first is None or last is None:
            raise PeerError("the policy never had the sticks of the bundled vehicle")
        elapsed_ns = max(last.at_ns - first.at_ns, 1)
        spent_ns = {name: used - first.used_ns.get(name, 0) for name, used in last.used_ns.items()}
        return Soak(
            computer=this_computer(),
            timing=self.report(),
            cpu_cores={name: round(spent / elapsed_ns, 3) for name, spent in spent_ns.items()},
            guard_waited_ms=round((last.guard_waited_ns - first.guard_waited_ns) / NS_PER_MS, 1),
            host_took_ms=round((last.host_ns - first.host_ns) / NS_PER_MS, 1),
            hottest_c=self._hottest_c,
        )


def soak(config: FlyConfig, clock: Clock, *, duration_s: float) -> Soak:
    """Load the policy of ``config``, and fly the bundled vehicle for ``duration_s``.

    Raises:
        MavbridgeError: the policy or the vehicle failed, or the flight ended early.
    """
    port = free_port()
    with ExitStack() as stack:
        loaded = stack.enter_context(load_configured_policy(config.policy, clock))
        runner = level_climb(loaded.runner)
        if runner.contract.is_depth:
            raise UserError("--soak: the bundled vehicle has no depth camera; leave it out")
        folder = Path(stack.enter_context(TemporaryDirectory(prefix="mavbridge-soak-")))
        shared = f"shm:mavbridge-soak-{port}"
        command = ("-m", "sitl", "--connect", f"udpout:127.0.0.1:{port}", "--camera", shared)
        log = folder / "vehicle.log"
        vehicle = stack.enter_context(running(sys.executable, *command, log=log))
        source = NO_CAMERA if set(config.camera.sources) == {NO_CAMERA} else shared
        flight = climb_config(config, runner.contract, port=port, source=source)
        try:
            meter = fly_and_measure(replace(flight, duration=duration_s), runner, clock)
        except MavbridgeError as error:
            if vehicle.poll() is None:
                raise
            raise UserError(f"python -m sitl failed: {log_tail(log)}") from error
        finally:
            end(vehicle)
    return meter.figures()


def climb_config(config: FlyConfig, contract: Contract, *, port: int, source: str) -> FlyConfig:
    """Return the flight of a ``level_climb`` at a bundled vehicle, by the policy of ``config``; all
    its cameras see the same ``source``."""
    names = contract.cameras
    sources = (source,) if len(names) == 1 else tuple(f"{name}={source}" for name in names)
    return FlyConfig(
        policy=config.policy,
        rates=config.rates,
        goal=config.goal,
        link=LinkConfig(connect=f"udp:127.0.0.1:{port}"),
        # High above the course, the simulator's noiseless view hardly changes.
        camera=CameraConfig(camera=sources, max_frozen_image=0.0),
        envelope=NO_CEILING,
        mode="ALT_HOLD",
        arm=True,
    )


def fly_and_measure(config: FlyConfig, runner: PolicyRunner, clock: Clock) -> FlightMeter:
    """Fly ``config.duration`` with a loaded policy, and measure it.

    Raises:
        PeerError: the policy lost the sticks, or the flight ended early.
        MavbridgeError: it could not be flown.
    """
    plan = plan_flight(config, runner.contract, is_dual=runner.dual_rate)
    with ExitStack() as stack:
        guard = start_guard(config, clock, stack)
        meter = FlightMeter(plan, runner, clock=clock, guard_pid=guard.pid)
        fly_policy(
            plan, runner, clock=clock, console=patient_console(), sinks=(meter,), guard=guard
        )
    if meter.release_reason is not None:
        raise PeerError(f"the policy lost the sticks: {meter.release_reason}")
    lasted_s, wanted_s = meter.report().duration_s, config.duration or 0.0
    if lasted_s < LEAST_SHARE * wanted_s:
        raise PeerError(f"the flight lasted {lasted_s:g} s instead of {wanted_s:g} s")
    return meter


def level_climb(runner: PolicyRunner) -> PolicyRunner:
    """Return a runner that does the same work and returns climb sticks, however late it is."""

    def act(encoded: FloatArray, state: FloatArray, history: FloatArray) -> FloatArray:
        chunk = runner.act(encoded, state, history).copy()
        chunk[...] = (CLIMB_STICK, 0.0, 0.0, 0.0)
        return chunk

    contract = replace(
        runner.contract,
        action="sticks",
        modes=("ALT_HOLD",),
        max_state_age_s=MAX_AGE_S,
        max_velocity_age_s=MAX_AGE_S,
        max_feature_age_s=MAX_AGE_S,
        max_chunk_age_s=MAX_AGE_S,
    )
    return replace(runner, contract=contract, act=act)
