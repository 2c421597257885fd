"""Composition root: builds one flight from its config, starts it, and stops it in reverse order."""

import sys
import threading
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

import cv2
from rich.console import Console
from rich.text import Text

from mavbridge.action_loop import ActionLoop, ActionSettings
from mavbridge.camera.open import open_camera
from mavbridge.clock import NS_PER_S, Clock, GridPacer, MonotonicClock, Pacer
from mavbridge.config import STATE_HZ, STATUS_HZ, FlyConfig, Limits, period_ns
from mavbridge.errors import PeerError, UserError
from mavbridge.feature_cache import FeatureCache
from mavbridge.mavlink.link import MavlinkLink
from mavbridge.mavlink.transport import make_transport
from mavbridge.observers import FanOut, ObserverThread
from mavbridge.ports import Camera, TickSink
from mavbridge.realtime import settle_process, settle_thread
from mavbridge.rerun_view import RerunView
from mavbridge.safety import Engagement
from mavbridge.smoothing import Smoothing, StickSmoother
from mavbridge.state import Freshness
from mavbridge.state_pacer import StatePacer
from mavbridge.stopping import StopRequest, stop_on_signals
from mavbridge.terminal import FlightScreen
from mavbridge.timing import FlightTiming, ObserverDrops, TimingReport, report_json
from mavbridge.vision_loop import VisionLoop
from mavbridge.vision_rate import AdaptiveRate
from mavbridge.workers import HungError, Worker
from policy.contract import Executable
from policy.loading import load_policy

RERUN_CAPACITY = 1000
"""Ticks that may wait for the viewer: ten seconds at 100 Hz."""
JOIN_S = 2.0
HANG_NS = NS_PER_S
"""Silence of the action loop after which the flight is ended for it."""


def fly(config: FlyConfig) -> int:
    """Run one flight to its end; returns the exit status.

    Raises:
        MavbridgeError: for whatever a person can have caused.
    """
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
    wanted = config.policy
    sys.path.append(str(Path.cwd()))  # a person's own module:Class lies where they work
    loaded = load_policy(
        wanted.policy,
        checkpoint=wanted.checkpoint,
        allow_untrained=wanted.allow_untrained,
        engine=wanted.engine,
        device=wanted.device,
        vision_device=wanted.vision_device,
        action_device=wanted.action_device,
        dual_rate=wanted.dual_rate,
        num_diffusion_steps=wanted.num_diffusion_steps,
        head_steps=wanted.head_steps,
        image_size=wanted.image_size,
        seed=wanted.seed,
        now_s=lambda: clock.now_ns() / NS_PER_S,
    )
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
        self._action_hz = rates.action_rate if self._is_dual else rates.rate
        self._vision_limits_hz = rates.visual_limits_hz if self._is_dual else (rates.rate,) * 2
        self._vision_hz = self._vision_limits_hz[1]
        self._timing = FlightTiming(action_hz=self._action_hz, vision_hz=self._vision_hz)
        self._screen = FlightScreen(
            console,
            action_hz=self._action_hz,
            vision_hz=self._vision_hz,
            readonly=config.link.readonly,
        )
        self._link = self._open_link()
        self._viewer = self._open_viewer()
        camera = self._open_camera()
        own: list[TickSink] = [self._timing, self._screen]
        if self._viewer is not None:
            own.append(self._viewer)
        cache = FeatureCache()
        look = AdaptiveRate(min_hz=self._vision_limits_hz[0], max_hz=self._vision_hz)
        if look.is_adaptive:
            own.append(look)
        self._sink = FanOut([*own, *sinks])
        self._vision = self._make_vision(camera, cache, look)
        self._action = self._make_action(cache)

    def _open_viewer(self) -> ObserverThread | None:
        if self._config.rerun == "off":
            return None
        view = RerunView(self._config.rerun, action_hz=self._action_hz, vision_hz=self._vision_hz)
        viewer = ObserverThread("mavbridge-rerun", view, capacity=RERUN_CAPACITY)
        self._stack.callback(viewer.close, JOIN_S)
        return viewer

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
        link = MavlinkLink(transport, self._clock, config, state_hz=max(self._action_hz, STATE_HZ))
        self._stack.callback(link.close)
        return link

    def _make_vision(self, camera: Camera, cache: FeatureCache, look: AdaptiveRate) -> VisionLoop:
        return VisionLoop(
            camera=camera,
            encode=self._executable.encode,
            cache=cache,
            sink=self._sink,
            clock=self._clock,
            period_ns=look.period_ns,
        )

    def _make_action(self, cache: FeatureCache) -> ActionLoop:
        config, contract = self._config, self._executable.contract
        action_period_ns = period_ns(self._action_hz)
        smoothing = Smoothing(max_slew_per_s=config.limits.max_slew, tau_s=config.limits.tau)
        pacer: Pacer
        if config.rates.pace == "state":
            pacer = StatePacer(self._clock, self._link, period_ns=action_period_ns)
        else:
            pacer = GridPacer(self._clock, period_ns=action_period_ns)
        return ActionLoop(
            clock=self._clock,
            pacer=pacer,
            link=self._link,
            cache=cache,
            act=self._executable.act,
            smoother=StickSmoother(smoothing),
            engagement=Engagement(
                wanted_mode=config.mode, arm=config.arm, readonly=config.link.readonly
            ),
            sink=self._sink,
            settings=ActionSettings(
                state_frame=contract.state_frame,
                since_exposure=contract.since_exposure,
                chunk_dt_s=contract.chunk_dt_s,
                history_len=contract.history_len,
                history_dt_s=contract.history_dt_s,
                freshness=_freshness(config.limits),
                max_feature_age_ns=round(config.limits.max_feature_age * NS_PER_S),
                lead_s=config.limits.tau,
                mode=config.mode,
                duration_ns=None if config.duration is None else round(config.duration * NS_PER_S),
            ),
        )

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
        if self._config.report is not None:
            self._config.report.write_text(report_json(report))

    def _report(self) -> TimingReport:
        drops = ObserverDrops(rerun=self._viewer.dropped if self._viewer else None, recorder=None)
        return self._timing.report(
            mode="dual" if self._is_dual else "single",
            engine=self._executable.engine,
            policy=self._executable.name,
            autopilot=self._link.autopilot,
            link=self._link.stats(),
            observer_drops=drops,
        )


def _freshness(limits: Limits) -> Freshness:
    return Freshness(
        attitude_ns=round(limits.max_attitude_age * NS_PER_S),
        velocity_ns=round(limits.max_velocity_age * NS_PER_S),
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
