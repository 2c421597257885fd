"""Observers of one flight: timing, terminal, Rerun viewer and recorder."""

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from datetime import UTC, datetime
from typing import TYPE_CHECKING

from rich.console import Console

from mavbridge.core.clock import NS_PER_S, Clock
from mavbridge.core.course import CourseGate, read_gates
from mavbridge.core.errors import MavbridgeError, UserError
from mavbridge.core.files import as_json, write_output
from mavbridge.core.observers import ObserverThread
from mavbridge.core.provenance import command_line, digests, git_revision, versions, without_secrets
from mavbridge.core.records import FlightOutcome, TickSink
from mavbridge.core.vehicle import ForwardedPacket
from mavbridge.flight.guard_process import GuardProcess
from mavbridge.flight.history import ActionFrame
from mavbridge.flight.outcome import FlightReferee, describe
from mavbridge.flight.plan import FlightPlan
from mavbridge.flight.policies import policy_files
from mavbridge.guard.wire import GuardSummary
from mavbridge.observe.terminal import FlightScreen
from mavbridge.observe.timing import FlightTiming, ObserverDrops
from mavbridge.recording.folder import FlightMeta, FlightSource, remove_flight
from policy.protocol import PolicyRunner

if TYPE_CHECKING:  # the extra "record" may not be installed
    from mavbridge.recording.recorder import Recorder

RERUN_CAPACITY = 1000
"""Ticks queued for the viewer: ten seconds at 100 Hz."""
VIEWER_JOIN_S = 2.0
SCREEN_CLOSE_S = 2.0
"""Longest wait for the terminal to take the report."""
RECORDER_JOIN_S = 60.0
"""Longest wait for the recorder. A long flight's tables become Parquet within seconds; the vehicle
is released by then."""


def flight_meta(
    plan: FlightPlan, source: FlightSource, start_ns: int, wall_offset_ns: int
) -> FlightMeta:
    """Return the facts that are known before a flight starts, those of a policy left out."""
    names = plan.contract.cameras
    sources = map(without_secrets, plan.config.camera.sources_of(names))
    return FlightMeta(
        started_at=datetime.fromtimestamp((start_ns + wall_offset_ns) / NS_PER_S, UTC).isoformat(),
        start_ns=start_ns,
        source=source,
        policy=None,
        engine=None,
        mode="dual" if plan.is_dual else "single",
        action_hz=plan.loops.action_hz,
        visual_hz=plan.image_rates_hz[0],
        contract=plan.contract,
        command=command_line(),
        versions=versions(),
        git_revision=git_revision(),
        cameras=dict(zip(names, sources, strict=True)),
    )


def open_viewer(
    plan: FlightPlan, stack: ExitStack, *, gates: tuple[CourseGate, ...] = ()
) -> ObserverThread | None:
    """Start the viewer, or its file, if the flags ask for it. ``stack`` closes it."""
    target, contract, freshness = plan.config.rerun, plan.contract, plan.guard.freshness
    if target == "off":
        return None
    from mavbridge.observe.viewer import RerunView  # takes 0.4 s
    from mavbridge.observe.viewer_layout import ViewedFlight

    flight = ViewedFlight(
        vision_hz=plan.image_rates_hz[0],
        chunk_hz=plan.loops.action_hz,
        stick_hz=plan.config.rates.stick_rate,
        contract=contract,
        max_state_age_ns=freshness.state_ns,
        max_feature_age_ns=freshness.feature_ns,
        to_ned=ActionFrame(contract).to_guard,
        gates=gates,
    )
    viewer = ObserverThread(
        "mavbridge-rerun",
        RerunView(target, flight, is_live=True),
        capacity=RERUN_CAPACITY,
        cameras=len(contract.cameras),
    )
    stack.callback(viewer.close, VIEWER_JOIN_S)
    return viewer


