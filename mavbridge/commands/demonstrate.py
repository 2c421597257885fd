"""``mavbridge demonstrate``: fly, record and label the episodes that are missing."""

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from shutil import rmtree

from mavbridge.commands.demonstrate_expert import ExpertAndStudent, Variation, draw_variation
from mavbridge.commands.episode_workers import fly_jobs
from mavbridge.commands.output import progress_bar, text_console
from mavbridge.config.episodes import COURSE_SEEDS, MAX_EPISODES, DemonstrateConfig
from mavbridge.config.policy import Rates
from mavbridge.core.clock import NS_PER_MS, NS_PER_S, Clock
from mavbridge.core.errors import UserError
from mavbridge.core.provenance import digests, versions
from mavbridge.core.records import Event, Tick
from mavbridge.core.stopping import INTERRUPTED, stop_on_signals
from mavbridge.flight.policies import load_for_episodes, policy_files
from mavbridge.recording.flight_writer import FlightWriter
from mavbridge.recording.folder import FlightMeta, prepare_folder, read_meta
from mavbridge.recording.rows import FrameTruth
from mavbridge.simulation.flight import SIM_CAMERA_PX, SimulatedFlight, SimulationSettings
from mavbridge.simulation.world import Exposure, make_vehicle
from policy.contract import Contract
from policy.data.flight_files import META
from policy.protocol import PolicyRunner
from sitl.course import gate_truth

ENDLESS_LAPS = 1000
RATE_TILT_DEG = 80.0
"""Tilt limit of a policy that learns from a body-rate expert, which leans by up to 62 degrees."""


@dataclass(frozen=True, kw_only=True)
class DemonstrationSpec:
    """A demonstration to fly."""

    folder: Path
    """Its contents are replaced."""
    seed: int
    config: DemonstrateConfig
    weights: dict[str, str] = field(default_factory=dict)
    """SHA-256 of the student's files, by absolute path."""

    def __str__(self) -> str:
        return f"demonstration {self.seed}"


def fly_demonstration(spec: DemonstrationSpec, should_stop: Callable[[], bool]) -> bool:
    """Fly and record one course; return True if it was finished. See ``FlyJob``."""
    rmtree(spec.folder, ignore_errors=True)
    prepare_folder(spec.folder, "--out")
    config = spec.config
    longest_solve_ns = round(config.solve_time * NS_PER_MS)
    variation = draw_variation(spec.seed, longest_solve_ns=longest_solve_ns)
    with ExitStack() as stack:
        flight = SimulatedFlight(
            course_seed=spec.seed,
            seed=spec.seed,
            laps=ENDLESS_LAPS if config.courses == "loop" else 1,
            # The expert uses no image: frames are drawn in the size of the recording.
            settings=SimulationSettings(
                delays=variation.delays, least_camera_px=SIM_CAMERA_PX if config.has_student else 1
            ),
            vehicle=make_vehicle(autopilot=config.autopilot, conditions=variation.conditions),
        )
        contract, student = _terms(spec, longest_solve_ns, flight.clock, stack)
        expert = ExpertAndStudent(
            flight, variation, speed_mps=config.speed, contract=contract, student=student
        )
        meta = _meta(spec, variation, expert.runner, flight.clock.now_ns())
        writer = FlightWriter(spec.folder, meta, pressure="offline", with_labels=True)
        stack.callback(writer.close)
        result = flight.fly(
            expert.runner,
            max_time_s=config.max_time,
            run_out_s=variation.hover_s,
            ends_by_stop=False,
            sinks=(_LabelledRecorder(flight, expert, writer),),
            should_stop=should_stop,
        )
        log = flight.vehicle.log
        is_round = flight.course.is_loop and result.gates_passed > 0
        success = not log.crashed and (log.next_gate is None or is_round)
        writer.finish(replace(writer.meta, success=success, gates_passed=result.gates_passed))
        if writer.video_failure is not None:
            raise writer.video_failure
    return success


def _terms(
    spec: DemonstrationSpec, longest_solve_ns: int, clock: Clock, stack: ExitStack
) -> tuple[Contract, PolicyRunner | None]:
    """Return the contract of the flight and the student, if one flies; ``stack`` closes it."""
    config, wanted = spec.config, spec.config.policy
    if not config.has_student:
        size_px = wanted.image_size or SIM_CAMERA_PX
        contract = Contract(
            feature_dim=1,
            arrays="numpy",
            image_height=size_px,
            image_width=size_px,
            action=config.action,
            max_tilt_deg=RATE_TILT_DEG if config.action == "rates" else None,
            stops_at_end=True,
        )
        return contract, None
    loaded = load_for_episodes(replace(wanted, dual_rate=True), clock, spec.seed)
    student = stack.enter_context(loaded).runner
    if student.contract.action != config.action:
        action = student.contract.action
        name = wanted.checkpoint or wanted.policy
        raise UserError(f"{name} flies by {action}, and the expert by {config.action} (--action)")
    max_age_s = student.contract.max_feature_age_s + longest_solve_ns / NS_PER_S
    theirs = replace(student.contract, max_feature_age_s=max_age_s, stops_at_end=True)
    # The expert acts at every tick, however long the student's plans are played.
    return replace(theirs, play_s=0.0), replace(student, contract=theirs)


