"""What surrounds the bridge in an episode: a vehicle, a camera on it, the network between."""

from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from mavbridge.core.records import Frame, ImageArray
from mavbridge.simulation.clock import SteppedClock
from mavbridge.simulation.wire import Path
from sitl.camera.fpv import FpvRenderer
from sitl.course.layout import Course, make_course
from sitl.rotation import Quat, Vec3
from sitl.simulated_vehicle import Pose, SimulatedVehicle
from sitl.vehicle.autopilot import STEP_NS, VehicleConfig
from sitl.vehicle.conditions import NOMINAL, Conditions, random_conditions
from sitl.vehicle.dynamics import BodyState

QUICK_BOOT = VehicleConfig(estimator_ready_s=0.5, position_ready_s=0.5)
"""The handshake alone takes longer: nobody waits for an estimator that is simulated anyway."""


class Renderer(Protocol):
    """Draws what a camera on the vehicle sees."""

    def render(self, position_ned_m: Vec3, ned_from_body_wxyz: Quat) -> ImageArray:
        """The view as [H, W, 3] uint8 RGB, a new array."""
        ...


class Blindfold:
    """A ``Renderer`` that shows nothing, at no cost."""

    def __init__(self, width: int, height: int) -> None:
        self._black = np.zeros((height, width, 3), np.uint8)

    def render(self, position_ned_m: Vec3, ned_from_body_wxyz: Quat) -> ImageArray:
        """Black; always the same array."""
        return self._black


@dataclass(frozen=True, kw_only=True)
class Scene:
    """The simulated half of an episode."""

    vehicle: SimulatedVehicle
    """With one link, and with ``course`` in its log."""
    course: Course
    make_renderer: Callable[[int, int], Renderer]
    """(width, height) in pixels."""


class BuildScene(Protocol):
    """How an episode gets its scene; replace it to fly under other conditions."""

    def __call__(self, *, course_seed: int, seed: int, boot_ns: int) -> Scene:
        """``seed`` decides whatever is random beside the course."""
        ...


def varied_scene(conditions: Conditions) -> BuildScene:
    """The vehicle and the view as ``python -m sitl`` has them under these conditions."""

    def build(*, course_seed: int, seed: int, boot_ns: int) -> Scene:
        course = make_course(course_seed)
        config = replace(QUICK_BOOT, conditions=conditions)
        return Scene(
            vehicle=SimulatedVehicle(links=1, boot_ns=boot_ns, config=config, course=course),
            course=course,
            make_renderer=lambda width, height: FpvRenderer(course, width, height, conditions),
        )

    return build


def random_scene(conditions_seed: int) -> BuildScene:
    """As ``python -m sitl --conditions SEED``.

    Raises:
        UsageError: the seed is negative.
    """
    return varied_scene(random_conditions(conditions_seed))


nominal_scene = varied_scene(NOMINAL)
"""Nothing is random."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Exposure:
    """The truth behind a frame."""

    frame_id: int
    captured_ns: int
    body: BodyState


class VehicleProcess:
    """Steps the vehicle every 2.5 ms, as its own process would, and serves its end of the link."""

    def __init__(
        self,
        clock: SteppedClock,
        vehicle: SimulatedVehicle,
        boot_ns: int,
        *,
        to_vehicle: Path,
        from_vehicle: Path,
    ) -> None:
        self._clock = clock
        self._vehicle = vehicle
        self._to_vehicle = to_vehicle
        self._from_vehicle = from_vehicle
        self.watchers: list[Callable[[], None]] = []
        """Called after each step."""
        clock.schedule(boot_ns + STEP_NS, self._step)

    def _step(self) -> None:
        now_ns = self._clock.now_ns()
        for arrived_ns, data in self._to_vehicle.arrived():
            self._vehicle.receive(0, data, arrived_ns)
        self._vehicle.step(now_ns)
        outgoing = self._vehicle.take_outgoing(0)
        if outgoing:
            self._from_vehicle.send(outgoing)
        for watch in self.watchers:
            watch()
        self._clock.schedule(now_ns + STEP_NS, self._step)


class LockstepCamera:
    """A ``ports.Camera`` on the vehicle; a frame is drawn when it is read, of the pose at exposure.

    As in ``sitl``, a frame shows the vehicle's last step, and its stamp is that step's.
    """

    def __init__(
        self,
        clock: SteppedClock,
        pose: Callable[[], Pose],
        renderer: Renderer,
        *,
        period_ns: int,
        phase_ns: int,
        delays_ns: Iterator[int],
    ) -> None:
        self._clock = clock
        self._pose = pose
        self._renderer = renderer
        self._period_ns = period_ns
        self._delays_ns = delays_ns
        self._arrived: deque[Exposure] = deque(maxlen=1)
        self._frames = 0
        self.dropped_frames = 0
        self.exposure_watchers: list[Callable[[Exposure], None]] = []
        self.arrival_watchers: list[Callable[[], None]] = []
        clock.schedule(clock.now_ns() + phase_ns, self._expose)

    @property
    def has_frame(self) -> bool:
        """One has arrived that was not read."""
        return bool(self._arrived)

    def _expose(self) -> None:
        pose = self._pose()
        self._frames += 1
        exposure = Exposure(frame_id=self._frames, captured_ns=pose.stamp_ns, body=pose.body)
        for watch in self.exposure_watchers:
            watch(exposure)
        now_ns = self._clock.now_ns()
        self._clock.schedule(now_ns + next(self._delays_ns), lambda: self._arrive(exposure))
        self._clock.schedule(now_ns + self._period_ns, self._expose)

    def _arrive(self, exposure: Exposure) -> None:
        held = self._arrived[0] if self._arrived else None
        self.dropped_frames += held is not None
        if held is None or held.frame_id < exposure.frame_id:
            self._arrived.append(exposure)
        for watch in self.arrival_watchers:
            watch()

    def read(self, timeout_ns: int) -> Frame | None:
        """Newest frame that was not returned before; never waits, since it is asked in time."""
        if not self._arrived:
            return None
        exposure = self._arrived.popleft()
        body = exposure.body
        rgb = self._renderer.render(body.position_ned_m, body.ned_from_body_wxyz)
        rgb.setflags(write=False)
        return Frame(frame_id=exposure.frame_id, captured_ns=exposure.captured_ns, rgb=rgb)

    def close(self) -> None:
        """Nothing to free."""
