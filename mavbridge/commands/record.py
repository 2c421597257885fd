"""``mavbridge record``: a session that records what ``EpisodeControl`` wants, and its terminal."""

from collections import deque
from contextlib import ExitStack
from dataclasses import replace
from functools import partial

import cv2
import numpy as np
from rich.console import Console
from rich.text import Text

from mavbridge.camera.open import check_camera, open_cameras, require_present
from mavbridge.commands.config import RecordConfig
from mavbridge.commands.record_episodes import (
    KEYS,
    KEYS_HINT,
    LEAST_GB,
    QUIT_KEY,
    EpisodeControl,
    Episodes,
    disk_left_gb,
    prepare_out,
)
from mavbridge.config.flight import EnvelopeConfig, FlyConfig, LinkConfig
from mavbridge.config.policy import Rates
from mavbridge.core.address import parse_address
from mavbridge.core.clock import NS_PER_S, Clock, MonotonicClock
from mavbridge.core.errors import UserError
from mavbridge.core.observers import FanOut
from mavbridge.core.reasons import Code, because
from mavbridge.core.records import Tick
from mavbridge.core.stopping import StopRequest, Worker, stop_on_signals
from mavbridge.core.ticks import GuardTick
from mavbridge.core.vehicle import Sticks
from mavbridge.flight.feature_cache import FeatureCache
from mavbridge.flight.guard_process import start_guard
from mavbridge.flight.observers import open_viewer
from mavbridge.flight.plan import plan_flight
from mavbridge.flight.telemetry_cache import TelemetryCache
from mavbridge.flight.vision_loop import vision_loops
from mavbridge.guard.values import EndRequest
from mavbridge.observe.keyboard import Keyboard
from mavbridge.observe.output import patient_console
from mavbridge.observe.terminal import FlightScreen, age, number, rate_style
from policy.contract import Contract

STEP_S = 0.05
MAX_KEYS = 64
"""Capacity of the queue of keys for the next step; the oldest are dropped first."""
JOIN_S = 2.0
DISK_NS = NS_PER_S
"""Time between two checks of the disk."""
GUARD_END_S = 5.0
NOTHING = np.zeros((1, 1), np.float32)
LOW_GB = 1.0
"""Room on the disk below which it is shown as a warning."""
PILOTS = because(Code.PILOT_FLIES)
CONTRACT = Contract(feature_dim=1, arrays="numpy")
"""Meaning of the recorded sticks: those of a policy with the default contract, to which the
vehicle's own sticks are mapped."""


def record(config: RecordConfig) -> int:
    """Record until the user, a signal or a full disk ends it; return the exit status."""
    clock = MonotonicClock()
    parse_address(config.vehicle.connect)
    (source,) = config.camera.sources
    check_camera(source, latency_ms=config.camera.camera_latency)
    require_present(source)
    prepare_out(config.out)
    cv2.setNumThreads(1)
    with ExitStack() as signals, ExitStack() as stack:  # signals: handled until all is closed
        session = _Session(config, clock, patient_console(), stack)
        session.run(signals.enter_context(stop_on_signals(is_bounded=True)))
    return 0


