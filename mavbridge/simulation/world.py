"""World around the bridge in a simulated flight: the vehicle, its cameras and the vision loop.

The vision loop runs as an event when a frame arrives; its results are published at their stamps.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

from mavbridge.config.episodes import ConditionsKind
from mavbridge.core.records import Event, FeatureFrame, Frame, ImageArray, TickSink, VisionTick
from mavbridge.flight.feature_cache import FeatureCache
from mavbridge.simulation.clock import SteppedClock
from mavbridge.simulation.network import DelayedChannel
from policy.contract import Contract
from sitl.ardupilot.guided import OPTION_THRUST
from sitl.simulated_vehicle import Pose, SimulatedVehicle
from sitl.vehicle.conditions import NOMINAL, Conditions, random_conditions
from sitl.vehicle.config import STEP_NS, AutopilotName, VehicleConfig
from sitl.vehicle.dynamics import BodyState
from sitl.vehicle.looks import held_out_conditions, unseen_conditions
from sitl.vehicle.rotation import IDENTITY, Quat, Vec3, conjugate, from_euler, multiply, rotate

MOUNTS: dict[str, Quat] = {
    "front": IDENTITY,
    "down": from_euler(0.0, -math.pi / 2, 0.0),
    "left": from_euler(0.0, 0.0, -math.pi / 2),
    "right": from_euler(0.0, 0.0, math.pi / 2),
    "back": from_euler(0.0, 0.0, math.pi),
}
"""Camera directions by name for policies with several cameras: body_from_mount. Each camera has the
tilt of the front one; in the image of ``down``, the upper edge is ahead."""
NOMINAL_VEHICLE = VehicleConfig(estimator_ready_s=0.5, position_ready_s=0.5)
"""Nominal vehicle, ready at once: the handshake alone takes longer than half a second."""
DRAWN_CONDITIONS: dict[ConditionsKind, Callable[[int], Conditions]] = {
    "nominal": lambda seed: NOMINAL,
    "random": random_conditions,
    "held-out": held_out_conditions,
    "unseen": unseen_conditions,
}
"""Conditions of an evaluated flight by the seed of its course; no demonstration has the same."""


def make_vehicle(
    *, autopilot: AutopilotName, gains: float = 1.0, conditions: Conditions = NOMINAL
) -> VehicleConfig:
    """Return the configuration of a vehicle for evaluating a policy.

    Args:
        autopilot: its firmware.
        gains: factor on ArduCopter's lean, yaw rate and climb rate at full stick.
        conditions: airframe, settings, wind, light and lens.
    """
    scaled = replace(
        conditions,
        angle_max_cdeg=gains * conditions.angle_max_cdeg,
        pilot_yaw_rate_degps=gains * conditions.pilot_yaw_rate_degps,
        pilot_speed_up_cmps=gains * conditions.pilot_speed_up_cmps,
        pilot_speed_down_cmps=gains * conditions.pilot_speed_down_cmps,
    )
    return replace(NOMINAL_VEHICLE, autopilot=autopilot, conditions=scaled)


def needed_params(contract: Contract, autopilot: AutopilotName) -> dict[str, float]:
    """Return parameters without which a simulated vehicle misinterprets the contract's actions."""
    has_thrust = contract.action in ("rates", "attitude")
    return {"GUID_OPTIONS": OPTION_THRUST} if has_thrust and autopilot == "ardupilot" else {}


@dataclass(frozen=True, slots=True, kw_only=True)
class Exposure:
    """True state of the vehicle at the exposure of a frame."""

    frame_id: int
    captured_ns: int
    body: BodyState


class VehicleStepper:
    """Steps the vehicle every 2.5 ms and serves its end of the link."""

    def __init__(
        self,
        clock: SteppedClock,
        vehicle: SimulatedVehicle,
        boot_ns: int,
        *,
        to_vehicle: DelayedChannel,
        from_vehicle: DelayedChannel,
    ) -> None:
        self._clock = clock
        self._vehicle = vehicle
        self._to_vehicle = to_vehicle
        self._from_vehicle = from_vehicle
        self.watchers: list[Callable[[], None]] = []
        clock.schedule(boot_ns + STEP_NS, self._step)

    def _step(self) -> None:
        now_ns = self._clock.now_ns()
        for arrived_ns, data in self._to_vehicle.receive():
            self._vehicle.receive(0, data, arrived_ns)
        self._vehicle.step(now_ns)
        outgoing = self._vehicle.take_outgoing(0)
        if outgoing:
            self._from_vehicle.send(outgoing)
        for watch in self.watchers:
            watch()
        self._clock.schedule(now_ns + STEP_NS, self._step)


