"""One simulated flight of one course: the real bridge and its world on a stepped clock."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import cv2
import numpy as np

from mavbridge.config.flight import FlyConfig
from mavbridge.core.clock import NS_PER_S, period_ns
from mavbridge.core.errors import UserError
from mavbridge.core.observers import FanOut
from mavbridge.core.reasons import Code, because
from mavbridge.core.records import CameraImage, Solve, TickSink
from mavbridge.flight.plan import plan_flight
from mavbridge.flight.policy_loop import PolicyLoop
from mavbridge.flight.settings import link_settings
from mavbridge.flight.state import observation_ages_ns
from mavbridge.flight.telemetry_cache import TelemetryCache
from mavbridge.flight.vision_loop import vision_loops
from mavbridge.guard.loop import GuardLoop
from mavbridge.guard.values import EndRequest
from mavbridge.mavlink.link import MavlinkLink
from mavbridge.simulation.clock import AheadClock, SteppedClock, Stepper
from mavbridge.simulation.delays import Delays, Stalls
from mavbridge.simulation.network import (
    DelayedChannel,
    GuardStepper,
    MemoryPort,
    MemoryTransport,
    flight_process,
    sender,
)
from mavbridge.simulation.referee import RUN_OUT_S, EpisodeResult, Referee
from mavbridge.simulation.world import (
    MOUNTS,
    NOMINAL_VEHICLE,
    DelayedFeatureCache,
    DelayedSink,
    Exposure,
    SimulatedCamera,
    VehicleStepper,
    needed_params,
)
from policy.contract import Contract, FloatArray
from policy.protocol import PolicyRunner
from sitl.camera.fpv import FpvRenderer
from sitl.course import make_course
from sitl.simulated_vehicle import SimulatedVehicle
from sitl.vehicle.config import STEP_NS, VehicleConfig

MAX_TIME_S = 60.0
"""Default limit [s]: courses are some 80 m long, so a policy slower than 1.5 m/s fails."""
END_NS = 3 * NS_PER_S
"""Longest time for the guard to return the sticks."""
SIM_CAMERA_HZ = 30.0
"""Frame rate of the simulated camera, unless the visual rate is higher."""
SIM_CAMERA_PX = 224
"""Side of its frames in pixels, as ``python -m sitl`` sends them. The bridge resizes them like
those of a real camera."""


@dataclass(frozen=True, kw_only=True)
class SimulationSettings:
    """Settings of the bridge, and the delays of the world around it."""

    config: FlyConfig = field(default_factory=FlyConfig)
    """Flags of the flight, which always arms."""
    delays: Delays = field(default_factory=Delays)
    draw_images: bool = True
    """False: images stay black, for policies and sinks that use none."""
    least_camera_px: int = SIM_CAMERA_PX
    """Minimum side of the drawn frames [pixels], even if the policy wants smaller ones."""


class SimulatedFlight:
    """One flight of a vehicle over a course, flown by the bridge.

    The same arguments give the same stick bytes. Fly it once, and add watchers before. A scripted
    policy follows ``clock``; ``vehicle.ap.truth`` is the true state at any time, even within
    ``act``.
    """

    def __init__(
        self,
        *,
        course_seed: int,
        seed: int,
        laps: int = 1,
        settings: SimulationSettings | None = None,
        vehicle: VehicleConfig = NOMINAL_VEHICLE,
    ) -> None:
        """Put the vehicle on the course of ``sitl.course.make_course``.

        ``seed``, 0 or more, determines the delays and the phases of vehicle and camera; the
        vehicle's conditions also determine the look of the course.
        """
        self._settings = settings or SimulationSettings()
        self._course_seed = course_seed
        self._seed = seed
        self.clock = SteppedClock()
        # A real vehicle and bridge are not in phase; the phase stays constant during a flight.
        boot_ns = self.clock.now_ns() + int(self._random(6).integers(STEP_NS))
        self.course = make_course(course_seed, laps)
        self._vehicle_config = vehicle
        self.vehicle = SimulatedVehicle(
            links=1, boot_ns=boot_ns, config=vehicle, course=self.course
        )
        delays = self._settings.delays
        uplink = DelayedChannel(self.clock, delays.uplink.samples_ns(self._random(0)))
        downlink = DelayedChannel(self.clock, delays.downlink.samples_ns(self._random(1)))
        self._transport = MemoryTransport(to_vehicle=uplink, from_vehicle=downlink)
        self._downlink = downlink
        self._stalls = Stalls(delays.stall_ns, self.clock.now_ns(), self._random(9))
        self._stepper = VehicleStepper(
            self.clock, self.vehicle, boot_ns, to_vehicle=uplink, from_vehicle=downlink
        )
        self.step_watchers = self._stepper.watchers
        """Called after each step of the vehicle, every 2.5 ms."""
        self.exposure_watchers: list[Callable[[Exposure], None]] = []
        """Called at each exposure, including frames that are never read."""
        self.solve_watchers: list[Callable[[Solve], object]] = []
        """Called with each solve that made a chunk."""

    def _random(self, purpose: int) -> np.random.Generator:
        """Return random numbers for one purpose: changing one delay leaves the others alone."""
        return np.random.Generator(np.random.PCG64((self._seed, purpose)))

    def fly(
        self,
        runner: PolicyRunner,
        *,
        max_time_s: float = MAX_TIME_S,
        run_out_s: float = RUN_OUT_S,
        ends_by_stop: bool = True,
        sinks: tuple[TickSink, ...] = (),
        should_stop: Callable[[], bool] | None = None,
    ) -> EpisodeResult:
        """Arm, fly and return the sticks; ends after the last gate, a crash or ``max_time_s``.

        The runner must not remember earlier flights; ``max_time_s`` counts from its first action,
        ``run_out_s`` from the last gate. A policy that stops at the end hands the vehicle to the
        autopilot then, unless ``ends_by_stop`` is False.
        ``should_stop`` is called after each step of the vehicle.

        Raises:
            EpisodeInterruptedError: ``should_stop`` ended the flight.
            PeerError: the vehicle could not be engaged.
            PolicyError: the policy failed.
        """
        cv2.setNumThreads(1)  # same images on any machine, and no thread pool to wake
        referee = Referee(
            self.clock,
            self.vehicle,
            max_time_s=max_time_s,
            run_out_s=run_out_s,
            stops=ends_by_stop and runner.contract.stops_at_end,
            should_stop=should_stop,
        )
        self.step_watchers.append(referee.watch)
        guard = self._compose(runner, (referee, *sinks))
        while not referee.stop.is_set():
            if referee.has_stopped:  # the autopilot holds the place for the rest of the run-out
                guard.stop(EndRequest(reason=because(Code.POLICY_STOPPED), end="stopped"))
            self.clock.sleep_until_ns(self.clock.now_ns() + STEP_NS)
        guard.stop(EndRequest(reason=because(Code.DURATION)))
        end_ns = self.clock.now_ns() + END_NS
        while not guard.is_done and self.clock.now_ns() < end_ns:
            self.clock.sleep_until_ns(self.clock.now_ns() + STEP_NS)
        return referee.result(course_seed=self._course_seed, seed=self._seed)

    def _compose(self, runner: PolicyRunner, sinks: tuple[TickSink, ...]) -> GuardLoop:
        """Build the bridge on the stepped clock; its parts run as events from now on."""
        world, hop = self.clock, self._settings.delays.hop
        config = replace(self._settings.config, arm=True)
        plan = plan_flight(config, runner.contract, is_dual=runner.dual_rate)
        loops = plan.loops
        stalled_ns = self._stalls.end_ns
        to_guard = DelayedChannel(world, hop.samples_ns(self._random(7)), stalled_ns)
        to_flight = DelayedChannel(world, hop.samples_ns(self._random(8)), stalled_ns)
        flight_port = MemoryPort(outgoing=to_guard, incoming=to_flight)
        settings = replace(link_settings(config, loops), min_battery_percent=0.0)
        link = MavlinkLink(self._transport, world, settings)
        guard = GuardLoop(world, link, MemoryPort(outgoing=to_flight, incoming=to_guard))
        contract, policy_clock = runner.contract, AheadClock(world)
        for name, value in needed_params(contract, self._vehicle_config.autopilot).items():
            self.vehicle.params.set(name, value)
        vision_clocks = [AheadClock(world) for _ in contract.cameras]
        cameras = self._make_cameras(contract, camera_hz=max(loops.vision_hz, SIM_CAMERA_HZ))
        send = sender(world, policy_clock, flight_port)
        send(plan.guard)
        past_ns = observation_ages_ns(contract)[0]
        caches = [DelayedFeatureCache(world, span_ns=past_ns) for _ in cameras]
        runner = self._take_time(runner, vision_clocks, policy_clock)
        view = TelemetryCache(plan, sink=FanOut(sinks))
        visions = vision_loops(
            plan,
            view,
            encode=runner.encode,
            cameras=cameras,
            caches=caches,
            clocks=vision_clocks,
            sinks=[
                DelayedSink(world, FanOut(() if number else sinks))
                for number in range(len(cameras))
            ],
            watches_images=self._settings.draw_images,
        )
        policy = PolicyLoop(
            plan,
            runner,
            clock=policy_clock,
            view=view,
            caches=caches,
            send=send,
            watches=self.solve_watchers,
        )
        for clock, camera, vision in zip(vision_clocks, cameras, visions, strict=True):
            stepper = Stepper(world, clock, camera.has_frame, vision.step)
            camera.arrival_watchers.append(stepper.run)
        to_flight.on_arrival = flight_process(world, policy_clock, flight_port, policy, view)
        guard_stepper = GuardStepper(world, guard)
        to_guard.on_arrival = self._downlink.on_arrival = guard_stepper.step
        return guard

    def _make_cameras(self, contract: Contract, *, camera_hz: float) -> list[SimulatedCamera]:
        """Return the cameras of a policy; a single one looks ahead under any name.

        Raises:
            UserError: there is no camera of that name.
        """
        mounts = ["front"] if len(contract.cameras) == 1 else list(contract.cameras)
        if unknown := [name for name in mounts if name not in MOUNTS]:
            raise UserError(
                f"the simulator has no cameras {unknown}: a policy with several cameras takes some "
                f"of {', '.join(MOUNTS)} here"
            )
        conditions, settings = self._vehicle_config.conditions, self._settings
        width = max(contract.image_width, settings.least_camera_px)
        height = max(contract.image_height, settings.least_camera_px)
        every_ns = period_ns(camera_hz)
        black = np.zeros((height, width, 3), np.uint8)
        cameras = [
            SimulatedCamera(
                self.clock,
                lambda: self.vehicle.pose,
                FpvRenderer(self.course, width, height, conditions).render
                if settings.draw_images
                else lambda *_pose: black,
                period_ns=every_ns,
                phase_ns=int(self._random(10 * number + 2).integers(every_ns)),
                delays_ns=settings.delays.camera.samples_ns(self._random(10 * number + 3)),
                stalled_until_ns=self._stalls.end_ns,
                to_end_ns=round(conditions.frame_time_s / 2 * NS_PER_S),
                mount=MOUNTS[name],
            )
            for number, name in enumerate(mounts)
        ]
        cameras[0].exposure_watchers += self.exposure_watchers
        return cameras

    def _take_time(
        self, runner: PolicyRunner, vision_clocks: Sequence[AheadClock], policy_clock: AheadClock
    ) -> PolicyRunner:
        """Return the runner with calls that take simulated time.

        A single-rate policy runs its whole network for every action: each action takes the action's
        delay plus one image delay per camera.
        """
        vision = self._settings.delays.vision
        vision_ns = [
            vision.samples_ns(self._random(10 * number + 4)) for number in range(len(vision_clocks))
        ]
        action_ns = self._settings.delays.action.samples_ns(self._random(5))
        is_dual = runner.dual_rate

        def encode(rgb: CameraImage, camera: int = 0, /) -> FloatArray:
            vision_clocks[camera].ahead_ns += next(vision_ns[camera]) if is_dual else 0
            return runner.encode(rgb, camera)

        def act(encoded: FloatArray, state: FloatArray, history: FloatArray) -> FloatArray:
            policy_clock.ahead_ns += next(action_ns)
            policy_clock.ahead_ns += 0 if is_dual else sum(next(each_ns) for each_ns in vision_ns)
            return runner.act(encoded, state, history)

        return replace(runner, encode=encode, act=act)
