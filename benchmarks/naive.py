"""The usual runner of a learned policy, written honestly: what mavbridge is measured against.

Eager torch as it comes, the whole sampler at every step, one thread for images and one for actions
with a lock around what they share, ``time.sleep(period - elapsed)``, and pymavlink's own connection
read once a step. The weights, the camera and the vehicle are those of the measured flight.

Reading one attitude a step is what makes it fall behind: a step that is slower than the stream
leaves the rest in the socket, and the next step acts on what is oldest there.

It arms nothing, so the vehicle stays on the ground; its sticks are sent and counted all the same.
"""

import argparse
import threading
import time

import numpy as np
import torch
from pymavlink import mavutil
from pymavlink.dialects.v20 import ardupilotmega as mav

from mavbridge.camera.open import open_camera
from mavbridge.commands.bench import engines
from mavbridge.commands.bench.flight_process import arguments
from mavbridge.commands.bench.flights import NAIVE_NAME
from mavbridge.commands.bench.meter import since_ms, stolen_ns
from mavbridge.commands.bench.results import Flight, to_json
from mavbridge.core.clock import NS_PER_MS, NS_PER_S, MonotonicClock
from mavbridge.core.histogram import Histogram
from policy.nets.toge import TogeConfig
from policy.preprocess import image_to_input

STREAMS = (
    mav.MAVLINK_MSG_ID_ATTITUDE_QUATERNION,
    mav.MAVLINK_MSG_ID_LOCAL_POSITION_NED,
    mav.MAVLINK_MSG_ID_RAW_IMU,
)
READ_TIMEOUT_NS = 100 * NS_PER_MS


