"""mavbridge's client of the link test: guard and policy loop; the policy repeats the roll rate.

No torch is loaded and no camera runs, but every attitude takes the path of a flight: from the
socket through the guard to the flight process, through the policy loop, and back as a chunk.
"""

import signal
import threading
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
from cyclopts import run

from benchmarks.link_vehicle import ATTITUDE_HZ
from mavbridge.config.flight import FlyConfig, Limits, LinkConfig
from mavbridge.config.rates import Rates
from mavbridge.core.clock import NS_PER_S, MonotonicClock
from mavbridge.core.realtime import settle_process, settle_thread
from mavbridge.core.reasons import Code, because
from mavbridge.core.records import FeatureFrame, FloatArray, Frame
from mavbridge.core.workers import Worker
from mavbridge.flight.bridge import Bridge, CameraPath, build_bridge
from mavbridge.flight.feature_cache import FeatureCache
from mavbridge.flight.guard_process import GuardProcess
from mavbridge.flight.plan import FlightPlan, plan_flight
from mavbridge.flight.settings import guard_settings
from mavbridge.guard.values import EndRequest
from policy.contract import ACTION_DIM, ACTION_NAMES, RATE, Contract
from policy.protocol import PolicyRunner

ROLL = ACTION_NAMES.index("roll")
MOST_CHUNKS_HZ = 200.0
"""Twice the vehicle's rate, so that an attitude closely after a late one is answered at once."""
DAY_NS = 24 * 3600 * NS_PER_S
WATCH_S = 0.1
END_S = 5.0
"""Limit for the release of a vehicle that may have left, and for threads to end."""


def main(*, port: int) -> None:
    """Answer until SIGTERM."""
    stop = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: stop.set())
    config = FlyConfig(
        link=LinkConfig(connect=f"udp:127.0.0.1:{port}"),
        # No smoothing, so that the vehicle finds its code unchanged. Its attitude never changes.
        limits=Limits(tau=0.0, max_slew=0.0, max_frozen_state=0.0),
        rates=Rates(action_rate=MOST_CHUNKS_HZ),
        arm=True,
        on_fault="release",
        then="release",
    )
    settings = guard_settings(config, is_dual=True, tlog_fd=None, wall_offset_ns=0)
    link = replace(settings.link, state_hz=ATTITUDE_HZ)
    guard = GuardProcess(replace(settings, link=link), MonotonicClock())
    try:
        plan = plan_flight(config, ROLL_RATE.contract, is_dual=ROLL_RATE.dual_rate)
        bridge = link_bridge(plan, guard)
        guard.send(plan.guard)
        _serve(bridge, guard, stop)
    finally:
        guard.close()


def link_bridge(plan: FlightPlan, guard: GuardProcess) -> Bridge:
    """Build the policy loop and its view of the vehicle; the vision loop exists but never runs."""
    clock, cache = MonotonicClock(), FeatureCache()
    now_ns = clock.now_ns()
    feature = np.zeros((1, 1), np.float32)
    cache.publish(
        FeatureFrame(frame_id=0, captured_ns=now_ns + DAY_NS, ready_ns=now_ns, value=feature)
    )
    return build_bridge(
        plan,
        ROLL_RATE,
        clock=clock,
        send=guard.send,
        cameras=[CameraPath(camera=NoCamera(), cache=cache, clock=clock)],
        sinks=(),
        watches_images=False,
        samples=guard.samples,
    )


def _serve(bridge: Bridge, guard: GuardProcess, stop: threading.Event) -> None:
    """Run until told to stop or until the guard ends; raise any exception of a thread."""

    def run_settled(ended: threading.Event, *, run: Callable[[threading.Event], None]) -> None:
        settle_thread(realtime=True, cpu=None)  # as in a flight
        run(ended)

    settle_process()
    policy = Worker("mavbridge-policy", partial(run_settled, run=bridge.policy.run))
    listen = partial(guard.listen, view=bridge.view)
    listener = Worker("mavbridge-guard", partial(run_settled, run=listen))
    listener.start()
    policy.start()
    while listener.is_alive and policy.is_alive and not stop.wait(WATCH_S):
        pass
    guard.send(EndRequest(reason=because(Code.FINISHED, what="measurement")))
    listener.ends_within(END_S)
    for worker in (policy, listener):
        worker.join(END_S)


def repeat_roll_rate(_feature: FloatArray, state: FloatArray, _history: FloatArray) -> FloatArray:
    """Return a chunk [1, 16, 4] whose roll stick is the roll rate [rad/s] of the state [1, 13]."""
    chunk = np.zeros((1, Contract.horizon, ACTION_DIM), np.float32)
    chunk[0, :, ROLL] = state[0, RATE][0]
    return chunk


ROLL_RATE = PolicyRunner(
    # Wide age limits, so that a vehicle served late is measured.
    contract=Contract(max_state_age_s=1.0, max_velocity_age_s=1.0, max_chunk_age_s=1.0),
    name="roll rate",
    engine="none",
    dual_rate=True,
    encode=lambda _rgb, _camera=0: np.zeros((1, 1), np.float32),
    act=repeat_roll_rate,
)


class NoCamera:
    """Camera that never delivers."""

    dropped_frames = 0

    def read(self, timeout_ns: int) -> Frame | None:
        """Return None without waiting."""

    def close(self) -> None:
        """No-op."""


if __name__ == "__main__":
    run(main)
