"""A world painted on the sky, seen by a camera that turns, and recorded flights of it."""

import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from helpers.factories import START_NS, TICK_NS, make_state, make_tick, make_vision_tick
from helpers.recordings import make_meta
from mavbridge.commands.evaluate_imagination.lens import Array, Lens, Mounting, attitudes, make_lens
from mavbridge.core.clock import NS_PER_S
from mavbridge.core.records import ImageArray, Sticks
from mavbridge.recording.flight_writer import FlightWriter
from mavbridge.recording.meta import FlightMeta
from sitl.rotation import from_euler

NOMINAL = Mounting(horizontal_fov_rad=math.radians(90.0), tilt_up_rad=math.radians(10.0))
YAW_RATE_RADPS = math.radians(200.0)
"""Of a full stick in these flights."""


def nominal_lens(size: int) -> Lens:
    return make_lens(make_meta(), size, NOMINAL)


def state_of(roll_rad: float, pitch_rad: float, yaw_rad: float) -> NDArray[np.float32]:
    """A state [13] with this attitude."""
    state = make_state().values.copy()
    quaternion = np.array(from_euler(roll_rad, pitch_rad, yaw_rad))
    state[3:7] = quaternion if quaternion[0] >= 0 else -quaternion
    return state


def attitude(roll_rad: float = 0.0, pitch_rad: float = 0.0, yaw_rad: float = 0.0) -> Array:
    """[3, 3] NED from FRD."""
    return attitudes(state_of(roll_rad, pitch_rad, yaw_rad), "ned_frd")


def panorama(lens: Lens, ned_from_frd: Array) -> ImageArray:
    """The view: smooth colours of all directions, all of them far away."""
    ned = lens.rays() @ (ned_from_frd @ lens.frd_from_camera).T
    ned /= np.linalg.norm(ned, axis=-1, keepdims=True)
    waves = np.random.default_rng(0).normal(size=(3, 12, 3))
    phases = np.random.default_rng(1).uniform(0, 2 * np.pi, (3, 12))
    colours = [np.sin(ned @ (5.0 * waves[c]).T + phases[c]).sum(axis=-1) for c in range(3)]
    return np.clip(128 + 25 * np.stack(colours, axis=-1), 0, 255).round().astype(np.uint8)


def yaw_stick(at_s: float, phase: float) -> float:
    return 0.25 * math.sin(3.0 * at_s + phase)


def heading_rad(at_s: float, phase: float) -> float:
    """The integral of the stick times the yaw rate."""
    return 0.25 * YAW_RATE_RADPS * (math.cos(phase) - math.cos(3.0 * at_s + phase)) / 3.0


def write_turning_flight(
    folder: Path, *, seconds: float = 4.0, size: int = 32, phase: float = 0.0, **meta: object
) -> Path:
    """A flight that stands in the air and yaws as its sticks say, at once; 100 and 30 Hz."""
    folder.mkdir(parents=True, exist_ok=True)
    told: FlightMeta = make_meta(
        **{"conditions": {"pilot_yaw_rate_degps": math.degrees(YAW_RATE_RADPS)}, **meta}
    )
    writer = FlightWriter(folder, told, pressure="offline")
    for index in range(round(100 * seconds)):
        at_ns, at_s = START_NS + index * TICK_NS, index / 100
        values = state_of(0.0, 0.0, heading_rad(at_s, phase))
        values[9] = yaw_stick(at_s, phase) * YAW_RATE_RADPS
        sticks = Sticks(throttle=0.0, yaw=yaw_stick(at_s, phase), pitch=0.0, roll=0.0)
        state = make_state(at_ns, values=values)
        writer.tick(make_tick(index, state=state, sent=sticks, sent_ns=at_ns, woke_ns=at_ns))
    lens = nominal_lens(size)
    for frame in range(int(30 * (seconds - 0.05))):
        rgb = panorama(lens, attitude(yaw_rad=heading_rad(frame / 30, phase)))
        captured_ns = START_NS + round(frame / 30 * NS_PER_S)
        writer.frame(make_vision_tick(frame + 1, captured_ns=captured_ns, rgb=rgb))
    writer.finish(writer.meta)
    return folder
