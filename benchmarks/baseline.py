"""Baseline runner: a careful version of the common way to run a learned policy, for comparison.

Plain eager torch with the whole sampler at every step, one thread for images and one for actions
with a lock around shared data, ``time.sleep(period - elapsed)``, and pymavlink's connection read
once per step. The weights, the camera and the vehicle are those of the measured flight.

It falls behind because it reads one attitude per step: a step slower than the stream leaves
messages in the socket, and the next step acts on the oldest one there.

It does not arm, so the vehicle stays on the ground; its sticks are sent and counted.
"""

import pickle
import sys
import threading
import time
from pathlib import Path

import numpy as np
import torch
from pymavlink import mavutil
from pymavlink.dialects.v20 import ardupilotmega as mav

from benchmarks.engines import EAGER
from benchmarks.flight import FlightJob, read_job
from benchmarks.results import BASELINE, Flight, solves_of
from mavbridge.camera.open import open_camera
from mavbridge.config.policy import PolicyConfig
from mavbridge.core.clock import NS_PER_MS, NS_PER_S, MonotonicClock
from mavbridge.core.histogram import Histogram
from policy.checkpoints.networks import load_checkpoint
from policy.contract import ACTION_DIM
from policy.loading.builtin import SHIPPED
from policy.nets.toge import Toge, TogeConfig, build_policy
from policy.preprocess import image_to_input

STREAMS = (
    mav.MAVLINK_MSG_ID_ATTITUDE_QUATERNION,
    mav.MAVLINK_MSG_ID_LOCAL_POSITION_NED,
    mav.MAVLINK_MSG_ID_RAW_IMU,
)
READ_TIMEOUT_NS = 100 * NS_PER_MS


def main(path: Path) -> None:
    """Fly the job in a file once, and write its figures."""
    job = read_job(path)
    job.out.write_bytes(pickle.dumps(Baseline(job).run()))


def eager_toge(policy: PolicyConfig) -> Toge:
    """Return the network without a runner: the shipped TOGE, or seeded weights by
    ``network.allow_untrained``."""
    torch.manual_seed(policy.seed)
    if policy.allow_untrained:
        net = build_policy(TogeConfig(size="small"))
    else:
        net = load_checkpoint(SHIPPED, fallback=TogeConfig())
    if not isinstance(net, Toge):
        raise TypeError(f"not a Toge: {type(net).__name__}")
    net.eval()
    net.head.seed_noise(policy.seed)
    return net


