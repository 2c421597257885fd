"""Composition root: builds one flight from its config, starts it, and stops it in reverse order."""

import threading
from collections.abc import Callable
from contextlib import ExitStack
from datetime import UTC, datetime
from typing import TYPE_CHECKING

import cv2
from rich.console import Console
from rich.text import Text

import mavbridge
from mavbridge.camera.open import open_camera
from mavbridge.config.flight import FlyConfig
from mavbridge.config.rates import STATE_HZ, STATUS_HZ
from mavbridge.core.clock import NS_PER_S, Clock, MonotonicClock, wall_offset_ns
from mavbridge.core.errors import PeerError, UserError
from mavbridge.core.observers import FanOut, ObserverThread
from mavbridge.core.ports import Camera, TickSink
from mavbridge.core.realtime import settle_process, settle_thread
from mavbridge.core.stopping import StopRequest, stop_on_signals
from mavbridge.core.workers import HungError, Worker
from mavbridge.flight.assembly import (
    action_rate_hz,
    load_configured_policy,
    make_action_loop,
    make_vision_loop,
    vision_limits_hz,
)
from mavbridge.flight.feature_cache import FeatureCache
from mavbridge.flight.vision_rate import AdaptiveRate
from mavbridge.mavlink.link import MavlinkLink
from mavbridge.mavlink.transport.sockets import make_transport
from mavbridge.mavlink.transport.tap import PacketTap
from mavbridge.observe.rerun_flight import RerunView
from mavbridge.observe.terminal import FlightScreen
from mavbridge.observe.timing import FlightTiming, ObserverDrops, TimingReport, report_json
from mavbridge.recording.folder import prepare_folder
from policy.contract import Executable

if TYPE_CHECKING:  # the extra "record" may not be installed
    from mavbridge.recording.recorder import Recorder

RERUN_CAPACITY = 1000
"""Ticks that may wait for the viewer: ten seconds at 100 Hz."""
JOIN_S = 2.0
RECORDER_JOIN_S = 60.0
"""The tables of a long flight become Parquet within seconds; the vehicle is released by then."""
HANG_NS = NS_PER_S
"""Silence of the action loop after which the flight is ended for it."""


def fly(config: FlyConfig) -> int:
    """Run one flight to its end; returns the exit status.

    Raises:
        MavbridgeError: for whatever a person can have caused.
    """
    if config.record is not None:
        prepare_folder(config.record)
    _check_report(config)
    clock = MonotonicClock()
    console = Console(stderr=True, emoji=False)
    fly_executable(config, _load_policy(config, clock, console), clock=clock, console=console)
    return 0


def fly_executable(
    config: FlyConfig,
    executable: Executable,
    *,
    clock: Clock,
    console: Console,
    sinks: tuple[TickSink, ...] = (),
) -> None:
    """Run one flight of a policy that is loaded already; ``sinks`` see every tick.

    Raises:
        MavbridgeError: for whatever a person can have caused.
    """
    # OpenCV's complaints about a camera come before, and instead of, ours.
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    cv2.setNumThreads(1)  # two loops share two cores: no pool of helpers under either
    flight: _Flight | None = None
    try:
        with ExitStack() as stack:
            flight = _Flight(config, clock, console, executable, sinks, stack)
            # Only now: until a stick can have been taken, a signal may simply end the process.
            stop = stack.enter_context(stop_on_signals())
            flight.run(stop)
    finally:
        if flight is not None:
            flight.finish()


def _load_policy(config: FlyConfig, clock: Clock, console: Console) -> Executable:
    loaded = load_configured_policy(config.policy, clock)
    for note in loaded.notes:
        console.print(Text(note, style="yellow"))
    return loaded.executable


