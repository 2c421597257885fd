"""A real flight: start the guard, open the devices that the flags name, stop all in reverse
order."""

import logging
import threading
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from functools import partial

import cv2
from rich.console import Console
from rich.text import Text

from mavbridge.camera.open import open_cameras
from mavbridge.config.flight import FlyConfig
from mavbridge.core.clock import NS_PER_S, Clock, MonotonicClock
from mavbridge.core.errors import ExitCode, MavbridgeError, PeerError
from mavbridge.core.files import empty_folders_removed
from mavbridge.core.log import SAID
from mavbridge.core.observers import FanOut
from mavbridge.core.realtime import prepare_to_die_first, settle_process, settle_thread
from mavbridge.core.reasons import Code, because
from mavbridge.core.records import FlightOutcome, TickSink
from mavbridge.core.stopping import HungError, StopRequest, Worker, stop_on_signals
from mavbridge.flight.checks import check_flight, output_folders, signing_note
from mavbridge.flight.feature_cache import FeatureCache
from mavbridge.flight.guard_process import GuardProcess, start_guard
from mavbridge.flight.observers import FlightObservers
from mavbridge.flight.outcome import flight_verdict, log_link
from mavbridge.flight.plan import FlightPlan, plan_flight
from mavbridge.flight.policies import load_configured_policy, looks_at_images
from mavbridge.flight.policy_loop import PolicyLoop
from mavbridge.flight.speed import require_speed
from mavbridge.flight.state import observation_ages_ns
from mavbridge.flight.telemetry_cache import TelemetryCache
from mavbridge.flight.vision_loop import VisionLoop, vision_loops
from mavbridge.guard.values import EndRequest, Phase
from mavbridge.observe.keyboard import ENGAGE_KEY, KEYS_HINT, Keyboard
from mavbridge.observe.output import patient_console
from mavbridge.observe.terminal import STATUS_HZ
from policy.preprocess import least_source_px
from policy.protocol import PolicyRunner

_log = logging.getLogger(__name__)
JOIN_S = 2.0
LEAST_HANG_NS = NS_PER_S
"""Silence of the policy or the encoder that ends the program. The guard has ended the policy's
flight long before."""
HANG_PERIODS = 5
STOPPED_NS = LEAST_HANG_NS // 2
"""The main thread checks STATUS_HZ times a second. A longer gap means that the whole process was
stopped, not that the policy hangs."""
END_NS = 10 * NS_PER_S
"""Longest wait for a guard that neither holds sticks nor ends."""


def fly(config: FlyConfig) -> int:
    """Run one flight to its end; return the exit status.

    Raises:
        MavbridgeError: the user, the vehicle or the policy made the flight impossible.
    """
    clock = MonotonicClock()
    console = patient_console()
    # The policy is closed last, after the guard has ended: its close may hang or raise.
    with (
        empty_folders_removed(*output_folders(config)),
        ExitStack() as policy_life,
        ExitStack() as stack,
    ):
        check_flight(config)
        guard = start_guard(config, clock, stack)  # finds the vehicle while the weights load
        guard.wait_until_open()
        loaded = load_configured_policy(
            config.policy, clock, starts_in_air=config.takeoff is not None
        )
        policy_life.enter_context(loaded)
        unsigned = signing_note(config.link)
        runner = loaded.runner
        plan = plan_flight(config, runner.contract, is_dual=runner.dual_rate)
        speed = require_speed(plan, runner.name, loaded.times)
        notes = (*loaded.notes, *speed, *([unsigned] if unsigned else []))
        for note in notes:
            logging.getLogger(SAID).info("%s", note)
            console.print(Text(note, style="yellow"))
        if (times := loaded.times) is not None:
            act_ms, encode_ms = times.act_s * 1e3, times.encode_s * 1e3
            _log.debug("a chunk takes %.2f ms here, an image %.2f ms", act_ms, encode_ms)
        return fly_policy(plan, runner, clock=clock, console=console, guard=guard)


