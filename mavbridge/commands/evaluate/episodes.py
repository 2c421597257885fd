"""One episode of an evaluation, and its flight: in lockstep with the simulator, or in real time.

In real time vehicle and bridge are processes of their own, connected over UDP.
"""

import json
import multiprocessing
import signal
import sys
import traceback
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection
from pathlib import Path
from subprocess import Popen, TimeoutExpired
from tempfile import TemporaryDirectory
from typing import NamedTuple

from rich.console import Console

from mavbridge.commands.evaluate.config import EvaluateConfig
from mavbridge.config.courses import HELD_OUT_COURSE_SEED, MAX_EPISODES, first_seed
from mavbridge.config.flight import CameraConfig, FlyConfig, LinkConfig
from mavbridge.config.rates import SIM_CAMERA_PX
from mavbridge.core.clock import NS_PER_MS, NS_PER_S, MonotonicClock
from mavbridge.core.errors import CameraError, MavbridgeError, PeerError
from mavbridge.core.processes import END_TIMEOUT_S, end, free_port, running, wait
from mavbridge.flight.app import fly_executable
from mavbridge.flight.plan import plan_flight
from mavbridge.flight.policies import is_scripted, load_configured_policy, load_for_episodes
from mavbridge.flight.settings import contract_with_ages
from mavbridge.simulation.delays import Delay, Delays
from mavbridge.simulation.flight import SimulatedFlight, SimulationSettings
from mavbridge.simulation.referee import EpisodeInterruptedError, EpisodeResult, Outcome, StickMeter
from mavbridge.simulation.world import (
    CONDITIONS_FLAGS,
    draw_conditions,
    make_vehicle,
    needed_params,
)
from policy.protocol import Executable

STARTUP_S = 90.0
"""Limit on a flight's time beyond its own: imports, compiling an engine, arming."""
_POLL_S = 0.1


@dataclass(frozen=True, kw_only=True)
class EpisodeSpec:
    """An episode to fly; its seeds follow from the evaluation's seed and its index alone."""

    config: EvaluateConfig
    index: int

    @property
    def seed(self) -> int:
        """Seed of delays and phases; seed S of the evaluation has S * MAX_EPISODES and on."""
        return self.config.policy.seed * MAX_EPISODES + self.index

    @property
    def course_seed(self) -> int:
        """A held-out course."""
        return first_seed(self.config.courses) + HELD_OUT_COURSE_SEED + self.seed

    @property
    def conditions_flags(self) -> tuple[str, ...]:
        """Flags of ``python -m sitl``."""
        flag = CONDITIONS_FLAGS[self.config.conditions]
        return () if flag is None else (flag, str(self.course_seed))

    def __str__(self) -> str:
        return f"course {self.course_seed}"


@dataclass(frozen=True, kw_only=True)
class FlownEpisode:
    """An episode's result, and what flew it."""

    engine: str
    notes: tuple[str, ...] = ()
    result: EpisodeResult


def fly_simulated(spec: EpisodeSpec, should_stop: Callable[[], bool]) -> FlownEpisode:
    """Fly one episode in lockstep with the simulator.

    Raises:
        EpisodeInterruptedError: ``should_stop`` ended it.
        MavbridgeError: it cannot be flown.
    """
    config, delays = spec.config, Delays()
    vision = delays.vision
    if config.vision_time is not None:
        vision = Delay(p50_ns=round(config.vision_time * NS_PER_MS))
    vision = replace(vision, offset_ns=round(config.vision_delay * NS_PER_MS))
    settings = SimulationSettings(
        rates=config.rates,
        limits=config.limits,
        delays=replace(delays, vision=vision, stall_ns=round(config.stalls * NS_PER_MS)),
        raw_sticks=config.raw_sticks,
        draw_images=not is_scripted(config.policy),
    )
    conditions = draw_conditions(config.conditions, spec.course_seed)
    if config.gusts is not None:
        conditions = replace(conditions, seed=spec.course_seed, gust_rms_mps=config.gusts)
    flight = SimulatedFlight(
        course_seed=spec.course_seed,
        seed=spec.seed,
        settings=settings,
        vehicle=make_vehicle(autopilot=config.autopilot, gains=config.gains, conditions=conditions),
    )
    with load_for_episodes(config.policy, flight.clock) as loaded:
        executable = _measured(loaded.executable, config)
        result = flight.fly(executable, max_time_s=config.max_time, should_stop=should_stop)
    return FlownEpisode(engine=loaded.executable.engine, notes=tuple(loaded.notes), result=result)


def _measured(executable: Executable, config: EvaluateConfig) -> Executable:
    """The executable, with a contract that allows the ages which the flags ask for."""
    return replace(executable, contract=contract_with_ages(executable.contract, config.limits))


class _BridgeJob(NamedTuple):
    spec: EpisodeSpec
    port: int
    camera: str


class _BridgeFlight(NamedTuple):
    engine: str
    meter: StickMeter
    camera_failure: str
    """Empty where there was none; the vehicle takes its camera with it when the course is done."""