class FlightObservers:
    """Observers that the flags ask for. None of them can delay a loop."""

    def __init__(
        self, plan: FlightPlan, runner: PolicyRunner, *, clock: Clock, console: Console
    ) -> None:
        config = self._config = plan.config
        self._plan = plan
        self._runner = runner
        self._clock = clock
        action_hz, vision_hz = plan.loops.action_hz, plan.image_rates_hz[0]
        self._timing = FlightTiming(
            stick_hz=config.rates.stick_rate, action_hz=action_hz, vision_hz=vision_hz
        )
        self._gates = None if config.gates is None else read_gates(config.gates)
        self.referee = FlightReferee(self._gates, stops=plan.contract.stops_at_end)
        self._viewer: ObserverThread | None = None
        self._recorder: Recorder | None = None
        self.screen = FlightScreen(
            console, action_hz=action_hz, vision_hz=vision_hz, readonly=config.link.readonly
        )

    @property
    def sinks(self) -> tuple[TickSink, ...]:
        """Open observers."""
        return (self._timing, self.screen, self.referee, *self.detailed_observers)

    @property
    def detailed_observers(self) -> tuple[ObserverThread, ...]:
        """Observers that take every solve, and the images of all cameras."""
        return tuple(sink for sink in (self._recorder, self._viewer) if sink is not None)

    def watch_packets(self, packets: tuple[ForwardedPacket, ...]) -> None:
        """Pass the vehicle's packets to the recorder, if there is one."""
        if self._recorder is not None:
            self._recorder.watch_packets(packets)

    def open_viewer(self, stack: ExitStack) -> None:
        """Start the viewer, or its file, if the flags ask for it. ``stack`` closes it."""
        self._viewer = open_viewer(self._plan, stack, gates=self._gates or ())

    def open_recorder(self, guard: GuardProcess, autopilot: Callable[[], str]) -> None:
        """Start the recorder if --record is given.

        Raises:
            WriterError: the folder cannot be written.
        """
        if self._config.record is None or guard.tlog_pipe is None:
            return
        from mavbridge.recording.recorder import Recorder
        from mavbridge.recording.replay_files import ReplaySettings

        meta = replace(
            flight_meta(self._plan, "flight", self._clock.now_ns(), guard.wall_offset_ns),
            policy=self._runner.name,
            engine=self._runner.engine,
            seed=self._config.policy.seed,
            plan=self._plan.figures(),
            policy_files=digests(policy_files(self._config.policy)),
        )
        self._recorder = Recorder(
            self._config.record,
            meta,
            tlog_pipe=guard.tlog_pipe,
            packets_dropped=lambda: guard.summary.dropped_packets if guard.summary else 0,
            autopilot=autopilot,
            report=self.screen.show_message,
            settings=ReplaySettings(config=self._config, wall_offset_ns=guard.wall_offset_ns),
        )

    def close_recorder(
        self, guard: GuardProcess, outcome_of: Callable[[], FlightOutcome | None]
    ) -> None:
        """Finish the recording. Call after the guard has ended, so that it has the release."""
        recorder = self._recorder
        if recorder is None:
            return
        outcome = outcome_of()
        params = {} if guard.summary is None else guard.summary.params

        def with_end(meta: FlightMeta) -> FlightMeta:
            meta = meta if outcome is None else meta.with_outcome(outcome)
            return replace(meta, parameters=params)

        try:
            recorder.describe(with_end)  # in case that the rest takes too long
        except MavbridgeError as error:
            self.screen.show_message(f"--record: {error}")
        recorder.close(RECORDER_JOIN_S)

    def finish(
        self, summary: GuardSummary | None, autopilot: str | None, outcome: FlightOutcome | None
    ) -> None:
        """Show the report and write it to --report; without a vehicle, delete the recording."""
        try:
            if autopilot is not None or outcome is not None:
                self._report(summary, autopilot, outcome)
            elif self._recorder is not None and self._config.record is not None:
                remove_flight(self._config.record, self._plan.contract.cameras)
        finally:  # an exception is printed only then
            self.screen.close(SCREEN_CLOSE_S)

    def _report(
        self, summary: GuardSummary | None, autopilot: str | None, outcome: FlightOutcome | None
    ) -> None:
        viewer, recorder = self._viewer, self._recorder
        report = self._timing.report(
            mode="dual" if self._plan.is_dual else "single",
            engine=self._runner.engine,
            policy=self._runner.name,
            autopilot=autopilot,
            link=summary.link if summary else None,
            observer_drops=ObserverDrops(
                rerun=viewer.dropped if viewer else None,
                recorder=recorder.dropped if recorder else None,
            ),
            outcome=outcome,
        )
        self.screen.show_report(report)
        if recorder is not None:
            self.screen.show_message(recorder.summary())
        if outcome is not None:
            self.screen.show_message(describe(outcome))
        if self._config.report is not None:
            try:
                write_output(self._config.report, as_json(report), "--report")
            except UserError as error:  # a full disk, no more open files
                self.screen.show_message(str(error))
