"""One recording session: opens everything, records what ``EpisodeControl`` wants, and closes."""

from collections import deque
from contextlib import ExitStack
from dataclasses import replace
from datetime import UTC, datetime

import cv2
import numpy as np
from rich.console import Console
from rich.text import Text

from mavbridge.camera.open import check_camera, open_camera, require_present
from mavbridge.commands.config import RecordConfig
from mavbridge.commands.record.episodes import (
    KEYS,
    KEYS_HINT,
    LEAST_GB,
    QUIT_KEY,
    EpisodeControl,
    Episodes,
    disk_left_gb,
    prepare_out,
)
from mavbridge.commands.record.view import (
    CONTRACT,
    STICKS_FRESH_NS,
    PilotView,
    RecordScreen,
    session_status,
)
from mavbridge.config.flight import FlyConfig, LinkConfig
from mavbridge.config.policy import Rates
from mavbridge.core.clock import NS_PER_S, Clock, MonotonicClock, wall_offset_ns
from mavbridge.core.errors import UserError
from mavbridge.core.observers import FanOut, ObserverThread
from mavbridge.core.provenance import command_line, git_revision, versions, without_secrets
from mavbridge.core.reasons import Code, because
from mavbridge.core.records import Camera, TickSink
from mavbridge.core.stopping import StopRequest, Worker, stop_on_signals
from mavbridge.flight.feature_cache import FeatureCache
from mavbridge.flight.guard_process import GuardProcess
from mavbridge.flight.plan import plan_flight
from mavbridge.flight.settings import link_settings
from mavbridge.flight.vision_loop import vision_loops
from mavbridge.guard.settings import GuardSettings
from mavbridge.guard.values import EndRequest
from mavbridge.mavlink.transport.sockets import make_transport
from mavbridge.observe.keyboard import Keyboard
from mavbridge.observe.output import patient_console
from mavbridge.observe.viewer import RerunView
from mavbridge.observe.viewer_layout import ViewedFlight
from mavbridge.recording.folder import FlightMeta

STEP_S = 0.05
MAX_KEYS = 64
"""Capacity of the queue of keys for the next step; the oldest are dropped first."""
JOIN_S = 2.0
RERUN_CAPACITY = 1000
DISK_NS = NS_PER_S
"""Time between two checks of the disk."""
GUARD_END_S = 5.0
NOTHING = np.zeros((1, 1), np.float32)


def record(config: RecordConfig) -> int:
    """Record until the user, a signal or a full disk ends it; return the exit status."""
    clock = MonotonicClock()
    make_transport(config.vehicle.connect, clock)
    (source,) = config.camera.sources
    check_camera(source, latency_ms=config.camera.camera_latency)
    require_present(source)
    prepare_out(config.out)
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    cv2.setNumThreads(1)
    with ExitStack() as signals, ExitStack() as stack:  # signals: handled until all is closed
        session = _Session(config, clock, patient_console(), stack)
        session.run(signals.enter_context(stop_on_signals(is_bounded=True)))
    return 0


def pilot_flight(config: RecordConfig) -> FlyConfig:
    """Return a flight without a policy that only listens, at the rates of the recording."""
    rates = Rates(
        action_rate=config.rate,
        stick_rate=config.rate,
        visual_rate=config.visual_rate,
        realtime=False,
    )
    link = LinkConfig(**vars(config.vehicle), readonly=True)
    return FlyConfig(link=link, camera=config.camera, rates=rates)


def listening_guard(config: RecordConfig, clock: Clock) -> GuardSettings:
    """Return settings of a guard that requests the pilot's sticks at the rate of the recording."""
    flight = pilot_flight(config)
    link = link_settings(flight, flight.rates.loops(is_dual=True))
    return GuardSettings(
        link=replace(link, pilot_hz=config.rate, stick_hz=0.0, min_battery_percent=0.0),
        realtime=False,
        keeps_packets=True,
        wall_offset_ns=wall_offset_ns(clock),
    )


