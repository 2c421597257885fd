"""One real flight: opens what the flags name, runs both loops, and stops them in reverse order."""

import threading
from collections.abc import Callable
from contextlib import ExitStack

import cv2
from rich.console import Console
from rich.text import Text

from mavbridge.camera.open import check_camera, open_camera
from mavbridge.config.flight import FlyConfig
from mavbridge.config.rates import STATUS_HZ
from mavbridge.core.clock import NS_PER_S, Clock, MonotonicClock
from mavbridge.core.errors import PeerError
from mavbridge.core.files import require_writable
from mavbridge.core.ports import TickSink
from mavbridge.core.realtime import settle_process, settle_thread
from mavbridge.core.stopping import StopRequest, stop_on_signals
from mavbridge.core.workers import HungError, Worker
from mavbridge.flight.bridge import build_bridge
from mavbridge.flight.link_settings import link_settings
from mavbridge.flight.observers import FlightObservers
from mavbridge.flight.policies import check_configured_policy, load_configured_policy
from mavbridge.mavlink.link import MavlinkLink
from mavbridge.mavlink.transport.sockets import make_transport
from mavbridge.recording.folder import prepare_folder
from policy.contract import Executable

JOIN_S = 2.0
HANG_NS = NS_PER_S
"""Silence of the action loop after which the flight is ended for it."""


def fly(config: FlyConfig) -> int:
    """Run one flight to its end; returns the exit status.

    Raises:
        MavbridgeError: anything that the user, the vehicle or the policy got wrong.
    """
    clock = MonotonicClock()
    # First what takes no time to check: weights take seconds to load.
    make_transport(config.link.connect, clock)
    check_camera(config.camera.source)
    check_configured_policy(config.policy)
    require_writable(config.report, "--report")
    if config.record is not None:
        prepare_folder(config.record)
    console = Console(stderr=True, emoji=False)
    loaded = load_configured_policy(config.policy, clock)
    for note in loaded.notes:
        console.print(Text(note, style="yellow"))
    fly_executable(config, loaded.executable, clock=clock, console=console)
    return 0


def fly_executable(
    config: FlyConfig,
    executable: Executable,
    *,
    clock: Clock,
    console: Console,
    sinks: tuple[TickSink, ...] = (),
) -> None:
    """Run one flight of a policy that is loaded already; ``sinks`` see every tick."""
    # OpenCV would print its own complaint about a camera before, and instead of, ours.
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    cv2.setNumThreads(1)  # both loops may share two cores: no pool of threads under either
    flight: _Flight | None = None
    try:
        with ExitStack() as stack:
            flight = _Flight(config, clock, console, executable, sinks, stack)
            # Only now: until a stick can have been taken, a signal may simply end the process.
            stop = stack.enter_context(stop_on_signals())
            flight.run(stop)
    finally:
        if flight is not None:
            flight.observers.finish(flight.link)


class _Flight:
    """One flight; everything that is opened goes on the exit stack at once."""

    def __init__(
        self,
        config: FlyConfig,
        clock: Clock,
        console: Console,
        executable: Executable,
        sinks: tuple[TickSink, ...],
        stack: ExitStack,
    ) -> None:
        self._rates = config.rates
        self._clock = clock
        self._stack = stack
        self._has_hung = False
        loops = config.rates.loops(is_dual=executable.dual_rate)
        self.observers = FlightObservers(config, executable, clock=clock, console=console)
        stack.callback(self.observers.close_recorder)  # after the link: it records the release
        self.link = MavlinkLink(
            make_transport(config.link.connect, clock),
            clock,
            link_settings(config.link, state_hz=loops.state_hz),
            packet_log=self.observers.packets,
        )
        stack.callback(self.link.close)
        self.observers.open_viewer(stack)
        camera = open_camera(
            config.camera.source, image_size=executable.contract.image_height, clock=clock
        )
        stack.callback(camera.close)
        self.observers.open_recorder(self.link)
        self._bridge = build_bridge(
            config,
            executable,
            clock=clock,
            link=self.link,
            camera=camera,
            sinks=(*self.observers.sinks, *sinks),
        )

    def run(self, stop: StopRequest) -> None:
        """Fly until the action loop ends, the camera dies, or a signal comes."""
        rates, screen = self._rates, self.observers.screen
        see = self._scheduled(self._bridge.vision.run, realtime=False, cpu=rates.vision_cpu)
        act = self._scheduled(
            self._bridge.action.run, realtime=rates.realtime, cpu=rates.action_cpu
        )
        vision, action = Worker("mavbridge-vision", see), Worker("mavbridge-action", act)
        settle_process()
        # Joined in reverse: the sticks are released before anything that feeds them is closed.
        self._stack.callback(vision.join, JOIN_S)
        self._stack.callback(self._end, action)
        vision.start()
        action.start()
        with screen.live():
            while action.is_alive and vision.is_alive and not stop.is_set():
                screen.refresh()
                self._watch(action)
                stop.wait(1 / STATUS_HZ)

    def _scheduled(
        self, run: Callable[[threading.Event], None], *, realtime: bool, cpu: int | None
    ) -> Callable[[threading.Event], None]:
        """Wrap a loop so that its thread first asks for its scheduling."""

        def run_settled(stop: threading.Event) -> None:
            refusal = settle_thread(realtime=realtime, cpu=cpu)
            if refusal is not None:
                self.observers.screen.show_message(refusal)
            run(stop)

        return run_settled

    def _watch(self, action: Worker) -> None:
        """End the flight when the action loop hangs: its last sticks must not stay."""
        idle_ns = self._clock.now_ns() - self._bridge.action.alive_ns
        if action.is_alive and idle_ns > HANG_NS:
            self.link.force_release()
            self._has_hung = True
            hung = f"the action loop has hung for {idle_ns / NS_PER_S:.1f} s"
            raise PeerError(f"{hung}: the policy is too slow for this machine, or stuck")

    def _end(self, action: Worker) -> None:
        try:
            action.join(JOIN_S)
        except HungError:
            self.link.force_release()
            if not self._has_hung:  # else that is being reported already
                raise