class SimulatedCamera:
    """Camera on the vehicle; a frame is drawn when read, from the pose at exposure.

    As in ``sitl``, a frame shows the vehicle's last step and carries that step's stamp, which is
    the middle of the frame. The frame ends ``to_end_ns`` later, and arrives after that. ``render``
    draws [H, W, 3] uint8 from position, attitude and body rates of the camera.
    """

    def __init__(
        self,
        clock: SteppedClock,
        pose: Callable[[], Pose],
        render: Callable[[Vec3, Quat, Vec3], ImageArray],
        *,
        period_ns: int,
        phase_ns: int,
        delays_ns: Iterator[int],
        stalled_until_ns: Callable[[int], int] = int,
        to_end_ns: int = 0,
        mount: Quat = IDENTITY,
    ) -> None:
        self._clock = clock
        self._stalled_until_ns = stalled_until_ns
        self._to_end_ns = to_end_ns
        self._mount = mount
        self._pose = pose
        self._render = render
        self._period_ns = period_ns
        self._delays_ns = delays_ns
        self._arrived: Exposure | None = None
        self._frames = 0
        self.dropped_frames = 0
        self.exposure_watchers: list[Callable[[Exposure], None]] = []
        self.arrival_watchers: list[Callable[[], None]] = []
        clock.schedule(clock.now_ns() + phase_ns, self._expose)

    def has_frame(self) -> bool:
        """True if an unread frame has arrived."""
        return self._arrived is not None

    def _expose(self) -> None:
        pose = self._pose()
        self._frames += 1
        exposure = Exposure(frame_id=self._frames, captured_ns=pose.stamp_ns, body=pose.body)
        for watch in self.exposure_watchers:
            watch(exposure)
        now_ns = self._clock.now_ns()
        arrival_ns = now_ns + self._to_end_ns + next(self._delays_ns)
        self._clock.schedule(self._stalled_until_ns(arrival_ns), lambda: self._arrive(exposure))
        self._clock.schedule(now_ns + self._period_ns, self._expose)

    def _arrive(self, exposure: Exposure) -> None:
        self.dropped_frames += self.has_frame()
        if self._arrived is None or self._arrived.frame_id < exposure.frame_id:
            self._arrived = exposure
        for watch in self.arrival_watchers:
            watch()

    def read(self, timeout_ns: int) -> Frame | None:
        """Return the newest unread frame, or None; never waits."""
        exposure, self._arrived = self._arrived, None
        if exposure is None:
            return None
        body = exposure.body
        attitude, rate_mount_radps = body.ned_from_body_wxyz, body.rate_body_radps
        if self._mount != IDENTITY:
            attitude = multiply(attitude, self._mount)
            rate_mount_radps = rotate(conjugate(self._mount), rate_mount_radps)
        rgb = self._render(body.position_ned_m, attitude, rate_mount_radps)
        rgb.setflags(write=False)
        return Frame(frame_id=exposure.frame_id, captured_ns=exposure.captured_ns, rgb=rgb)

    def close(self) -> None:
        """No-op."""


class DelayedFeatureCache(FeatureCache):
    """Feature cache that publishes each feature at its ``ready_ns``."""

    def __init__(self, clock: SteppedClock, *, span_ns: int = 0) -> None:
        super().__init__(span_ns=span_ns)
        self._clock = clock

    def publish(self, frame: FeatureFrame) -> None:
        """Schedule the replacement of the cached feature."""
        publish_now = super().publish
        self._clock.schedule(frame.ready_ns, lambda: publish_now(frame))


class DelayedSink:
    """Passes vision ticks on when their features are ready, so that events stay in order of
    time."""

    def __init__(self, clock: SteppedClock, sink: TickSink) -> None:
        self._clock = clock
        self._sink = sink

    def emit(self, event: Event) -> None:
        """Schedule a vision tick."""
        if isinstance(event, VisionTick):
            self._clock.schedule(event.ready_ns, lambda: self._sink.emit(event))