def pilot_flight(config: RecordConfig) -> FlyConfig:
    """Return a flight without a policy that only listens, at the rates of the recording."""
    return FlyConfig(
        link=LinkConfig(**vars(config.vehicle), readonly=True),
        camera=replace(config.camera, camera=config.camera.sources),  # under no name but ours
        rates=Rates(
            action_rate=config.rate,
            stick_rate=config.rate,
            visual_rate=config.visual_rate,
            realtime=False,
        ),
        envelope=EnvelopeConfig(min_battery=0.0),
        rerun=config.rerun,
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
        self._control = EpisodeControl(on_arm=config.on_arm, channel=config.episode_channel)
        self._disk_gb, self._disk_due_ns = 0.0, 0
        self._told_missing: str | None = None
        """Why the last request for an episode was refused."""
        self._screen = RecordScreen(
            console, action_hz=config.rate, vision_hz=config.visual_rate, readonly=True
        )
        stack.callback(self._screen.close, JOIN_S)
        plan = plan_flight(pilot_flight(config), CONTRACT, is_dual=True)
        viewer = open_viewer(plan, stack)
        self._guard = start_guard(plan.config, clock, stack, pilot_hz=config.rate)
        self._guard.wait_until_open()
        cameras = open_cameras(
            plan.config.camera,
            CONTRACT,
            image_size=(config.camera_size, config.camera_size),
            clock=clock,
            report=lambda line: console.print(Text(line)),
            stack=stack,
        )
        self._episodes = Episodes(
            config.out,
            plan,
            clock=clock,
            autopilot=lambda: self._view.status.autopilot,
            report=self._screen.show_message,
        )
        sink = FanOut(filter(None, (self._screen, self._episodes, self._control, viewer)))
        self._view = PilotView(
            plan,
            sink=sink,
            samples=self._guard.samples,
            watch_packets=self._episodes.watch_packets,
        )
        self._images = FeatureCache()
        (self._vision,) = vision_loops(  # encodes nothing, but paces, stamps and judges the images
            plan,
            self._view,
            encode=lambda _image, _camera: NOTHING.copy(),
            cameras=cameras,
            caches=[self._images],
            clocks=[clock],
            sinks=[sink],
            watches_images=True,
        )
        self._guard.send(plan.guard)

    def run(self, stop: StopRequest) -> None:
        """Follow orders until one of them, a signal, a worker's death or the disk ends it."""
        vision = Worker("mavbridge-vision", self._vision.run)
        listener = Worker("mavbridge-guard", partial(self._guard.listen, view=self._view))
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
        mark = self._control.step(
            self._clock.now_ns(),
            armed=self._view.status.armed,
            is_recording=self._episodes.current is not None,
            keys=keys,
        )
        if mark is not None:
            self._episodes.mark(mark)
        if QUIT_KEY in keys:
            self._episodes.end("a key")
            return False
        self._follow()
        self._screen.shown = session_status(
            self._episodes,
            now_ns=self._clock.now_ns(),
            disk_gb=self._disk_gb,
            problem=self._missing() or self._doubt(),
        )
        wanted = self._config.episodes
        is_over = wanted is not None and self._episodes.counts.total() >= wanted
        return not is_over or self._control.may_mark

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
        status = self._view.status
        if status.mode is None:
            return "no vehicle yet"
        if self._view.telemetry.ned_from_body_wxyz is None:
            return "no attitude from the vehicle"
        if self._view.telemetry.velocity_ned_mps is None:
            return "no velocity from the vehicle: it has no position estimate"
        if status.rc_sticks is None and any(status.rc_channels_us):
            return f"the pilot's sticks cannot be read ({self._view.reason})"
        if status.rc_sticks is None:
            return "no sticks of a pilot: is the transmitter on?"
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


class PilotView(TelemetryCache):
    """``TelemetryCache`` of a vehicle that its pilot flies."""

    def _join(self, sent: GuardTick) -> Tick:
        """Return a tick of the pilot's, since no policy flies."""
        return replace(super()._join(sent), release_reason=PILOTS, phase="released")


class RecordScreen(FlightScreen):
    """``FlightScreen`` with a status line for the pilot. Any thread can replace ``shown``."""

    shown: tuple[Text, Text] | None = None
    """Begin and end of the status line; see ``session_status``."""

    def status_line(self) -> Text:
        """Return the current status. Call at ``STATUS_HZ``: rates are averages over calls."""
        camera_hz, shown, tick = self._vision.sample_hz(), self.shown, self._tick
        if shown is None or tick is None:
            return Text("waiting for the vehicle", style="dim")
        attitude_ns = None if tick.state is None else tick.state.attitude_ns
        line = Text(no_wrap=True, overflow="ellipsis")
        line.append(shown[0])
        line.append(f"  {tick.mode or 'mode unknown'} {'armed' if tick.armed else 'disarmed'}")
        line.append(f"  {_sticks(tick.rc_sticks)}")
        line.append(f"  state {age(tick.sent_ns, attitude_ns)}  camera ")
        line.append(f"{number(camera_hz, 1)} Hz", style=rate_style(camera_hz, self._target_hz[1]))
        return line.append(shown[1])


def session_status(
    episodes: Episodes, *, now_ns: int, disk_gb: float, problem: str | None
) -> tuple[Text, Text]:
    """Return the begin and the end of the status line.

    ``disk_gb`` is the room above --disk-reserve; ``problem`` a missing requirement, or a doubt
    about the value of the recording.
    """
    if episodes.current is None:
        begin = Text(f"next: episode {episodes.number}", style="bold yellow")
    else:
        seconds = (now_ns - episodes.current.begin_ns) / NS_PER_S
        begin = Text(f"RECORDING episode {episodes.number} {seconds:5.1f} s", style="bold red")
    counts = episodes.counts
    end = Text.assemble(
        (f"  disk {disk_gb:.1f} GB", "yellow" if disk_gb < LOW_GB else ""),
        f"  {counts[True]} good {counts[False]} bad {counts[None]} unmarked",
        ("" if problem is None else f"  {problem}", "bold yellow"),
    )
    return begin, end


def _sticks(sticks: Sticks | None) -> str:
    if sticks is None:
        return "no sticks"
    return " ".join(
        f"{name}{value:+.2f}" for name, value in zip(("T", "Y", "P", "R"), sticks, strict=True)
    )