class NaiveRunner:
    """Two threads and a lock; counts what mavbridge counts."""

    def __init__(self, args: argparse.Namespace) -> None:
        self._args = args
        shipped = args.policy == engines.SHIPPED_POLICY
        policy = engines.shipped_toge() if shipped else engines.eager_toge(TogeConfig(size="small"))
        self._policy = policy
        self._clock = MonotonicClock()
        size = policy.contract.image_height
        self._camera = open_camera(args.camera, image_size=size, clock=self._clock)
        self._connection = mavutil.mavlink_connection(
            f"udpin:127.0.0.1:{args.port}",
            source_system=255,
            source_component=mav.MAV_COMP_ID_ONBOARD_COMPUTER,
        )
        self._lock = threading.Lock()
        self._feature: torch.Tensor | None = None
        self._captured_ns = 0
        self._stop = threading.Event()
        self._history = np.zeros((1, policy.contract.history_len, 4), np.float32)
        self._boot_offset_ns: int | None = None
        self._last_attitude: mav.MAVLink_attitude_quaternion_message | None = None
        self._cpu_ns = 0
        self._stolen_ns: int | None = None
        self._stamps_ns: list[int] = []
        self._frames_ns: list[int] = []
        self._period, self._predict, self._encode = Histogram(), Histogram(), Histogram()
        self._feature_age, self._state_to_wire = Histogram(), Histogram()

    def run(self) -> Flight:
        """Fly for the duration, from the first chunk on."""
        self._warm_up()
        self._connect()
        vision = threading.Thread(target=self._see, name="naive-vision")
        vision.start()
        try:
            self._act()
        finally:
            self._stop.set()
            vision.join()
            self._camera.close()
            self._connection.close()
        return self._flight()

    def _warm_up(self) -> None:
        """The first inference of a process allocates, which belongs to the start."""
        contract = self._policy.contract
        image = torch.zeros(1, 3, contract.image_height, contract.image_width)
        with torch.no_grad():
            feature = self._policy.encode_visual(image)
            history = torch.from_numpy(self._history)
            state = torch.zeros(1, contract.state_dim)
            self._policy.predict_fast(feature, state, history, engines.STEPS)

    def _connect(self) -> None:
        self._connection.wait_heartbeat()
        interval_us = 1e6 / self._args.action_hz
        for message in STREAMS:
            self._connection.mav.command_long_send(
                self._connection.target_system,
                self._connection.target_component,
                mav.MAV_CMD_SET_MESSAGE_INTERVAL,
                *(0, message, interval_us, 0, 0, 0, 0, 0),
            )

    # --- images

    def _see(self) -> None:
        period_s = 1 / self._args.vision_hz
        while not self._stop.is_set():
            started_ns = self._clock.now_ns()
            frame = self._camera.read(READ_TIMEOUT_NS)
            if frame is None:
                continue
            encoding_ns = self._clock.now_ns()
            image = torch.from_numpy(image_to_input(frame.rgb, self._policy.contract))
            with torch.no_grad():
                feature = self._policy.encode_visual(image)
            with self._lock:
                self._feature, self._captured_ns = feature, frame.captured_ns
            if self._stamps_ns:
                self._frames_ns.append(started_ns)
                self._encode.add(self._clock.now_ns() - encoding_ns)
            self._sleep(period_s, started_ns)

    # --- actions

    def _act(self) -> None:
        period_s = 1 / self._args.action_hz
        end_ns: int | None = None
        beat_ns = 0
        while end_ns is None or self._clock.now_ns() < end_ns:
            started_ns = self._clock.now_ns()
            if started_ns - beat_ns >= NS_PER_S:
                beat_ns = started_ns
                self._connection.mav.heartbeat_send(
                    mav.MAV_TYPE_ONBOARD_CONTROLLER, mav.MAV_AUTOPILOT_INVALID, 0, 0, 0
                )
            if self._step(started_ns) and end_ns is None:
                end_ns = started_ns + round(self._args.duration * NS_PER_S)
                self._cpu_ns, self._stolen_ns = time.process_time_ns(), stolen_ns()
            self._sleep(period_s, started_ns)
        self._cpu_ns = time.process_time_ns() - self._cpu_ns

    def _step(self, started_ns: int) -> bool:
        attitude = self._connection.recv_match(type="ATTITUDE_QUATERNION", blocking=False)
        state = self._state()
        with self._lock:
            feature, captured_ns = self._feature, self._captured_ns
        if feature is None or state is None:
            return False
        predicting_ns = self._clock.now_ns()
        with torch.no_grad():
            chunk = self._policy.predict_fast(
                feature, torch.from_numpy(state), torch.from_numpy(self._history), engines.STEPS
            )
        self._predict.add(self._clock.now_ns() - predicting_ns)
        self._send(chunk[0, 0].tolist())
        self._count(started_ns, captured_ns, attitude)
        return True

    def _state(self) -> np.ndarray | None:
        """[1, 13] of the newest message of each kind that the connection has parsed.

        A policy that asks how old its image is gets zeros for that: this runner does not know.
        """
        found = self._connection.messages
        try:
            q, p, i = found["ATTITUDE_QUATERNION"], found["LOCAL_POSITION_NED"], found["RAW_IMU"]
        except KeyError:
            return None
        g = 9.80665e-3  # m/s^2 for each mg
        values = (
            *(p.vx, p.vy, p.vz, q.q1, q.q2, q.q3, q.q4),
            *(q.rollspeed, q.pitchspeed, q.yawspeed, i.xacc * g, i.yacc * g, i.zacc * g),
        )
        state = np.zeros((1, self._policy.contract.state_dim), np.float32)
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

    # --- counting

    def _count(
        self,
        started_ns: int,
        captured_ns: int,
        attitude: mav.MAVLink_attitude_quaternion_message | None,
    ) -> None:
        now_ns = self._clock.now_ns()
        if self._stamps_ns:
            self._period.add(started_ns - self._stamps_ns[-1])
        self._stamps_ns.append(started_ns)
        self._feature_age.add(now_ns - captured_ns)
        if attitude is None:
            return
        # mavutil stamps a message when it is parsed, however long it has waited in the socket. The
        # vehicle's own stamp does not wait: the smallest distance seen stands for no delay at all.
        offset_ns = now_ns - attitude.time_boot_ms * NS_PER_MS
        if self._boot_offset_ns is None or offset_ns < self._boot_offset_ns:
            self._boot_offset_ns = offset_ns
        self._state_to_wire.add(offset_ns - self._boot_offset_ns)

    def _sleep(self, period_s: float, started_ns: int) -> None:
        elapsed_s = (self._clock.now_ns() - started_ns) / NS_PER_S
        time.sleep(max(0.0, period_s - elapsed_s))  # noqa: TID251 - the habit under test

    def _flight(self) -> Flight:
        args = self._args
        duration_s = (self._stamps_ns[-1] - self._stamps_ns[0]) / NS_PER_S
        ticks = len(self._stamps_ns)
        return Flight(
            runner=NAIVE_NAME,
            policy=args.policy,
            engine=engines.EAGER,
            asked_action_hz=args.action_hz,
            asked_vision_hz=args.vision_hz,
            duration_s=round(duration_s, 3),
            action_hz=_rate_hz(self._stamps_ns),
            vision_hz=_rate_hz(self._frames_ns),
            missed_slots=max(0, round(args.action_hz * duration_s) + 1 - ticks),
            period_ms=self._period.percentiles_ms(),
            predict_ms=self._predict.percentiles_ms(),
            encode_ms=self._encode.percentiles_ms(),
            feature_age_ms=self._feature_age.percentiles_ms(),
            state_to_wire_ms=self._state_to_wire.percentiles_ms(),
            cpu_cores=round(self._cpu_ns / NS_PER_S / duration_s, 3),
            stolen_ms=since_ms(self._stolen_ns, stolen_ns()),
            missed_by_cause=None,
        )


def _rate_hz(stamps_ns: list[int]) -> float | None:
    if len(stamps_ns) < 2:
        return None
    return round((len(stamps_ns) - 1) * NS_PER_S / (stamps_ns[-1] - stamps_ns[0]), 3)


def main() -> None:
    """Fly once and write the figures."""
    args = arguments(__doc__)
    args.out.write_text(to_json(NaiveRunner(args).run()))


if __name__ == "__main__":
    main()