def fly_policy(
    plan: FlightPlan,
    runner: PolicyRunner,
    *,
    clock: Clock,
    console: Console,
    sinks: tuple[TickSink, ...] = (),
    guard: GuardProcess | None = None,
) -> int:
    """Run one flight of a loaded policy; return the exit status.

    ``sinks`` receive every tick. An error that ends a flight of the policy has the exit status of a
    fault.
    """
    cv2.setNumThreads(1)  # both loops may share two cores: no pool of threads under either
    flight: _Flight | None = None
    with ExitStack() as signals:  # handled until the recording and the report are written
        try:
            with ExitStack() as stack:
                guard = guard or start_guard(plan.config, clock, stack)
                prepare_to_die_first()
                flight = _Flight(plan, clock, console, runner, guard, sinks, stack)
                # Only now: until a stick can have been taken, a signal may simply end the process.
                stop = signals.enter_context(stop_on_signals(is_bounded=True))
                guard.send(plan.guard)
                flight.run(stop)
            return flight.verdict(stop)
        except MavbridgeError as error:
            if flight is not None and flight.outcome is not None:
                error.exit_code = ExitCode.FAULT
            raise
        finally:
            if flight is not None:
                flight.finish()


class _Watchdog:
    """Finds a loop that has ended or hangs, so that no more chunks will come."""

    def __init__(
        self, plan: FlightPlan, clock: Clock, policy: PolicyLoop, visions: Sequence[VisionLoop]
    ) -> None:
        self._clock = clock
        self._policy = policy
        self._visions = dict(zip(plan.contract.cameras, visions, strict=True))
        self._policy_hang_ns = max(
            LEAST_HANG_NS,
            HANG_PERIODS * plan.guard.chunk_period_ns,
            plan.guard.freshness.state_ns,  # of a slow policy that plays each chunk for long
        )
        self._encoder_hang_ns = max(LEAST_HANG_NS, HANG_PERIODS * plan.start_limits.feature_ns)
        self._looked_ns = self._resumed_ns = clock.now_ns()
        self.has_hung = False

    @property
    def patience_s(self) -> float:
        """Time that one call of the policy may last before it counts as hung; 0 once it has."""
        longest_ns = max(self._policy_hang_ns, self._encoder_hang_ns)
        return 0.0 if self.has_hung else longest_ns / NS_PER_S

    def fault(self, policy: Worker, visions: Sequence[Worker]) -> EndRequest | None:
        """Return the end of the flight if no more chunks will come, or None."""
        for camera, vision in zip(self._visions, visions, strict=True):
            if not vision.is_alive:
                failed = because(Code.CAMERA_FAILED, camera=self._named(camera))
                return EndRequest(failed, "fault")
        if not policy.is_alive:
            return EndRequest(because(Code.POLICY_FAILED), "fault")
        now_ns = self._clock.now_ns()
        if now_ns - self._looked_ns > STOPPED_NS:
            self._resumed_ns = now_ns
        self._looked_ns = now_ns
        # Encoders wait for one another: the one that computes is the one that hangs.
        camera, _ = min(
            self._visions.items(),
            key=lambda encoder: (encoder[1].encoding_since_ns or now_ns, encoder[1].alive_ns),
        )
        silent_ns = min(vision.alive_ns for vision in self._visions.values())
        encoder = f"encoder{self._named(camera, 'of camera ')}"
        for alive_ns, name, limit_ns in (
            (self._policy.alive_ns, "policy", self._policy_hang_ns),
            (silent_ns, encoder, self._encoder_hang_ns),
        ):
            idle_ns = now_ns - max(alive_ns, self._resumed_ns)
            if idle_ns > limit_ns:
                self.has_hung = True
                hangs = because(Code.HANGS, name=name, idle_s=idle_ns / NS_PER_S)
                return EndRequest(hangs, "fault")
        return None

    def _named(self, camera: str, prefix: str = "") -> str:
        """Return the camera's name for a message; empty if it is the only camera."""
        return f" {prefix}{camera}" if len(self._visions) > 1 else ""