class Baseline:
    """Two threads and a lock; counts the same quantities as a flight of mavbridge."""

    def __init__(self, job: FlightJob) -> None:
        self._job = job
        self._action_hz = job.rates.loops(is_dual=True).action_hz
        self._net = eager_toge(job.policy)
        self._clock = MonotonicClock()
        contract = self._net.contract
        self._camera = open_camera(job.camera, image_size=contract.image_height, clock=self._clock)
        self._connection = mavutil.mavlink_connection(
            f"udpin:127.0.0.1:{job.port}",
            source_system=255,
            source_component=mav.MAV_COMP_ID_ONBOARD_COMPUTER,
        )
        self._lock = threading.Lock()
        self._feature: torch.Tensor | None = None
        self._captured_ns = 0
        self._stop = threading.Event()
        self._history = np.zeros((1, contract.history_len, ACTION_DIM), np.float32)
        self._least_offset_ns: int | None = None
        self._stamps_ns: list[int] = []
        self._frames_ns: list[int] = []
        self._period, self._predict, self._encode = Histogram(), Histogram(), Histogram()
        self._feature_age, self._state_to_wire = Histogram(), Histogram()

    def run(self) -> Flight:
        """Fly for the job's duration, counted from the first chunk."""
        contract = self._net.contract
        # The first inference of a process allocates memory, which belongs to the start.
        self._encode_image(np.zeros((contract.image_height, contract.image_width, 3), np.uint8))
        self._sample(
            torch.zeros(1, contract.feature_dim), np.zeros((1, contract.state_dim), np.float32)
        )
        self._connection.wait_heartbeat()
        for message in STREAMS:
            self._connection.mav.command_long_send(
                self._connection.target_system,
                self._connection.target_component,
                mav.MAV_CMD_SET_MESSAGE_INTERVAL,
                *(0, message, 1e6 / self._action_hz, 0, 0, 0, 0, 0),
            )
        vision = threading.Thread(target=self._vision_loop, name="baseline-vision")
        vision.start()
        try:
            return self._action_loop()
        finally:
            self._stop.set()
            vision.join()
            self._camera.close()
            self._connection.close()

    @torch.no_grad()
    def _encode_image(self, rgb: np.ndarray) -> torch.Tensor:
        image = torch.from_numpy(image_to_input(rgb, self._net.contract))
        return self._net.encode_visual(image)

    @torch.no_grad()
    def _sample(self, feature: torch.Tensor, state: np.ndarray) -> list[float]:
        history, steps = torch.from_numpy(self._history), self._job.policy.steps
        chunk = self._net.predict_fast(feature, torch.from_numpy(state), history, steps)
        action: list[float] = chunk[0, 0].tolist()
        return action

    def _vision_loop(self) -> None:
        while not self._stop.is_set():
            started_ns = self._clock.now_ns()
            frame = self._camera.read(READ_TIMEOUT_NS)
            if frame is None:
                continue
            encoding_ns = self._clock.now_ns()
            feature = self._encode_image(frame.rgb)
            with self._lock:
                self._feature, self._captured_ns = feature, frame.captured_ns
            if self._stamps_ns:
                self._frames_ns.append(started_ns)
                self._encode.add(self._clock.now_ns() - encoding_ns)
            self._sleep(1 / self._vision_hz, started_ns)

    @property
    def _vision_hz(self) -> float:
        return self._job.rates.visual_limits_hz[1]

    def _action_loop(self) -> Flight:
        end_ns: int | None = None
        heartbeat_ns = cpu_ns = 0
        while end_ns is None or self._clock.now_ns() < end_ns:
            started_ns = self._clock.now_ns()
            if started_ns - heartbeat_ns >= NS_PER_S:
                heartbeat_ns = started_ns
                self._connection.mav.heartbeat_send(
                    mav.MAV_TYPE_ONBOARD_CONTROLLER, mav.MAV_AUTOPILOT_INVALID, 0, 0, 0
                )
            if self._step(started_ns) and end_ns is None:
                end_ns = started_ns + round(self._job.duration_s * NS_PER_S)
                cpu_ns = time.process_time_ns()
            self._sleep(1 / self._action_hz, started_ns)
        return self._flight(time.process_time_ns() - cpu_ns)

    def _step(self, started_ns: int) -> bool:
        attitude = self._connection.recv_match(type="ATTITUDE_QUATERNION", blocking=False)
        state = self._state()
        with self._lock:
            feature, captured_ns = self._feature, self._captured_ns
        if feature is None or state is None:
            return False
        sampling_ns = self._clock.now_ns()
        action = self._sample(feature, state)
        self._predict.add(self._clock.now_ns() - sampling_ns)
        self._send(action)
        now_ns = self._clock.now_ns()
        if self._stamps_ns:
            self._period.add(started_ns - self._stamps_ns[-1])
        self._stamps_ns.append(started_ns)
        self._feature_age.add(now_ns - captured_ns)
        if attitude is not None:
            # mavutil stamps a message when it is parsed, after its wait in the socket. The
            # vehicle's stamp excludes the wait; the smallest difference counts as zero delay.
            offset_ns = now_ns - attitude.time_boot_ms * NS_PER_MS
            self._least_offset_ns = min(offset_ns, self._least_offset_ns or offset_ns)
            self._state_to_wire.add(offset_ns - self._least_offset_ns)
        return True

    def _state(self) -> np.ndarray | None:
        """Return [1, state_dim] of the newest parsed message of each kind, or None.

        A policy that takes the age of its image gets zeros, since this runner does not know it.
        """
        messages = self._connection.messages
        try:
            q, p, i = (
                messages[name] for name in ("ATTITUDE_QUATERNION", "LOCAL_POSITION_NED", "RAW_IMU")
            )
        except KeyError:
            return None
        g = 9.80665e-3  # m/s^2 per mg
        values = (
            *(p.vx, p.vy, p.vz, q.q1, q.q2, q.q3, q.q4),
            *(q.rollspeed, q.pitchspeed, q.yawspeed, i.xacc * g, i.yacc * g, i.zacc * g),
        )
        state = np.zeros((1, self._net.contract.state_dim), np.float32)
        state[0, : len(values)] = values
        return state

    def _send(self, action: list[float]) -> None:
        throttle, yaw, pitch, roll = action
        sticks = (roll, -pitch, throttle, yaw)
        channels_us = [round(1500 + 500 * max(-1.0, min(1.0, stick))) for stick in sticks]
        self._connection.mav.rc_channels_override_send(
            self._connection.target_system,
            self._connection.target_component,
            *channels_us,
            *(65535, 65535, 65535, 65535),
        )
        self._history = np.roll(self._history, -1, axis=1)
        self._history[0, -1] = action

    def _sleep(self, period_s: float, started_ns: int) -> None:
        elapsed_s = (self._clock.now_ns() - started_ns) / NS_PER_S
        time.sleep(max(0.0, period_s - elapsed_s))  # noqa: TID251 - common practice, under test

    def _flight(self, cpu_ns: int) -> Flight:
        duration_s = (self._stamps_ns[-1] - self._stamps_ns[0]) / NS_PER_S
        return Flight(
            runner=BASELINE,
            policy=self._job.policy.policy,
            solves=solves_of(self._job.policy),
            engine=EAGER,
            asked_stick_hz=self._action_hz,
            asked_action_hz=self._action_hz,
            asked_vision_hz=self._vision_hz,
            duration_s=round(duration_s, 3),
            stick_hz=_rate_hz(self._stamps_ns),
            action_hz=_rate_hz(self._stamps_ns),
            vision_hz=_rate_hz(self._frames_ns),
            missed_slots=max(0, round(self._action_hz * duration_s) + 1 - len(self._stamps_ns)),
            chunks=len(self._stamps_ns),
            period_ms=self._period.percentiles_ms(),
            predict_ms=self._predict.percentiles_ms(),
            encode_ms=self._encode.percentiles_ms(),
            feature_age_ms=self._feature_age.percentiles_ms(),
            state_to_wire_ms=self._state_to_wire.percentiles_ms(),
            cpu_cores=round(cpu_ns / NS_PER_S / duration_s, 3),
        )


def _rate_hz(stamps_ns: list[int]) -> float | None:
    if len(stamps_ns) < 2:
        return None
    return round((len(stamps_ns) - 1) * NS_PER_S / (stamps_ns[-1] - stamps_ns[0]), 3)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
