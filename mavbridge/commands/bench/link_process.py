"""Client of the link test: our link and action loop, with a policy that repeats the roll rate.

``python -m mavbridge.commands.bench.link_process --port P --out FILE``. No torch is loaded and no
camera runs, but every tick does all that a flight's does, from draining the socket to the send.
"""

import signal
import threading
from pathlib import Path

import numpy as np
from cyclopts import App

from mavbridge.commands.bench.results import ClientTiming, to_json
from mavbridge.config.flight import FlyConfig, Limits, LinkConfig
from mavbridge.config.rates import Pace, Rates
from mavbridge.core.clock import NS_PER_S, MonotonicClock
from mavbridge.core.histogram import Histogram
from mavbridge.core.realtime import settle_process, settle_thread
from mavbridge.core.records import Event, FeatureFrame, FloatArray, Tick
from mavbridge.flight.bridge import build_action_loop
from mavbridge.flight.feature_cache import FeatureCache
from mavbridge.flight.link_settings import link_settings
from mavbridge.mavlink.link import MavlinkLink
from mavbridge.mavlink.transport.sockets import make_transport
from policy.contract import ACTION_DIM, ACTION_NAMES, RATE, Contract, Executable

ROLL = ACTION_NAMES.index("roll")
DAY_NS = 24 * 3600 * NS_PER_S
app = App(help=__doc__)


@app.default
def main(*, port: int, out: Path, pace: Pace = "clock") -> None:
    """Answer until SIGTERM, then write the figures to ``out``."""
    settle_process()
    settle_thread(realtime=True, cpu=None)  # as a flight does
    stop = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: stop.set())
    clock, meter, cache = MonotonicClock(), ClientMeter(), FeatureCache()
    cache.publish(
        FeatureFrame(
            frame_id=0,
            captured_ns=clock.now_ns() + DAY_NS,  # never too old
            ready_ns=clock.now_ns(),
            value=np.zeros((1, 1), np.float32),
        )
    )
    config = FlyConfig(
        link=LinkConfig(connect=f"udp:127.0.0.1:{port}"),
        rates=Rates(pace=pace),
        # No smoothing: the vehicle must find its number unchanged.
        limits=Limits(tau=0.0, max_slew=0.0, max_attitude_age=0.25, max_velocity_age=1.0),
    )
    executable = Executable(
        contract=Contract(),
        name="roll rate",
        engine="none",
        dual_rate=True,
        encode=lambda _: np.zeros((1, 1), np.float32),
        act=repeat_roll_rate,
    )
    transport = make_transport(config.link.connect, clock)
    settings = link_settings(config.link, state_hz=config.rates.action_rate)
    link = MavlinkLink(transport, clock, settings)
    loop = build_action_loop(config, executable, clock=clock, link=link, cache=cache, sink=meter)
    try:
        loop.run(stop)
    finally:
        link.close()
    out.write_text(to_json(meter.timing()))


def repeat_roll_rate(
    _feature: FloatArray, state: FloatArray, _history: FloatArray, _elapsed_s: float | None
) -> FloatArray:
    """State [1, 13] -> chunk [1, 16, 4] whose roll stick is the roll rate, in rad/s."""
    chunk = np.zeros((1, Contract.horizon, ACTION_DIM), np.float32)
    chunk[0, :, ROLL] = state[0, RATE][0]
    return chunk


class ClientMeter:
    """A ``TickSink`` that times ticks which sent sticks."""

    def __init__(self) -> None:
        self._work, self._state_to_wire = Histogram(), Histogram()
        self._last_attitude_ns = 0

    def emit(self, event: Event) -> None:
        """Count a tick."""
        if not isinstance(event, Tick) or event.sent is None or event.state is None:
            return
        self._work.add(event.sent_ns - event.woke_ns)
        if event.state.attitude_ns != self._last_attitude_ns:
            self._last_attitude_ns = event.state.attitude_ns
            self._state_to_wire.add(event.sent_ns - event.state.attitude_ns)

    def timing(self) -> ClientTiming:
        """Percentiles so far."""
        return ClientTiming(
            state_to_wire_ms=self._state_to_wire.percentiles_ms(),
            work_ms=self._work.percentiles_ms(),
        )


if __name__ == "__main__":
    app()