def fly_on_wall_clock(spec: EpisodeSpec, should_stop: Callable[[], bool]) -> FlownEpisode:
    """Fly one episode in real time.

    Raises:
        EpisodeInterruptedError: ``should_stop`` ended it.
        MavbridgeError: the vehicle or the bridge failed.
    """
    port = free_port()
    camera = f"shm:mavbridge-evaluate-{port}"
    image_size = spec.config.policy.image_size
    with TemporaryDirectory(prefix="mavbridge-evaluate-") as folder:
        report, log = Path(folder, "vehicle.json"), Path(folder, "vehicle.log")
        command = (
            *(sys.executable, "-m", "sitl", "--camera", camera, "--end-with-course"),
            *("--connect", f"udpout:127.0.0.1:{port}", "--report", str(report)),
            *("--course", str(spec.course_seed), "--autopilot", spec.config.autopilot),
            *("--image-size", str(max(SIM_CAMERA_PX, image_size or 0))),
            *spec.conditions_flags,
        )
        with running(*command, log=log) as vehicle:
            try:
                flown = _run_bridge(_BridgeJob(spec, port, camera), vehicle, should_stop)
                if flown.camera_failure:
                    _require_ended(vehicle, flown.camera_failure)
            except MavbridgeError:
                if vehicle.poll():  # then the vehicle's failure is the reason
                    wait(vehicle, "python -m sitl", log, END_TIMEOUT_S)
                raise
            end(vehicle)
            wait(vehicle, "python -m sitl", log, END_TIMEOUT_S)
        return FlownEpisode(engine=flown.engine, result=_read_result(spec, flown.meter, report))


def _require_ended(vehicle: "Popen[bytes]", camera_failure: str) -> None:
    """Raise CameraError if the vehicle goes on without its camera."""
    with suppress(TimeoutExpired):
        vehicle.wait(END_TIMEOUT_S)
    if vehicle.poll() is None:
        raise CameraError(camera_failure)


def _run_bridge(
    job: _BridgeJob, vehicle: "Popen[bytes]", should_stop: Callable[[], bool]
) -> _BridgeFlight:
    """Run the bridge in a process of its own until it or the vehicle has ended."""
    clock, spec = MonotonicClock(), job.spec
    deadline_ns = clock.now_ns() + round((spec.config.max_time + STARTUP_S) * NS_PER_S)
    context = multiprocessing.get_context("spawn")
    outcomes, theirs = context.Pipe(duplex=False)
    bridge = context.Process(
        target=_send_outcome, args=(theirs, job), name="mavbridge-evaluate-bridge"
    )
    bridge.start()
    theirs.close()
    outcome: _BridgeFlight | Exception | None = None
    try:
        while not outcomes.poll(_POLL_S) and vehicle.poll() is None:
            if should_stop():
                raise EpisodeInterruptedError(f"{spec}: interrupted")
            if clock.now_ns() > deadline_ns:
                raise PeerError(f"{spec}: the bridge has not ended in time")
        if should_stop():  # the vehicle ended by the same Ctrl-C
            raise EpisodeInterruptedError(f"{spec}: interrupted")
    finally:
        bridge.terminate()  # gives the sticks back
        with suppress(EOFError):
            outcome = outcomes.recv() if outcomes.poll(END_TIMEOUT_S) else None
        bridge.join(END_TIMEOUT_S)
        bridge.kill()
        bridge.join(END_TIMEOUT_S)
    if outcome is None:
        raise PeerError(f"{spec}: the bridge's process has died, or hung at its end")
    if isinstance(outcome, Exception):
        raise outcome
    return outcome


def _send_outcome(results: Connection, job: _BridgeJob) -> None:
    """Fly once, in a process of its own; Ctrl-C reaches its parent, which then ends it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        results.send(_fly_bridge(job))
    except Exception as error:  # noqa: BLE001 - raised again by the parent
        error.add_note(traceback.format_exc())
        results.send(error)


def _fly_bridge(job: _BridgeJob) -> _BridgeFlight:
    """Fly once, as ``mavbridge fly`` does; ended by signals, like that."""
    settings, clock, meter = job.spec.config, MonotonicClock(), StickMeter()
    with (
        load_configured_policy(settings.policy, clock) as loaded,
        Path("/dev/null").open("w") as nowhere,
    ):
        executable = _measured(loaded.executable, settings)
        params = needed_params(executable.contract, settings.autopilot)
        config = FlyConfig(
            link=LinkConfig(
                connect=f"udp:127.0.0.1:{job.port}",
                raw_sticks=settings.raw_sticks,
                set=tuple(f"{name}={value:g}" for name, value in params.items()),
            ),
            policy=settings.policy,
            camera=CameraConfig(camera=(job.camera,)),
            rates=settings.rates,
            limits=settings.limits,
            arm=True,
            duration=settings.max_time,
        )
        console = Console(file=nowhere)
        plan = plan_flight(config, executable.contract, is_dual=executable.dual_rate)
        try:
            fly_executable(plan, executable, clock=clock, console=console, sinks=(meter,))
        except CameraError as error:
            return _BridgeFlight(executable.engine, meter, str(error))
    return _BridgeFlight(executable.engine, meter, "")


def _read_result(spec: EpisodeSpec, meter: StickMeter, path: Path) -> EpisodeResult:
    """Result from the vehicle's report, whose format ``sitl.report`` defines."""
    if meter.engaged_ns is None:
        raise PeerError(f"{spec}: the policy did not get the sticks")
    report = json.loads(path.read_text())
    gates_total, passed = report["gates"]["total"], report["gates"]["passed"]
    offset_s = (meter.engaged_ns - report["start_ns"]) / NS_PER_S
    outcome: Outcome = "timed out" if report["final"]["armed"] else "disarmed"
    if report["crashed"]:
        outcome = "crashed"
    elif len(passed) == gates_total:
        outcome = "finished"
    return EpisodeResult(
        course_seed=spec.course_seed,
        seed=spec.seed,
        outcome=outcome,
        gates_total=gates_total,
        gate_times_s=tuple(gate["t_s"] - offset_s for gate in passed),
        flown_s=report["duration_s"] - offset_s,
        distance_m=report["distance_m"],
        stick_rate_per_s=meter.rate_per_s,
    )
