"""One demonstration: a simulated flight, labelled with the expert's actions and recorded."""

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from shutil import rmtree

import mavbridge
from mavbridge.commands.demonstrate.config import DemonstrateConfig
from mavbridge.commands.demonstrate.pilot import Pilot, Variation, draw_variation
from mavbridge.config.rates import SIM_CAMERA_PX, Rates
from mavbridge.core.clock import MonotonicClock
from mavbridge.core.errors import UserError
from mavbridge.core.records import Event, Tick
from mavbridge.flight.policies import load_for_episodes
from mavbridge.recording.flight_writer import FlightWriter
from mavbridge.recording.folder import prepare_folder
from mavbridge.recording.meta import FlightMeta
from mavbridge.recording.rows import FrameTruth, TickLabels
from mavbridge.simulation.flight import SimulatedFlight, SimulationSettings
from mavbridge.simulation.world import NOMINAL_VEHICLE, Exposure
from policy.contract import Contract
from policy.protocol import Executable
from sitl.course.layout import gate_truth

TRUTHS_KEPT = 64
"""Exposures whose frames may still be on their way."""
RATE_TILT_DEG = 80.0
"""Largest tilt of a policy that learns from an expert by body rates, which leans by up to 62."""


@dataclass(frozen=True, kw_only=True)
class DemonstrationSpec:
    """A demonstration to fly."""

    folder: Path
    """Its contents are replaced."""
    seed: int
    config: DemonstrateConfig

    def __str__(self) -> str:
        return f"demonstration {self.seed}"


def fly_demonstration(spec: DemonstrationSpec, should_stop: Callable[[], bool]) -> bool:
    """Fly and record one course; returns whether it was finished.

    Raises:
        EpisodeInterruptedError: ``should_stop`` ended it; the folder holds an unfinished flight.
        MavbridgeError: it cannot be flown or recorded.
    """
    rmtree(spec.folder, ignore_errors=True)
    prepare_folder(spec.folder)
    with ExitStack() as stack:
        return _fly(spec, should_stop, stack)


def _fly(spec: DemonstrationSpec, should_stop: Callable[[], bool], stack: ExitStack) -> bool:
    """The same, with the student's life on ``stack``."""
    variation, wanted = draw_variation(spec.seed), spec.config.policy
    student: Executable | None = None
    size_px = wanted.image_size or SIM_CAMERA_PX
    contract = Contract(
        feature_dim=1,
        arrays="numpy",
        image_height=size_px,
        image_width=size_px,
        action=spec.config.action,
        max_tilt_deg=RATE_TILT_DEG if spec.config.action == "rates" else None,
    )
    if wanted.checkpoint is not None:
        loaded = load_for_episodes(replace(wanted, dual_rate=True), MonotonicClock())
        student = stack.enter_context(loaded).executable
        contract = student.contract
        if contract.action != spec.config.action:
            raise UserError(
                f"{wanted.checkpoint} flies by {contract.action}: use --action {contract.action}"
            )
    flight = SimulatedFlight(
        course_seed=spec.seed,
        seed=spec.seed,
        # The expert looks at no image: frames are drawn in the size to be recorded.
        settings=SimulationSettings(
            delays=variation.delays, least_camera_px=SIM_CAMERA_PX if student else 1
        ),
        vehicle=replace(
            NOMINAL_VEHICLE,
            conditions=variation.conditions,
            autopilot=spec.config.autopilot,
        ),
    )
    pilot = Pilot(
        flight, variation, speed_mps=spec.config.speed, contract=contract, student=student
    )
    meta = _meta(spec, variation, pilot.executable)
    writer = FlightWriter(spec.folder, meta, pressure="offline", with_labels=True)
    recorder = _LabelledRecorder(flight, pilot, writer)
    try:
        result = flight.fly(
            pilot.executable,
            max_time_s=spec.config.max_time,
            sinks=(recorder,),
            should_stop=should_stop,
        )
    except BaseException:
        writer.close()
        raise
    success = flight.vehicle.log.next_gate is None and not flight.vehicle.log.crashed
    writer.finish(
        replace(writer.meta, autopilot="sitl", success=success, gates_passed=result.gates_passed)
    )
    return success


def _meta(spec: DemonstrationSpec, variation: Variation, executable: Executable) -> FlightMeta:
    return FlightMeta(
        started_at=datetime.now(UTC).isoformat(),
        start_ns=0,
        mavbridge_version=mavbridge.__version__,
        source="dagger" if spec.config.policy.checkpoint else "demonstration",
        policy=executable.name,
        engine=executable.engine,
        mode="dual",
        action_hz=Rates().loops(is_dual=True).action_hz,
        visual_hz=Rates().visual_limits_hz[1],
        contract=executable.contract,
        course_seed=spec.seed,
        seed=spec.seed,
        conditions=variation.conditions.numbers(),
    )


class _LabelledRecorder:
    """A ``TickSink`` that records, with labels, what happens once the demonstration has begun."""

    def __init__(self, flight: SimulatedFlight, pilot: Pilot, writer: FlightWriter) -> None:
        self._flight = flight
        self._pilot = pilot
        self._writer = writer
        self._truths: dict[int, FrameTruth] = {}
        self._ticks = self._frames = 0
        self._chunk_serial = 0
        flight.watch_exposures(self._keep_truth)

    def _keep_truth(self, exposure: Exposure) -> None:
        body = exposure.body
        position_ned_m, ned_from_body_wxyz = body.position_ned_m, body.ned_from_body_wxyz
        next_gate = self._flight.vehicle.log.next_gate
        gates = gate_truth(self._flight.course, next_gate, position_ned_m, ned_from_body_wxyz)
        self._truths[exposure.frame_id] = FrameTruth(
            position_ned_m=position_ned_m,
            ned_from_body_wxyz=ned_from_body_wxyz,
            velocity_ned_mps=body.velocity_ned_mps,
            **asdict(gates),
        )
        if len(self._truths) > TRUTHS_KEPT:
            self._truths.pop(next(iter(self._truths)))

    def emit(self, event: Event) -> None:
        """Record the event, numbered from the first that is recorded."""
        from_ns = self._pilot.begin_ns
        if from_ns is None:
            return
        if isinstance(event, Tick):
            self._record(event, from_ns)
        elif event.captured_ns >= from_ns:
            truth = self._truths.get(event.frame_id)
            self._writer.frame(replace(event, serial=self._frames), truth)
            self._frames += 1

    def _record(self, tick: Tick, from_ns: int) -> None:
        """Record the first send of each chunk: one row for each decision of the policy."""
        serial = tick.chunk_serial
        if tick.woke_ns < from_ns or serial is None or serial == self._chunk_serial:
            return
        self._chunk_serial = serial
        labels = TickLabels(expert=self._pilot.expert_action(serial))
        self._writer.tick(replace(tick, serial=self._ticks), labels)
        self._ticks += 1