def _meta(
    spec: DemonstrationSpec, variation: Variation, runner: PolicyRunner, start_ns: int
) -> FlightMeta:
    return FlightMeta(
        started_at=datetime.now(UTC).isoformat(),
        start_ns=start_ns,
        source="dagger" if spec.config.has_student else "demonstration",
        policy=runner.name,
        engine=runner.engine,
        mode="dual" if runner.dual_rate else "single",
        autopilot=spec.config.autopilot,
        action_hz=Rates().loops(is_dual=runner.dual_rate).action_hz,
        visual_hz=Rates().visual_rate,
        contract=runner.contract,
        course_seed=spec.seed,
        seed=spec.seed,
        conditions=variation.conditions.numbers(),
        policy_files=spec.weights,
        versions=versions(),
        plan={
            "speed_mps": spec.config.speed,
            "solve_time_ms": spec.config.solve_time,
            "max_time_s": spec.config.max_time,
        },
    )


class _LabelledRecorder:
    """``TickSink`` that records the flight with labels, from the start of the demonstration."""

    def __init__(
        self, flight: SimulatedFlight, expert: ExpertAndStudent, writer: FlightWriter
    ) -> None:
        self._flight = flight
        self._expert = expert
        self._writer = writer
        self._truths: dict[int, FrameTruth] = {}
        self._ticks = self._frames = 0
        self._chunk_serial = 0
        flight.exposure_watchers.append(self._keep_truth)

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

    def emit(self, event: Event) -> None:
        """Record a frame, or the first send of a chunk: one row per decision of the policy.

        Numbers count from the first recorded one.
        """
        from_ns = self._expert.begin_ns
        if from_ns is None:
            return
        if not isinstance(event, Tick):
            if event.captured_ns >= from_ns:
                truth = self._truths.pop(event.frame_id, None)
                self._writer.frame(replace(event, serial=self._frames), truth)
                self._frames += 1
        elif event.woke_ns >= from_ns and event.chunk_serial not in (None, self._chunk_serial):
            self._chunk_serial = event.chunk_serial
            label = self._expert.expert_actions.pop(event.chunk_serial, None)
            self._writer.tick(replace(event, serial=self._ticks), label)
            self._ticks += 1


def demonstrate(config: DemonstrateConfig) -> int:
    """Fly every episode that is not recorded yet; return 130 if interrupted, to be resumed."""
    console = text_console(stderr=True)
    specs = _missing(config)
    done = config.episodes - len(specs)
    if done:
        console.print(f"{done} of {config.episodes} are there already", style="dim")
    successes = 0
    with stop_on_signals() as stop, progress_bar(console) as progress:
        bar = progress.add_task("demonstrating", total=config.episodes, completed=done, status="")
        flown = fly_jobs(fly_demonstration, specs, config.workers, stop.is_set)
        for count, (_, success) in enumerate(flown, start=1):
            successes += success
            progress.update(bar, advance=1, status=f"{successes} of {count} finished the course")
        was_stopped = stop.is_set()
    if was_stopped:
        console.print("interrupted: run the same command to resume", style="yellow")
        return INTERRUPTED
    return 0


def _missing(config: DemonstrateConfig) -> list[DemonstrationSpec]:
    """Return the episodes without a finished recording; raise if a folder holds anything else."""
    weights = digests(policy_files(config.policy)) if config.has_student else {}
    specs = []
    first = COURSE_SEEDS[config.courses] + config.policy.seed * MAX_EPISODES  # never evaluated
    for index in range(config.episodes):
        folder, seed = config.out / f"{index:06d}", first + index
        spec = DemonstrationSpec(folder=folder, seed=seed, config=config, weights=weights)
        if folder.is_dir() and any(folder.iterdir()):
            if not (folder / META).is_file():
                raise UserError(f"{folder} is no recorded flight: name another --out")
            meta = read_meta(folder)
            if differences := _differences(meta, spec):
                raise UserError(
                    f"{folder} holds another flight ({differences}): name another --out"
                )
            if meta.finished:
                continue
        specs.append(spec)
    return specs


def _differences(meta: FlightMeta, spec: DemonstrationSpec) -> str:
    """Return how a recorded flight differs from the one to fly, in words; empty if it does not."""
    config = spec.config
    size_px = meta.contract.image_height
    asked_px = size_px if config.has_student else config.policy.image_size or SIM_CAMERA_PX
    pairs = {
        "source": (meta.source, "dagger" if config.has_student else "demonstration"),
        "course seed": (meta.course_seed, spec.seed),
        "--autopilot": (meta.autopilot, config.autopilot),
        "--action": (meta.contract.action, config.action),
        "--speed": (meta.plan.get("speed_mps"), config.speed),
        "--solve-time": (meta.plan.get("solve_time_ms"), config.solve_time),
        "--max-time": (meta.plan.get("max_time_s", config.max_time), config.max_time),
        "--policy": (meta.policy, config.policy.policy if config.has_student else meta.policy),
        "network.image_size": (size_px, asked_px),
        "--checkpoint": tuple(
            " ".join(sorted(digest[:8] for digest in files.values())) or "none"
            for files in (meta.policy_files, spec.weights)
        ),
    }
    return "; ".join(f"{name} {was}, not {now}" for name, (was, now) in pairs.items() if was != now)