class _Flight:
    """State of one flight. Every resource is pushed on the exit stack when it is opened."""

    def __init__(
        self,
        plan: FlightPlan,
        clock: Clock,
        console: Console,
        runner: PolicyRunner,
        guard: GuardProcess,
        sinks: tuple[TickSink, ...],
        stack: ExitStack,
    ) -> None:
        self._config, self._cameras = plan.config, plan.contract.cameras
        self._clock = clock
        self._stack = stack
        self._guard = guard
        self._ending = EndRequest(reason=because(Code.GUARD_DIED), end="fault")
        """Reason for which the guard was asked to end. Until it is asked, it ends without a summary
        only if it dies."""
        self._observers = FlightObservers(plan, runner, clock=clock, console=console)
        # After the guard: it records the release.
        stack.callback(self._observers.close_recorder, guard, lambda: self.outcome)
        cameras = open_cameras(
            plan.config.camera,
            plan.contract,
            image_size=least_source_px(plan.contract),
            clock=clock,
            report=lambda line: console.print(Text(line)),
            stack=stack,
        )
        self._observers.open_viewer(stack)
        self._observers.open_recorder(guard, lambda: self._view.status.autopilot)
        detailed = self._observers.detailed_observers
        sink = FanOut((*self._observers.sinks, *sinks))
        self._view = TelemetryCache(
            plan, sink=sink, samples=guard.samples, watch_packets=self._observers.watch_packets
        )
        caches = [FeatureCache(span_ns=observation_ages_ns(plan.contract)[0]) for _ in cameras]
        self._visions = vision_loops(
            plan,
            self._view,
            encode=runner.encode,
            cameras=cameras,
            caches=caches,
            clocks=[clock] * len(cameras),
            sinks=[sink, *[FanOut(detailed)] * (len(cameras) - 1)],
            watches_images=looks_at_images(plan.config),
        )
        self._policy = PolicyLoop(
            plan,
            runner,
            clock=clock,
            view=self._view,
            caches=caches,
            send=guard.send,
            watches=[each.emit for each in detailed],
        )
        self._watchdog = _Watchdog(plan, clock, self._policy, self._visions)

    @property
    def outcome(self) -> FlightOutcome | None:
        """Outcome of the policy's flight; None if the policy never flew."""
        summary, referee = self._guard.summary, self._observers.referee
        told = None if summary is None else summary.outcome
        return referee.outcome(self._ending, self._view.status, told)

    def run(self, stop: StopRequest) -> None:
        """Fly until the guard ends, a loop ends, or a signal arrives."""
        view, screen = self._view, self._observers.screen
        names = ("mavbridge-vision", *(f"mavbridge-vision-{name}" for name in self._cameras[1:]))
        visions = [
            Worker(name, vision.run) for name, vision in zip(names, self._visions, strict=True)
        ]
        policy = Worker("mavbridge-policy", self._scheduled(self._policy.run, screen.show_message))
        # On the way of every attitude to the policy, so it must not wait for ordinary threads.
        listen = self._scheduled(partial(self._guard.listen, view=view))
        listener = Worker("mavbridge-guard", listen)
        settle_process()
        # Joined in reverse: the guard has ended before anything that feeds it is closed.
        for worker in (*visions, policy, listener):
            self._stack.callback(self._join, worker)
            worker.start()
        keyboard = Keyboard(self._on_key)
        self._stack.callback(keyboard.stop, JOIN_S)
        has_keys = not self._config.link.readonly and keyboard.start()
        screen.start(hint=KEYS_HINT if has_keys else None)
        referee = self._observers.referee
        has_act = has_keys or self._config.engage_channel is not None
        released = 0
        while listener.is_alive and not stop.is_set():
            ending = self._watchdog.fault(policy, visions) or referee.ending(self._clock.now_ns())
            if ending is not None:
                break
            stop.wait(1 / STATUS_HZ)
            released = released + 1 if view.phase is Phase.RELEASED else 0
            if released == 2 and not has_act:  # seen twice: it does not end by itself
                where = "here (no terminal, no --engage-channel)"
                screen.show_message(f"nothing can engage again {where}: end with Ctrl-C or SIGTERM")
        else:
            has_died = self._guard.summary is None and not stop.is_set()
            ending = self._ending if has_died else EndRequest(reason=because(Code.SIGNAL))
        self._end(ending, listener, stop)

    def _on_key(self, key: str) -> None:
        self._guard.send("engage" if key == ENGAGE_KEY else "release")

    def _scheduled(
        self,
        run: Callable[[threading.Event], None],
        report: Callable[[str], object] = _log.debug,
    ) -> Callable[[threading.Event], None]:
        """Wrap a loop so that its thread sets its scheduling first."""

        def run_settled(stop: threading.Event) -> None:
            if self._config.rates.realtime and (refusal := settle_thread()) is not None:
                report(refusal)
            run(stop)

        return run_settled

    def verdict(self, stop: StopRequest) -> int:
        """Return the exit status of the ended flight, and tell the user why it is not 0."""
        exit_code, text = flight_verdict(
            self._guard.summary,
            stop,
            reason=self._view.reason,
            readonly=self._config.link.readonly,
            crash=self._observers.referee.crash,
            record=self._config.record,
        )
        if text is not None:
            self._observers.screen.show_message(text)
        return exit_code

    def _end(self, ending: EndRequest, listener: Worker, stop: StopRequest) -> None:
        """Ask the guard to end, and wait while it holds the vehicle."""
        self._ending = ending
        self._guard.send(ending)
        screen, view = self._observers.screen, self._view
        asked = stop.requests
        until_ns = self._clock.now_ns() + END_NS
        is_told = False
        while not listener.ends_within(1 / STATUS_HZ):
            is_holding = view.phase is Phase.HOLDING
            # The guard's summary comes after the landing, or once its release is seen.
            if is_holding or view.phase is Phase.RELEASING:
                until_ns = self._clock.now_ns() + END_NS
            if is_holding and not is_told:
                is_told = True
                holder = f"the guard (process {self._guard.pid})"
                screen.show_message(f"after Ctrl-C {holder} sends neutral sticks alone")
            if stop.requests > asked or self._clock.now_ns() > until_ns:
                break
        if self._watchdog.has_hung:
            raise PeerError(f"{ending.reason}: it is too slow for this computer, or stuck")

    def _join(self, worker: Worker) -> None:
        """Join a loop, for as long as one call of the policy may last before it counts as hung."""
        try:
            worker.join(max(JOIN_S, self._watchdog.patience_s))
        except HungError:
            if not self._watchdog.has_hung:  # else that is being reported already
                raise

    def finish(self) -> None:
        """Print the report of a flight with a vehicle, and write it to --report."""
        view, screen, summary = self._view, self._observers.screen, self._guard.summary
        outcome = self.outcome
        for text in view.take_texts():  # said after the last tick
            screen.show_message(text)
        if outcome is not None and outcome.is_armed and not outcome.is_landed:
            height = "" if view.height_m is None else f" at {view.height_m:.0f} m"
            left = f"still armed in {view.status.mode or 'an unknown mode'}{height}"
            if summary is not None:
                screen.show_message(f"control given back, {left}")
            elif view.phase is Phase.HOLDING and not (self._guard.is_stuck or self._guard.wait(0)):
                holder = f"the guard (process {self._guard.pid})"
                screen.show_message(f"{left}: {holder} keeps sending neutral sticks")
        if summary is not None:
            log_link(summary)
        if summary is not None and summary.dropped_messages:
            screen.show_message(
                f"{summary.dropped_messages} messages of the guard were dropped: this process was "
                "too busy to read them"
            )
        autopilot = view.status.autopilot if view.is_found else None
        self._observers.finish(summary, autopilot, outcome)