class _Session:
    """One recording session. Every resource is pushed on the exit stack when it is opened."""

    def __init__(
        self, config: RecordConfig, clock: Clock, console: Console, stack: ExitStack
    ) -> None:
        self._config = config
        self._clock = clock
        self._stack = stack
        self._keys: deque[str] = deque(maxlen=MAX_KEYS)
        self._control = EpisodeControl(
            has_switch=config.episode_channel is not None, on_arm=config.on_arm
        )
        self._disk_gb, self._disk_due_ns = 0.0, 0
        self._told_missing: str | None = None
        """Why the last request for an episode was refused."""
        self._screen = RecordScreen(console, rate_hz=config.rate, vision_hz=config.visual_rate)
        stack.callback(self._screen.close, JOIN_S)
        viewer = () if config.rerun == "off" else (self._open_viewer(),)
        self._guard = GuardProcess(listening_guard(config, clock), clock)
        stack.callback(self._guard.close)
        self._guard.wait_until_open()
        camera = self._open_camera(console)
        self._episodes = Episodes(
            config.out,
            clock=clock,
            make_meta=self._meta,
            log_to=lambda log: self._view.log_to(log),
            autopilot=lambda: self._view.status.autopilot,
            wall_offset_ns=wall_offset_ns(clock),
            report=self._screen.show_message,
        )
        sink = FanOut((self._screen, self._episodes, *viewer))
        plan = plan_flight(pilot_flight(config), CONTRACT, is_dual=True)
        self._view = PilotView(plan, sink=sink, samples=self._guard.samples)
        self._images = FeatureCache()
        (self._vision,) = vision_loops(  # encodes nothing, but paces, stamps and judges the images
            plan,
            self._view,
            encode=lambda _image, _camera: NOTHING.copy(),
            cameras=[camera],
            caches=[self._images],
            clocks=[clock],
            sinks=[sink],
            watches_images=True,
        )
        self._guard.send(plan.guard)

    def _open_camera(self, console: Console) -> Camera:
        wanted = self._config.camera
        camera = open_camera(
            wanted.sources[0],
            image_size=(self._config.camera_size, self._config.camera_size),
            clock=self._clock,
            timeout_s=wanted.camera_timeout,
            latency_ms=wanted.camera_latency,
            report=lambda line: console.print(Text(line)),
            is_depth=False,
        )
        self._stack.callback(camera.close)
        return camera

    def _open_viewer(self) -> TickSink:
        rate = self._config.rate
        flight = ViewedFlight(vision_hz=self._config.visual_rate, chunk_hz=rate, stick_hz=rate)
        viewer = ObserverThread("mavbridge-rerun", capacity=RERUN_CAPACITY)
        viewer.start(RerunView(self._config.rerun, flight, is_live=True))
        self._stack.callback(viewer.close, JOIN_S)
        return viewer

    def _meta(self, begin_ns: int) -> FlightMeta:
        wall_s = (begin_ns + wall_offset_ns(self._clock)) / NS_PER_S
        return FlightMeta(
            started_at=datetime.fromtimestamp(wall_s, UTC).isoformat(),
            start_ns=begin_ns,
            source="pilot",
            policy=None,
            engine=None,
            mode="dual",
            action_hz=self._config.rate,
            visual_hz=self._config.visual_rate,
            contract=CONTRACT,
            command=command_line(),
            versions=versions(),
            git_revision=git_revision(),
            cameras={"front": without_secrets(self._config.camera.sources[0])},
        )

    def run(self, stop: StopRequest) -> None:
        """Follow orders until one of them, a signal, a worker's death or the disk ends it."""
        vision = Worker("mavbridge-vision", self._vision.run)
        listener = Worker("mavbridge-guard", lambda ended: self._guard.listen(ended, self._view))
        for worker in (vision, listener):
            self._stack.callback(worker.join, JOIN_S)
            worker.start()
        keyboard = Keyboard(self._keys.append, keys=KEYS)
        self._stack.callback(keyboard.stop, JOIN_S)
        has_keys = keyboard.start()
        self._screen.start(hint=KEYS_HINT if has_keys else None)
        reason = "a signal"
        try:
            while not stop.wait(STEP_S):
                if not (listener.is_alive and vision.is_alive):
                    reason = "the camera's end" if listener.is_alive else "the link's end"
                    break
                if not self._step():
                    break
        except OSError as error:
            reason = "an error"
            raise UserError(f"--out {self._config.out}: {error}") from error
        finally:
            self._episodes.end(reason)
        counts, out = self._episodes.counts, self._config.out
        self._screen.show_message(
            f"{counts.total()} episodes recorded in {out}: {counts[True]} good, "
            f"{counts[False]} bad, {counts[None]} not marked"
        )
        self._guard.send(EndRequest(reason=because(Code.FINISHED, what="recording")))
        listener.ends_within(GUARD_END_S)

    def _step(self) -> bool:
        """Update the episodes and the status line; return False when the session is over."""
        self._look_at_disk()
        keys = "".join(self._keys.popleft() for _ in range(len(self._keys)))
        status, channel = self._view.status, self._config.episode_channel
        has_channel = channel is not None and len(status.rc_channels_us) >= channel
        mark = self._control.step(
            self._clock.now_ns(),
            armed=status.armed,
            switch_us=status.rc_channels_us[channel - 1] if channel and has_channel else 0,
            keys=keys,
        )
        if mark is not None:
            self._episodes.mark(mark)
        if QUIT_KEY in keys:
            self._episodes.end("a key")
            return False
        self._follow()
        self._screen.sticks.set(self._view.stick_packets, self._view.sticks_ns)
        self._screen.shown = session_status(
            self._episodes,
            now_ns=self._clock.now_ns(),
            disk_gb=self._disk_gb,
            problem=self._missing() or self._doubt(),
        )
        wanted = self._config.episodes
        return wanted is None or self._episodes.counts.total() < wanted

    def _follow(self) -> None:
        """Begin or end an episode as the control wants it."""
        control, episode = self._control, self._episodes.current
        if episode is not None and (obstacle := episode.obstacle) is not None:
            control.wanted = None
            self._episodes.end(obstacle)
        elif episode is not None and control.wanted is None:
            self._episodes.end(control.ended_by)
        if control.wanted is None:
            self._told_missing = None
        if control.wanted is None or self._episodes.current is not None:
            return
        missing = self._missing()
        if missing is None and self._disk_gb < LEAST_GB:
            missing = f"room on the disk for {LEAST_GB:g} GB above --disk-reserve"
        told, self._told_missing = self._told_missing, missing
        if missing is not None:
            if missing != told:
                self._screen.show_message(f"not recording: {missing}")
            return
        self._episodes.begin()
        doubt = self._doubt()
        begun = f"episode {self._episodes.number} begins ({control.wanted})"
        self._screen.show_message(begun if doubt is None else f"{begun}; {doubt}")

    def _missing(self) -> str | None:
        """Return the requirement of a demonstration that is missing, or None."""
        if self._view.status.mode is None:
            return "no vehicle yet"
        if self._view.telemetry.ned_from_body_wxyz is None:
            return "no attitude from the vehicle"
        if self._view.telemetry.velocity_ned_mps is None:
            return "no velocity from the vehicle: it has no position estimate"
        if self._clock.now_ns() - self._view.sticks_ns > STICKS_FRESH_NS:
            return "no sticks of a pilot: is the transmitter on?"
        if self._view.status.rc_sticks is None:
            return f"the pilot's sticks cannot be read ({self._view.reason})"
        return None

    def _doubt(self) -> str | None:
        """Return why the current recording is of doubtful value, or None."""
        image, mode = self._images.latest(), self._view.status.mode
        if image is not None and image.fault is not None:
            return str(image.fault)
        if self._view.status.armed and mode is not None and mode not in CONTRACT.modes:
            return f"sticks mean something else in {mode} than in {CONTRACT.modes[0]}"
        return None

    def _look_at_disk(self) -> None:
        now_ns = self._clock.now_ns()
        if now_ns < self._disk_due_ns:
            return
        self._disk_due_ns = now_ns + DISK_NS
        self._disk_gb = disk_left_gb(self._config.out, self._config.disk_reserve)
        if self._disk_gb == 0.0:
            self._control.wanted = None
            self._episodes.end("the disk, which is full up to --disk-reserve")
