"""The guard, the policy loop and the simulated vehicle in memory, on a stepped clock.

Everything between the policy and the vehicle's motors is real; the camera is not: each solve finds
a fresh feature. A test moves the pilot's sticks, breaks the link, and reads the vehicle's own
record and the sent bytes.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as dialect

from helpers.fakes import ListSink
from helpers.guard_facts import codes
from helpers.guard_world import FlightPort, FreshFeatures, LinkedVehicle
from helpers.wire import WireEnd
from mavbridge.config.flight import FlyConfig
from mavbridge.core.clock import NS_PER_MS, NS_PER_S
from mavbridge.core.reasons import Code, Reason, because
from mavbridge.core.records import Solve
from mavbridge.core.ticks import GuardTick
from mavbridge.flight.plan import plan_flight
from mavbridge.flight.policy_loop import PolicyLoop
from mavbridge.flight.settings import link_settings
from mavbridge.flight.telemetry_cache import TelemetryCache
from mavbridge.guard.loop import GuardLoop
from mavbridge.guard.values import EndRequest, OperatorCommand, Phase
from mavbridge.guard.wire import LastWords, ToGuard, encode
from mavbridge.mavlink.link import MavlinkLink
from mavbridge.simulation.clock import AheadClock
from mavbridge.simulation.network import DelayedChannel, GuardStepper, MemoryPort, flight_process
from policy.protocol import PolicyRunner
from sitl.vehicle.config import VehicleConfig

MS = NS_PER_MS


class GuardFlight(LinkedVehicle):
    """One flight of one vehicle. Nothing happens until ``run`` or ``until`` is called."""

    def __init__(self, vehicle: VehicleConfig, params: dict[str, float], config: FlyConfig) -> None:
        super().__init__(vehicle, params)
        self.is_flight_process_stopped = False
        """True if it neither receives nor sends, as under SIGSTOP."""
        hop_ns = iter(lambda: NS_PER_MS // 10, None)
        to_guard = DelayedChannel(self.clock, hop_ns)
        to_flight = DelayedChannel(self.clock, hop_ns)
        self._port = MemoryPort(outgoing=to_guard, incoming=to_flight)
        self.guard_port = FlightPort(outgoing=to_flight, incoming=to_guard)
        settings = replace(link_settings(config, config.rates.loops(is_dual=True)), state_hz=100.0)
        self.link = MavlinkLink(self.network, self.clock, settings)
        self.guard = GuardLoop(self.clock, self.link, self.guard_port)
        self.features = FreshFeatures(self.clock)
        self.sink = ListSink()
        self.solves: list[Solve] = []
        self._policy_clock = AheadClock(self.clock)
        runner = self._runner()
        plan = plan_flight(config, runner.contract, is_dual=runner.dual_rate)
        self.view = TelemetryCache(plan, sink=self.sink)
        policy = PolicyLoop(
            plan,
            runner,
            clock=self._policy_clock,
            view=self.view,
            caches=[self.features],
            send=self._send,
            watches=[self.solves.append],
        )
        self.tell(plan.guard)
        receive = flight_process(self.clock, self._policy_clock, self._port, policy, self.view)
        stepper = GuardStepper(self.clock, self.guard)
        to_flight.on_arrival = lambda: None if self.is_flight_process_stopped else receive()
        to_guard.on_arrival = self.down.on_arrival = stepper.step
        self._wake = stepper.step

    # --- the flight process

    def _runner(self) -> PolicyRunner:
        """Return the policy, whose calls take time of ``_policy_clock``."""
        raise NotImplementedError

    def _send(self, message: ToGuard) -> None:
        data = encode(message)
        at_ns = self._policy_clock.now_ns()
        self.clock.schedule(
            at_ns, lambda: None if self.is_flight_process_stopped else self._port.send(data)
        )

    def tell(self, message: ToGuard) -> None:
        self._port.send(encode(message))

    def act(self, act: OperatorCommand) -> None:
        self.tell(act)

    def stop(self) -> None:
        """Request the end by Ctrl-C."""
        self.tell(EndRequest(reason=because(Code.SIGNAL)))

    def die(self) -> None:
        """Kill the flight process: the guard reads the end of file."""
        self.is_flight_process_stopped = True
        self.guard_port.is_closed = True
        self._wake()

    def kill_guard(self) -> None:
        """Kill the guard; the flight process sends its last words after 2 ms."""
        self.guard.is_done = True
        words = [r for r in self.guard_port.reports if isinstance(r, LastWords)][-1]
        for after_ns, packet in words.packets:
            at_ns = self.clock.now_ns() + 2 * MS + after_ns
            self.clock.schedule(at_ns, partial(self.up.send, packet))

    # --- time

    def run(self, seconds: float) -> None:
        self.clock.sleep_until_ns(self.clock.now_ns() + round(seconds * NS_PER_S))

    def until(self, condition: Callable[[], object], *, within_s: float) -> float:
        """Let time pass until the condition holds; return the seconds that it took."""
        start_ns = self.clock.now_ns()
        end_ns = start_ns + round(within_s * NS_PER_S)
        while not condition():
            assert self.clock.now_ns() < end_ns, f"not within {within_s} s: {self.describe()}"
            self.clock.sleep_until_ns(self.clock.now_ns() + MS)
        return (self.clock.now_ns() - start_ns) / NS_PER_S

    def describe(self) -> str:
        """Return the state of both ends, for a failed test."""
        ap, told = self.vehicle.ap, [r for r in self.guard_port.reports if isinstance(r, str)]
        return (
            f"{self.phase} ({self.reason}); {ap.mode_name}, armed {ap.armed}, "
            f"height {self.height_m:.1f} m, {told}"
        )

    @property
    def summary(self) -> dict[str, Any]:
        return self.vehicle.log.summary(self.vehicle.ap)

    # --- what happened

    @property
    def height_m(self) -> float:
        return -self.vehicle.ap.truth.position_ned_m[2]

    @property
    def ticks(self) -> list[GuardTick]:
        return [r for r in self.guard_port.reports if isinstance(r, GuardTick)]

    @property
    def _last(self) -> GuardTick | None:
        reports = reversed(self.guard_port.reports)
        return next((each for each in reports if isinstance(each, GuardTick)), None)

    @property
    def phase(self) -> Phase:
        return self._last.phase if self._last else Phase.WAITING

    @property
    def reason(self) -> Reason | None:
        return self._last.release_reason if self._last else None

    @property
    def codes(self) -> tuple[Code, ...]:
        return codes(self.reason)

    def left(self, since_ns: int = 0) -> list[tuple[int, Any]]:
        """MAVLink messages that left the guard, with their times, including lost ones."""
        end = WireEnd()
        found = [(at_ns, m) for at_ns, data in self.up.sent for m in end.read(data)]
        return [(at_ns, m) for at_ns, m in found if at_ns >= since_ns]

    def modes_asked(self, since_ns: int = 0) -> list[int]:
        return [
            int(m.param2)
            for _, m in self.left(since_ns)
            if m.get_type() == "COMMAND_LONG" and m.command == dialect.MAV_CMD_DO_SET_MODE
        ]

    # --- others

    def command(self, number: int, *params: float) -> None:
        """Send a COMMAND_LONG of another station."""
        values = [*params, *[0.0] * (7 - len(params))]
        self.station(lambda mav: mav.command_long_encode(1, 1, number, 0, *values), system=42)

    def station(
        self, encode: Callable[[dialect.MAVLink], dialect.MAVLink_message], *, system: int = 255
    ) -> None:
        """Send a message of another station over a separate link."""
        end = WireEnd(system=system, component=190)
        self.vehicle.receive(1, end.pack(encode(end.mav)), self.clock.now_ns())
