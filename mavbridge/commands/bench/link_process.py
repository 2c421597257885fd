"""Link test, client: our link and action loop, with a policy that only repeats the roll rate.

``python -m mavbridge.commands.bench.link_process``. No torch is loaded and no camera runs, but
every tick does all that a flight's does: drain, state, engagement, chunk, smoothing, send.
"""

import argparse
import signal
import threading
from pathlib import Path

import numpy as np

from mavbridge.commands.bench.results import LinkClient, to_json
from mavbridge.config.flight import LinkConfig
from mavbridge.config.rates import Pace, period_ns
from mavbridge.core.clock import NS_PER_MS, NS_PER_S, GridPacer, MonotonicClock
from mavbridge.core.histogram import Histogram
from mavbridge.core.observers import FanOut
from mavbridge.core.realtime import settle_process, settle_thread
from mavbridge.core.records import Event, FeatureFrame, FloatArray, LinkStats, Tick
from mavbridge.flight.action_loop import ActionLoop, ActionSettings
from mavbridge.flight.feature_cache import FeatureCache
from mavbridge.flight.state import Freshness
from mavbridge.flight.state_pacer import StatePacer
from mavbridge.gate.engagement import Engagement
from mavbridge.gate.smoothing import Smoothing, StickSmoother
from mavbridge.mavlink.link import MavlinkLink
from mavbridge.mavlink.transport.sockets import make_transport
from mavbridge.observe.timing import FlightTiming, ObserverDrops
from policy.contract import ACTION_DIM, RATE, Contract

ACTION_HZ = 100.0
FOR_EVER_NS = 1 << 62
ROLL = 3
"""Index in an action."""


def repeat_roll_rate(
    _feature: FloatArray, state: FloatArray, _history: FloatArray, _elapsed_s: float | None
) -> FloatArray:
    """State [1, 13] -> chunk [1, 16, 4]: the roll stick is the roll rate, in rad/s."""
    chunk = np.zeros((1, Contract.horizon, ACTION_DIM), np.float32)
    chunk[0, :, ROLL] = state[0, RATE][0]
    return chunk


class WorkTiming:
    """A ``TickSink``: how long ticks with new sticks took, from waking to the send."""

    def __init__(self) -> None:
        self.work = Histogram()

    def emit(self, event: Event) -> None:
        """Count a tick that sent."""
        if isinstance(event, Tick) and event.sent is not None:
            self.work.add(event.sent_ns - event.woke_ns)


def main() -> None:
    """Answer until ended, then write the figures."""
    parser = argparse.ArgumentParser(description=__doc__, allow_abbrev=False)
    parser.add_argument("--port", type=int, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--pace", choices=("clock", "state"), default="clock")
    args = parser.parse_args()
    settle_process()
    settle_thread(realtime=True, cpu=None)  # as a flight does
    stop = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: stop.set())
    clock = MonotonicClock()
    config = LinkConfig(connect=f"udp:127.0.0.1:{args.port}")
    link = MavlinkLink(make_transport(config.connect, clock), clock, config, state_hz=ACTION_HZ)
    timing, work = FlightTiming(action_hz=ACTION_HZ, vision_hz=1.0), WorkTiming()
    try:
        _loop(clock, link, FanOut([timing, work]), args.pace).run(stop)
    finally:
        link.close()
    args.out.write_text(to_json(_figures(timing, work, link.stats())))


def _loop(clock: MonotonicClock, link: MavlinkLink, sink: FanOut, pace: Pace) -> ActionLoop:
    cache = FeatureCache()
    cache.publish(
        FeatureFrame(
            frame_id=0,
            captured_ns=clock.now_ns(),
            ready_ns=clock.now_ns(),
            value=np.zeros((1, 1), np.float32),
        )
    )
    contract = Contract()
    tick_ns = period_ns(ACTION_HZ)
    return ActionLoop(
        clock=clock,
        pacer=(
            StatePacer(clock, link, period_ns=tick_ns)
            if pace == "state"
            else GridPacer(clock, period_ns=tick_ns)
        ),
        link=link,
        cache=cache,
        act=repeat_roll_rate,
        # No lag and no limit: the vehicle must find its number unchanged.
        smoother=StickSmoother(Smoothing(max_slew_per_s=0.0, tau_s=0.0, max_dt_s=1.0)),
        engagement=Engagement(wanted_mode=None, arm=False, readonly=False),
        sink=sink,
        settings=ActionSettings(
            state_frame=contract.state_frame,
            since_exposure=False,
            chunk_dt_s=contract.chunk_dt_s,
            history_len=contract.history_len,
            history_dt_s=contract.history_dt_s,
            freshness=Freshness(attitude_ns=250 * NS_PER_MS, velocity_ns=NS_PER_S),
            max_feature_age_ns=FOR_EVER_NS,
            lead_s=0.0,
            mode=None,
            duration_ns=None,
        ),
    )


def _figures(timing: FlightTiming, work: WorkTiming, stats: LinkStats) -> LinkClient:
    report = timing.report(
        mode="dual",
        engine="none",
        policy="repeat roll rate",
        autopilot=None,
        link=stats,
        observer_drops=ObserverDrops(rerun=None, recorder=None),
    )
    return LinkClient(state_to_wire_ms=report.state_to_wire_ms, work_ms=work.work.percentiles_ms())


if __name__ == "__main__":
    main()
