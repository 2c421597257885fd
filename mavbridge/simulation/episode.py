"""One flight of one course: composed like a real one, with the world on its clock."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace

import cv2
import numpy as np

from mavbridge.config.flight import FlyConfig, Limits, LinkConfig
from mavbridge.config.rates import SIM_CAMERA_HZ, SIM_CAMERA_PX, Rates, period_ns
from mavbridge.core.errors import UserError
from mavbridge.core.ports import TickSink
from mavbridge.flight.action_loop import ActionLoop
from mavbridge.flight.bridge import build_bridge
from mavbridge.mavlink.link import MavlinkLink
from mavbridge.simulation.clock import AheadClock, SteppedClock
from mavbridge.simulation.delays import Delay, Delays, draws_ns
from mavbridge.simulation.referee import Referee
from mavbridge.simulation.result import EpisodeResult
from mavbridge.simulation.vision import LateEncoder, LateFeatureCache, LateSink, VisionProcess
from mavbridge.simulation.wire import MemoryTransport, Path
from mavbridge.simulation.world import (
    Blindfold,
    BuildScene,
    Exposure,
    LockstepCamera,
    VehicleProcess,
    nominal_scene,
)
from policy.contract import Executable, FloatArray
from sitl.vehicle.autopilot import STEP_NS

MAX_TIME_S = 60.0
"""For a course of some 80 m: a policy slower than 1.5 m/s does not race."""
MODE = "ALT_HOLD"


@dataclass(frozen=True, kw_only=True)
class Setup:
    """How the bridge is set up, and how fast the world around it is."""

    rates: Rates = field(default_factory=Rates)
    limits: Limits = field(default_factory=Limits)
    delays: Delays = field(default_factory=Delays)
    draw_images: bool = True
    """False: nobody looks at the images, neither the policy nor a sink; they stay black."""
    least_camera_px: int = SIM_CAMERA_PX
    """Least side of the frames that are drawn, however small the policy wants them."""


def run_episode(
    executable: Executable,
    *,
    course_seed: int,
    seed: int,
    setup: Setup | None = None,
    max_time_s: float = MAX_TIME_S,
    sinks: tuple[TickSink, ...] = (),
    build_scene: BuildScene = nominal_scene,
) -> EpisodeResult:
    """Fly one course; the same arguments give the same stick bytes.

    Raises:
        as ``Episode.fly``.
    """
    episode = Episode(course_seed=course_seed, seed=seed, setup=setup, build_scene=build_scene)
    return episode.fly(executable, max_time_s=max_time_s, sinks=sinks)


class Episode:
    """A vehicle on a course, and a bridge that will fly it, once.

    Before ``fly`` anything can be hung on. ``vehicle.ap.truth`` is the true state at any moment,
    also from within an executable's ``act``; ``clock`` is what a scripted policy has to follow;
    ``watch_exposures`` tells the truth behind each frame.
    """

    def __init__(
        self,
        *,
        course_seed: int,
        seed: int,
        setup: Setup | None = None,
        build_scene: BuildScene = nominal_scene,
    ) -> None:
        self._setup = setup or Setup()
        self._course_seed = course_seed
        self._seed = seed
        self._random = _RandomStreams(seed)
        self.clock = SteppedClock()
        # Two computers never tick in phase; and the phase, once there, stays for a whole flight.
        boot_ns = self.clock.now_ns() + self._random.below(6, STEP_NS)
        self._scene = build_scene(course_seed=course_seed, seed=seed, boot_ns=boot_ns)
        self.vehicle = self._scene.vehicle
        self.course = self._scene.course
        delays = self._setup.delays
        uplink = Path(self.clock, self._random.draws_ns(0, delays.uplink))
        downlink = Path(self.clock, self._random.draws_ns(1, delays.downlink))
        self._transport = MemoryTransport(self.clock, to_vehicle=uplink, from_vehicle=downlink)
        self._process = VehicleProcess(
            self.clock, self.vehicle, boot_ns, to_vehicle=uplink, from_vehicle=downlink
        )
        self._exposure_watchers: list[Callable[[Exposure], None]] = []
        self._has_flown = False

    def watch_exposures(self, watch: Callable[[Exposure], None]) -> None:
        """Call ``watch`` at each exposure, also of frames that nobody will read."""
        self._exposure_watchers.append(watch)

    def watch_steps(self, watch: Callable[[], None]) -> None:
        """Call ``watch`` after each step of the vehicle, every 2.5 ms."""
        self._process.watchers.append(watch)

    def fly(
        self,
        executable: Executable,
        *,
        max_time_s: float = MAX_TIME_S,
        sinks: tuple[TickSink, ...] = (),
        should_stop: Callable[[], bool] | None = None,
    ) -> EpisodeResult:
        """Arm, fly, give the sticks back; ends with the last gate, a crash, or the time.

        Args:
            executable: what flies. It must not remember earlier episodes.
            max_time_s: counted from the policy's first action.
            sinks: see every tick and vision tick, in order of time.
            should_stop: asked often; True ends the episode without a result.

        Raises:
            EpisodeInterruptedError: ``should_stop`` said so.
            PeerError: the vehicle could not be engaged.
            PolicyError: the policy failed.
        """
        if self._has_flown:
            raise UserError("an episode is flown once: make another one")
        self._has_flown = True
        cv2.setNumThreads(1)  # for the same images on any machine, and no pool to wake for them
        referee = Referee(self.clock, self.vehicle, max_time_s=max_time_s, should_stop=should_stop)
        self.watch_steps(referee.watch)
        self._compose(executable, (referee, *sinks)).run(referee.stop)
        return referee.result(course_seed=self._course_seed, seed=self._seed)

    def _compose(self, executable: Executable, sinks: tuple[TickSink, ...]) -> ActionLoop:
        """Build the bridge, with its vision loop on the clock's queue."""
        config = FlyConfig(
            link=LinkConfig(connect="lockstep"),
            rates=self._setup.rates,
            limits=self._setup.limits,
            mode=MODE,
            arm=True,
        )
        loops = config.rates.loops(is_dual=executable.dual_rate)
        vision_clock = AheadClock(self.clock)
        camera = self._make_camera(executable, camera_hz=max(loops.max_vision_hz, SIM_CAMERA_HZ))
        bridge = build_bridge(
            config,
            self._take_time(executable, vision_clock),
            clock=self.clock,
            link=MavlinkLink(self._transport, self.clock, config.link, state_hz=loops.state_hz),
            camera=camera,
            sinks=sinks,
            cache=LateFeatureCache(self.clock),
            vision_clock=vision_clock,
            delay_vision=lambda sink: LateSink(self.clock, sink),
        )
        VisionProcess(self.clock, vision_clock, camera, bridge.vision)
        return bridge.action

    def _make_camera(self, executable: Executable, *, camera_hz: float) -> LockstepCamera:
        camera_period_ns = period_ns(camera_hz)
        contract, least_px = executable.contract, self._setup.least_camera_px
        width, height = max(contract.image_width, least_px), max(contract.image_height, least_px)
        draw = self._setup.draw_images
        camera = LockstepCamera(
            self.clock,
            lambda: self.vehicle.pose,
            self._scene.make_renderer(width, height) if draw else Blindfold(width, height),
            period_ns=camera_period_ns,
            phase_ns=self._random.below(2, camera_period_ns),
            delays_ns=self._random.draws_ns(3, self._setup.delays.camera),
        )
        camera.exposure_watchers += self._exposure_watchers
        return camera

    def _take_time(self, executable: Executable, vision_clock: AheadClock) -> Executable:
        """The same executable, whose calls take simulated time.

        Without a fast path the whole network runs for every action, which then takes both times.
        """
        vision_ns = self._random.draws_ns(4, self._setup.delays.vision)
        action_ns = self._random.draws_ns(5, self._setup.delays.action)
        is_dual = executable.dual_rate
        encoder = LateEncoder(
            executable.encode, vision_clock, vision_ns if is_dual else iter(lambda: 0, 1)
        )

        def act(
            encoded: FloatArray, state: FloatArray, history: FloatArray, elapsed_s: float | None
        ) -> FloatArray:
            chunk = executable.act(encoder.resolve(encoded), state, history, elapsed_s)
            took_ns = next(action_ns) + (0 if is_dual else next(vision_ns))
            self.clock.sleep_until_ns(self.clock.now_ns() + took_ns)
            return chunk

        return replace(executable, encode=encoder.encode, act=act)


class _RandomStreams:
    """Independent random numbers by purpose: changing one delay leaves the others' draws alone."""

    def __init__(self, seed: int) -> None:
        if seed < 0:
            raise UserError(f"a seed is a non-negative integer, got {seed}")
        self._seed = seed

    def _generator(self, purpose: int) -> np.random.Generator:
        return np.random.Generator(np.random.PCG64((self._seed, purpose)))

    def draws_ns(self, purpose: int, delay: Delay) -> Iterator[int]:
        """Durations of one kind."""
        return draws_ns(delay, self._generator(purpose))

    def below(self, purpose: int, limit: int) -> int:
        """One integer from 0 on."""
        return int(self._generator(purpose).integers(limit))