class _Flight:
    """Everything of one flight; what is opened goes on the exit stack at once."""

    def __init__(
        self,
        config: FlyConfig,
        clock: Clock,
        console: Console,
        executable: Executable,
        sinks: tuple[TickSink, ...],
        stack: ExitStack,
    ) -> None:
        self._config = config
        self._clock = clock
        self._console = console
        self._executable = executable
        self._stack = stack
        self._is_dual = executable.dual_rate
        self._has_hung = False
        rates = config.rates
        self._action_hz = action_rate_hz(rates, is_dual=self._is_dual)
        self._vision_limits_hz = vision_limits_hz(rates, is_dual=self._is_dual)
        self._vision_hz = self._vision_limits_hz[1]
        self._timing = FlightTiming(action_hz=self._action_hz, vision_hz=self._vision_hz)
        self._screen = FlightScreen(
            console,
            action_hz=self._action_hz,
            vision_hz=self._vision_hz,
            readonly=config.link.readonly,
        )
        self._recorder: Recorder | None = None
        stack.callback(self._close_recorder)  # after the link: it records the release as well
        self._tap = None if config.record is None else PacketTap()
        self._link = self._open_link()
        self._viewer = self._open_viewer()
        camera = self._open_camera()
        self._recorder = self._open_recorder()
        own: list[TickSink] = [self._timing, self._screen]
        if self._recorder is not None:
            own.append(self._recorder)
        if self._viewer is not None:
            own.append(self._viewer)
        cache = FeatureCache()
        look = AdaptiveRate(min_hz=self._vision_limits_hz[0], max_hz=self._vision_hz)
        if look.is_adaptive:
            own.append(look)
        self._sink = FanOut([*own, *sinks])
        self._vision = make_vision_loop(
            executable,
            clock=clock,
            camera=camera,
            cache=cache,
            sink=self._sink,
            period_ns=look.period_ns,
        )
        self._action = make_action_loop(
            config, executable, clock=clock, link=self._link, cache=cache, sink=self._sink
        )

    def _open_viewer(self) -> ObserverThread | None:
        if self._config.rerun == "off":
            return None
        view = RerunView(self._config.rerun, action_hz=self._action_hz, vision_hz=self._vision_hz)
        viewer = ObserverThread("mavbridge-rerun", view, capacity=RERUN_CAPACITY)
        self._stack.callback(viewer.close, JOIN_S)
        return viewer

    def _open_recorder(self) -> "Recorder | None":
        if self._config.record is None or self._tap is None:
            return None
        from mavbridge.recording.meta import FlightMeta
        from mavbridge.recording.recorder import Recorder

        start_ns, offset_ns = self._clock.now_ns(), wall_offset_ns(self._clock)
        meta = FlightMeta(
            started_at=datetime.fromtimestamp((start_ns + offset_ns) / NS_PER_S, UTC).isoformat(),
            start_ns=start_ns,
            mavbridge_version=mavbridge.__version__,
            source="flight",
            policy=self._executable.name,
            engine=self._executable.engine,
            mode="dual" if self._is_dual else "single",
            action_hz=self._action_hz,
            visual_hz=self._vision_hz,
            contract=self._executable.contract,
            seed=self._config.policy.seed,
        )
        try:
            return Recorder(
                self._config.record,
                meta,
                packets=self._tap,
                wall_offset_ns=offset_ns,
                autopilot=lambda: self._link.autopilot,
                report=self._screen.tell,
            )
        except OSError as error:
            raise UserError(f"--record {self._config.record}: {error}") from error

    def _close_recorder(self) -> None:
        if self._recorder is not None:
            self._recorder.close(RECORDER_JOIN_S)

    def _open_camera(self) -> Camera:
        camera = open_camera(
            self._config.camera.source,
            image_size=self._executable.contract.image_height,
            clock=self._clock,
        )
        self._stack.callback(camera.close)
        return camera

    def _open_link(self) -> MavlinkLink:
        config = self._config.link
        transport = make_transport(config.connect, self._clock)
        link = MavlinkLink(
            transport,
            self._clock,
            config,
            state_hz=max(self._action_hz, STATE_HZ),
            tap=self._tap,
        )
        self._stack.callback(link.close)
        return link

    def run(self, stop: StopRequest) -> None:
        """Fly until the action loop ends, the camera dies, or somebody says stop."""
        rates = self._config.rates
        vision = Worker("mavbridge-vision", self._scheduled(self._vision.run, cpu=rates.vision_cpu))
        action = Worker(
            "mavbridge-action",
            self._scheduled(self._action.run, realtime=rates.realtime, cpu=rates.action_cpu),
        )
        settle_process()
        # Joined in reverse: the sticks go back before anything that feeds them is taken away.
        self._stack.callback(vision.join, JOIN_S)
        self._stack.callback(self._end, action)
        vision.start()
        action.start()
        with self._screen.live():
            while action.is_alive and vision.is_alive and not stop.is_set():
                self._screen.refresh()
                self._watch(action)
                stop.wait(1 / STATUS_HZ)

    def _scheduled(
        self, run: Callable[[threading.Event], None], *, realtime: bool = False, cpu: int | None
    ) -> Callable[[threading.Event], None]:
        """The same, on a thread that first asks for its place."""

        def run_settled(stop: threading.Event) -> None:
            refusal = settle_thread(realtime=realtime, cpu=cpu)
            if refusal is not None:
                self._screen.tell(refusal)
            run(stop)

        return run_settled

    def _watch(self, action: Worker) -> None:
        """End the flight when the action loop hangs: its last sticks must not stay."""
        idle_ns = self._clock.now_ns() - self._action.alive_ns
        if action.is_alive and idle_ns > HANG_NS:
            self._link.seize()
            self._has_hung = True
            raise PeerError(
                f"the action loop has hung for {idle_ns / NS_PER_S:.1f} s: the policy is too slow "
                "for this machine, or stuck"
            )

    def _end(self, action: Worker) -> None:
        try:
            action.join(JOIN_S)
        except HungError:
            self._link.seize()
            if not self._has_hung:  # else that is being told already
                raise

    def finish(self) -> None:
        """Say how it went."""
        report = self._report()
        self._screen.show_report(report)
        if self._recorder is not None:
            self._console.print(Text(self._recorder.summary()), soft_wrap=True)
        if self._config.report is not None:
            self._config.report.write_text(report_json(report))

    def _report(self) -> TimingReport:
        drops = ObserverDrops(
            rerun=self._viewer.dropped if self._viewer else None,
            recorder=self._recorder.dropped if self._recorder else None,
        )
        return self._timing.report(
            mode="dual" if self._is_dual else "single",
            engine=self._executable.engine,
            policy=self._executable.name,
            autopilot=self._link.autopilot,
            link=self._link.stats(),
            observer_drops=drops,
        )


def _check_report(config: FlyConfig) -> None:
    """Before the flight, not after it."""
    if config.report is None:
        return
    try:
        config.report.parent.mkdir(parents=True, exist_ok=True)
        config.report.open("a").close()
    except OSError as error:
        raise UserError(f"cannot write --report {config.report}: {error.strerror}") from error
