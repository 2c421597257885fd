"""The guard, the policy loop and the simulated vehicle in memory, on a stepped clock.

Everything between the policy and the vehicle's motors is real; the camera is not: each solve finds
a fresh feature. A test moves the pilot's sticks, breaks the link, and reads the vehicle's own
record and the sent bytes.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, Self

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as dialect

from helpers.fakes import ListSink
from helpers.guard_facts import codes
from helpers.guard_world import Direction, FlightPort, FreshFeatures, Network
from helpers.wire import WireEnd
from mavbridge.config.flight import FlyConfig, LinkConfig
from mavbridge.core.clock import NS_PER_MS, NS_PER_S
from mavbridge.core.reasons import Code, Reason, because
from mavbridge.core.records import Solve
from mavbridge.core.ticks import GuardTick
from mavbridge.core.vehicle import Sticks
from mavbridge.flight.plan import plan_flight
from mavbridge.flight.policy_loop import PolicyLoop
from mavbridge.flight.settings import link_settings
from mavbridge.flight.telemetry_cache import TelemetryCache
from mavbridge.guard.loop import GuardLoop
from mavbridge.guard.values import EndRequest, OperatorCommand, Phase
from mavbridge.guard.wire import LastWords, ToGuard, encode_to_guard
from mavbridge.mavlink.link import MavlinkLink
from mavbridge.mavlink.transport.connection import Address, Received
from mavbridge.simulation.clock import AheadClock, SteppedClock
from mavbridge.simulation.guard import GuardStepper, MemoryPort, flight_process
from mavbridge.simulation.network import DelayedChannel
from mavbridge.simulation.world import NOMINAL_VEHICLE, VehicleStepper
from policy.contract import Contract, FloatArray
from policy.protocol import PolicyRunner
from sitl.ardupilot.autopilot import ArduCopter
from sitl.ardupilot.flight_modes import Mode
from sitl.course import AirborneStart
from sitl.simulated_vehicle import SimulatedVehicle
from sitl.vehicle.config import MID_RECEIVER_US, VehicleConfig

MS = NS_PER_MS
ALOFT = AirborneStart(
    position_ned_m=(0.0, 0.0, -10.0),
    velocity_ned_mps=(0.0, 0.0, 0.0),
    ned_from_body_wxyz=(1.0, 0.0, 0.0, 0.0),
    next_gate=0,
)
HOVER = (0.0, 0.0, 0.0, 0.0)
CONTRACT = Contract(feature_dim=1, arrays="numpy")
Policy = Callable[[float], tuple[float, float, float, float]]
"""Seconds since the first flight began (negative before it) -> throttle, yaw, pitch, roll."""


def hovering(_: float) -> tuple[float, float, float, float]:
    return HOVER


def leaning(_: float) -> tuple[float, float, float, float]:
    """Return sticks far enough from neutral, and any receiver, to be told apart in records."""
    return (0.0, 0.1, 0.2, 0.3)


def climbing_first(t_s: float) -> tuple[float, float, float, float]:
    """Climb from the ground to some 4 m, then hover with a lean."""
    return (0.9, 0.0, 0.0, 0.0) if t_s < 2.5 else (0.0, 0.0, 0.0, 0.25)


class GuardFlight:
    """One flight of one vehicle. Nothing happens until ``run`` or ``until`` is called."""

    def __init__(
        self,
        policy: Policy = leaning,
        *,
        receiver_us: tuple[int, ...] | None = MID_RECEIVER_US,
        params: dict[str, float] | None = None,
        contract: Contract = CONTRACT,
        link: dict[str, Any] | None = None,
        vehicle: VehicleConfig = NOMINAL_VEHICLE,
        **config: Any,
    ) -> None:
        """``config`` are fields of ``FlyConfig``, ``link`` those of ``LinkConfig``."""
        self.clock = SteppedClock()
        self.policy = policy
        self.solve_ns = 3 * MS
        self._engaged_ns: int | None = None
        self.is_flight_process_stopped = False
        """True if it neither receives nor sends, as under SIGSTOP."""
        self.vehicle = SimulatedVehicle(
            links=2,
            boot_ns=self.clock.now_ns(),
            config=replace(vehicle, receiver_us=receiver_us),
        )
        for name, value in (params or {}).items():
            assert self.vehicle.params.set(name, value), name
        self.up, self.down = Direction(self.clock), Direction(self.clock)
        self.network = Network(self.clock, self.up, self.down)
        self._compose(
            FlyConfig(link=LinkConfig(connect="memory", **(link or {})), **config),
            contract,
        )
        ends = {"to_vehicle": self.up, "from_vehicle": self.down}
        stepper = VehicleStepper(self.clock, self.vehicle, self.clock.now_ns(), **ends)
        stepper.watchers.append(self._after_step)

    def _compose(self, config: FlyConfig, contract: Contract) -> None:
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
        runner = self._runner(contract)
        self._horizon = contract.horizon
        self._policy_clock = AheadClock(self.clock)
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

    def _runner(self, contract: Contract) -> PolicyRunner:
        return PolicyRunner(
            contract=contract,
            name="test",
            engine="numpy",
            dual_rate=True,
            encode=lambda rgb, camera=0: np.zeros((1, 1), np.float32),
            act=self._act,
        )

    def _act(self, encoded: FloatArray, state: FloatArray, history: FloatArray) -> FloatArray:
        self._policy_clock.ahead_ns += self.solve_ns
        chunk = np.empty((1, self._horizon, 4), np.float32)
        chunk[:] = self.policy(self.flown_s)
        return chunk

    def _send(self, message: ToGuard) -> None:
        data = encode_to_guard(message)
        at_ns = self._policy_clock.now_ns()
        self.clock.schedule(
            at_ns, lambda: None if self.is_flight_process_stopped else self._port.send(data)
        )

    def tell(self, message: ToGuard) -> None:
        self._port.send(encode_to_guard(message))

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

    def _after_step(self) -> None:
        """Called after each step of the vehicle; other stations read nothing."""
        self.vehicle.take_outgoing(1)

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
        ap = self.vehicle.ap
        return (
            f"{self.phase} ({self.reason}); {ap.mode_name}, armed {ap.armed}, "
            f"height {self.height_m:.1f} m, {self.messages}"
        )

    @property
    def summary(self) -> dict[str, Any]:
        return self.vehicle.log.summary(self.vehicle.ap)

    @property
    def t_s(self) -> float:
        """Seconds since boot: the time of the vehicle's records."""
        return self.summary["duration_s"]

    @property
    def flown_s(self) -> float:
        """Seconds since the policy first flew; negative before."""
        ticks = (r for r in self.guard_port.reports if isinstance(r, GuardTick))
        if self._engaged_ns is None:
            self._engaged_ns = next((t.sent_ns for t in ticks if t.phase is Phase.FLYING), None)
        if self._engaged_ns is None:
            return -1.0
        return (self.clock.now_ns() - self._engaged_ns) / NS_PER_S

    # --- ways into the air

    def launch(self) -> Self:
        """Hover armed under the pilot, with the link ready and the policy fresh."""
        self.vehicle.launch(ALOFT)
        self.ap.set_mode(Mode.ALT_HOLD)
        self.until(lambda: self.codes == (Code.NOT_ENGAGED,), within_s=8)
        return self

    def fly(self, seconds: float = 1.5) -> Self:
        """Launch, engage by the key, and let the policy fly long enough for the echo."""
        self.launch()
        self.act("engage")
        self.until(lambda: self.phase is Phase.FLYING, within_s=1.5)
        self._begin_program()
        self.run(seconds)
        assert self.phase is Phase.FLYING, self.describe()
        return self

    def _begin_program(self) -> None:
        """Called when the policy has the sticks."""

    def take_off(self, seconds: float = 4.0) -> Self:
        """Engage with --arm on the ground, and climb; also for a vehicle without a receiver."""
        self.until(lambda: self.phase is Phase.FLYING, within_s=12)
        self.run(seconds)
        assert self.phase is Phase.FLYING, self.describe()
        assert self.height_m > 2, self.describe()
        return self

    # --- what happened

    @property
    def ap(self) -> ArduCopter:
        return self.vehicle.ap

    @property
    def height_m(self) -> float:
        return -self.vehicle.ap.truth.position_ned_m[2]

    @property
    def ticks(self) -> list[GuardTick]:
        return [r for r in self.guard_port.reports if isinstance(r, GuardTick)]

    @property
    def last(self) -> GuardTick | None:
        return next(
            (r for r in reversed(self.guard_port.reports) if isinstance(r, GuardTick)), None
        )

    @property
    def phase(self) -> Phase:
        return self.last.phase if self.last else Phase.WAITING

    @property
    def reason(self) -> Reason | None:
        return self.last.release_reason if self.last else None

    @property
    def codes(self) -> tuple[Code, ...]:
        return codes(self.reason)

    @property
    def messages(self) -> list[str]:
        return [r for r in self.guard_port.reports if isinstance(r, str)]

    def phases(self, since_ns: int = 0) -> list[Phase]:
        """Phases in order, without repeats."""
        found: list[Phase] = []
        for tick in self.ticks:
            if tick.sent_ns >= since_ns and (not found or found[-1] is not tick.phase):
                found.append(tick.phase)
        return found

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

    def sticks_sent(self, since_ns: int = 0) -> list[tuple[int, Sticks]]:
        """Sent overrides as sticks, without releases."""
        return [
            (t.sent_ns, t.sent) for t in self.ticks if t.sent is not None and t.sent_ns >= since_ns
        ]

    def overrides(self, since_ns: int = 0) -> list[tuple[int, tuple[int, ...]]]:
        """First four channels of each sent RC_CHANNELS_OVERRIDE [us]."""
        return [
            (at_ns, (m.chan1_raw, m.chan2_raw, m.chan3_raw, m.chan4_raw))
            for at_ns, m in self.left(since_ns)
            if m.get_type() == "RC_CHANNELS_OVERRIDE"
        ]

    def record(self, since_s: float = 0.0) -> list[dict[str, Any]]:
        """The vehicle's own record of its sticks, by time since boot."""
        return [entry for entry in self.summary["sticks"] if entry["t_s"] >= since_s]

    @property
    def modes(self) -> list[str]:
        return [entry["mode"] for entry in self.summary["modes"]]

    # --- others

    def pilot_mode(self, number: int) -> None:
        self.command(dialect.MAV_CMD_DO_SET_MODE, 1, number)

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

    def joystick(self, rate_hz: float, us: tuple[int, int, int, int]) -> None:
        """Override the same channels from now on with a joystick that uses our system id."""

        def send() -> None:
            self.station(lambda mav: mav.rc_channels_override_encode(1, 1, *us, 0, 0, 0, 0))
            self.clock.schedule(self.clock.now_ns() + round(NS_PER_S / rate_hz), send)

        # Halfway between two of our sends: just before one it would never be shown.
        self.clock.schedule(self.clock.now_ns() + 13 * MS // 2, send)

    def receiver(self, **channels_us: int) -> None:
        """Move sticks and switches of the transmitter: ch3=1500."""
        values = [0] * 8
        for name, value_us in channels_us.items():
            values[int(name.removeprefix("ch")) - 1] = value_us
        self.vehicle.set_receiver(values)

    def inject(self, data: bytes, sender: Address) -> None:
        """Send bytes to the guard from another address."""
        self.network.strangers.append(Received(data, self.clock.now_ns(), sender))
        self._wake()
