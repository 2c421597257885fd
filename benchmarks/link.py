"""The latency of the link: clients in turn against one vehicle that times their answers.

Our client ``python -m benchmarks.link --port P --out FILE`` is guard and policy loop, with a policy
that repeats the roll rate. No torch is loaded and no camera runs, but every attitude goes the way
of a flight's: from the socket through the guard to the flight process, through the policy loop, and
as a chunk back to the guard.
"""

import signal
import sys
import threading
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from cyclopts import App

from benchmarks.link_vehicle import ATTITUDE_HZ, CONNECT_S, Answers
from benchmarks.results import OURS, ClientTiming, LinkLatency, from_json, to_json
from mavbridge.commands.output import print_status
from mavbridge.config.flight import FlyConfig, Limits, LinkConfig
from mavbridge.config.rates import Rates
from mavbridge.core.clock import NS_PER_S, MonotonicClock
from mavbridge.core.errors import UserError
from mavbridge.core.histogram import Histogram
from mavbridge.core.processes import end, free_port, log_tail, running, wait
from mavbridge.core.realtime import settle_process, settle_thread
from mavbridge.core.reasons import Code, because
from mavbridge.core.records import Event, FeatureFrame, FloatArray, Frame, Tick
from mavbridge.core.workers import Worker
from mavbridge.flight.bridge import Bridge, CameraPath, build_bridge
from mavbridge.flight.feature_cache import FeatureCache
from mavbridge.flight.guard_process import GuardProcess
from mavbridge.flight.plan import FlightPlan, plan_flight
from mavbridge.flight.settings import guard_settings
from mavbridge.guard.values import EndRequest
from policy.contract import ACTION_DIM, ACTION_NAMES, RATE, Contract
from policy.protocol import PolicyRunner

LINK_PROCESS = "benchmarks.link"
LINK_VEHICLE = "benchmarks.link_vehicle"
STARTING_S = 15.0
"""For imports, beside what the vehicle gives a client to connect."""
ROLL = ACTION_NAMES.index("roll")
MOST_CHUNKS_HZ = 200.0
"""Twice the vehicle's rate: an attitude that follows a late one closely is answered at once."""
DAY_NS = 24 * 3600 * NS_PER_S
WATCH_S = 0.1
END_S = 5.0
"""For the release of a vehicle that may be gone already, and for threads to end."""
app = App(help=__doc__)


@dataclass(frozen=True, kw_only=True)
class LinkClient:
    """A program that answers each attitude with sticks."""

    name: str
    command: tuple[str, ...]
    """``--port P`` is appended."""
    writes_timing: bool = False
    """Takes ``--out FILE``, too, and writes a ``ClientTiming`` there."""


OUR_CLIENT = LinkClient(name=OURS, command=(sys.executable, "-m", LINK_PROCESS), writes_timing=True)


def time_link(client: LinkClient, attitudes: int) -> LinkLatency:
    """Time one client.

    Raises:
        UserError: the client or the vehicle failed; quotes the end of both logs.
    """
    print_status(f"link: {client.name}")
    port = str(free_port())
    timeout_s = STARTING_S + CONNECT_S + 1.1 * attitudes / ATTITUDE_HZ
    with TemporaryDirectory(prefix="mavbridge-bench-") as name:
        folder = Path(name)
        log, vehicle_log = folder / "client.log", folder / "vehicle.log"
        timing, answers = folder / "timing.json", folder / "answers.json"
        own = ("--out", str(timing)) if client.writes_timing else ()
        vehicle_command = (
            *(sys.executable, "-m", LINK_VEHICLE, "--port", port),
            *("--attitudes", str(attitudes), "--out", str(answers)),
        )
        with (
            running(*client.command, "--port", port, *own, log=log) as process,
            running(*vehicle_command, log=vehicle_log) as vehicle,
        ):
            try:
                wait(vehicle, f"python -m {LINK_VEHICLE}", vehicle_log, timeout_s)
            except UserError as error:
                raise UserError(f"{client.name}: {error}\nits log: {log_tail(log)}") from error
            end(process)
        counted = from_json(Answers, answers.read_text())
        if counted.round_trip_ms is None:
            raise UserError(f"{client.name} answered no attitude; its log: {log_tail(log)}")
        return LinkLatency(
            client=client.name,
            sent=counted.sent,
            answered=counted.answered,
            round_trip_ms=counted.round_trip_ms,
            timing=from_json(ClientTiming, timing.read_text()) if own else ClientTiming(),
        )


@app.default
def main(*, port: int, out: Path) -> None:
    """Answer until SIGTERM, then write the figures to ``out``."""
    stop = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: stop.set())
    meter = ClientMeter()
    config = FlyConfig(
        link=LinkConfig(connect=f"udp:127.0.0.1:{port}"),
        # No smoothing: the vehicle must find its number unchanged. Its attitude never changes.
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
        bridge = link_bridge(plan, guard, meter)
        guard.send(plan.guard)
        _serve(bridge, guard, stop)
    finally:
        guard.close()
    out.write_text(to_json(meter.timing()))


def link_bridge(plan: FlightPlan, guard: GuardProcess, meter: "ClientMeter") -> Bridge:
    """The policy loop and its view of the vehicle; the vision loop is built and never runs."""
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
        sinks=(meter,),
        watches_images=False,
        samples=guard.samples,
    )


def _serve(bridge: Bridge, guard: GuardProcess, stop: threading.Event) -> None:
    """Run until told to stop or until the guard ends, and raise what a thread has raised."""

    def run_settled(ended: threading.Event, *, run: Callable[[threading.Event], None]) -> None:
        settle_thread(realtime=True, cpu=None)  # as a flight does
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
    """State [1, 13] -> chunk [1, 16, 4] whose roll stick is the roll rate, in rad/s."""
    chunk = np.zeros((1, Contract.horizon, ACTION_DIM), np.float32)
    chunk[0, :, ROLL] = state[0, RATE][0]
    return chunk


ROLL_RATE = PolicyRunner(
    # Wide ages: a vehicle that is served late is to be measured.
    contract=Contract(max_state_age_s=1.0, max_velocity_age_s=1.0, max_chunk_age_s=1.0),
    name="roll rate",
    engine="none",
    dual_rate=True,
    encode=lambda _rgb, _camera=0: np.zeros((1, 1), np.float32),
    act=repeat_roll_rate,
)


class NoCamera:
    """A camera that never delivers."""

    dropped_frames = 0

    def read(self, timeout_ns: int) -> Frame | None:
        """Nothing; ``timeout_ns`` is not waited for."""

    def close(self) -> None:
        """Nothing to free."""


class ClientMeter:
    """A ``TickSink`` that times the first send of each attitude."""

    def __init__(self) -> None:
        self._state_to_wire, self._chunk_to_wire = Histogram(), Histogram()
        self._last_attitude_ns = 0

    def emit(self, event: Event) -> None:
        """Count a tick."""
        if not isinstance(event, Tick) or event.sent is None or event.chunk_computed_ns is None:
            return
        if event.state is not None and event.state.attitude_ns != self._last_attitude_ns:
            self._last_attitude_ns = event.state.attitude_ns
            self._state_to_wire.add(event.sent_ns - event.state.attitude_ns)
            self._chunk_to_wire.add(event.sent_ns - event.chunk_computed_ns)

    def timing(self) -> ClientTiming:
        """Percentiles so far."""
        return ClientTiming(
            state_to_wire_ms=self._state_to_wire.percentiles_ms(),
            chunk_to_wire_ms=self._chunk_to_wire.percentiles_ms(),
        )


if __name__ == "__main__":
    app()
