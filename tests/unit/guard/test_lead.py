"""Sticks that are decided before their slot leave when it is due."""

import pytest

from helpers.factories import START_NS
from helpers.fakes import FOREVER_NS, FakeClock
from helpers.guard_facts import engagement_settings, stick_smoothing
from mavbridge.core.clock import NS_PER_MS
from mavbridge.core.vehicle import (
    Action,
    ActionMeaning,
    Decision,
    LinkSnapshot,
    Outlet,
    Output,
    Sticks,
    Telemetry,
    VehicleStatus,
)
from mavbridge.guard.chunks import Chunk, FreshnessLimits
from mavbridge.guard.envelope import EnvelopeLimits
from mavbridge.guard.loop import GuardLoop
from mavbridge.guard.sequences import DisengageSettings
from mavbridge.guard.settings import FlightSettings
from mavbridge.guard.wire import encode_to_guard

PERIOD_NS = 10 * NS_PER_MS
LEAD_NS = NS_PER_MS
DAY_NS = 86_400_000 * NS_PER_MS
FLIGHT = FlightSettings(
    meaning=ActionMeaning(),
    stick_period_ns=PERIOD_NS,
    chunk_period_ns=DAY_NS,  # one chunk is enough
    freshness=FreshnessLimits(
        state_ns=DAY_NS, velocity_ns=DAY_NS, feature_ns=DAY_NS, chunk_ns=DAY_NS
    ),
    smoothing=stick_smoothing(),
    envelope=EnvelopeLimits(),
    watches_home_height=False,
    watches_position=False,
    engagement=engagement_settings(modes=("ALT_HOLD",), disengage=DisengageSettings()),
)


class ReadyVehicle:
    """A link to a vehicle that is armed in ALT_HOLD; receiving takes 0.3 ms."""

    is_engaged = False
    autopilot = "ardupilot"
    is_restored = True
    outlet = Outlet(1, None, None)

    def __init__(self, clock: FakeClock) -> None:
        self._clock = clock
        self.sent_ns: list[int] = []

    def poll(self) -> LinkSnapshot:
        self._clock.advance_ns(300_000)
        status = VehicleStatus(mode="ALT_HOLD", armed=True)
        return LinkSnapshot(telemetry=Telemetry(), status=status, problem=None)

    def send_before_action(self) -> None:
        pass

    def begin_flight(self, meaning: ActionMeaning, output: Output | None) -> None:
        pass

    def send(self, _decision: Decision, _decided_ns: int) -> Action | None:
        self.sent_ns.append(self._clock.now_ns())
        return None

    def service(self) -> None:
        pass

    def announce(self, text: str) -> None:
        pass

    def rehearse(self, plan: object) -> tuple[tuple[int, bytes], ...]:
        return ()

    def transmit(self, packet: bytes) -> bool:
        return True


class FewChunks:
    """A flight process that sends its settings, three chunks and the act, and then nothing."""

    is_closed = False

    def __init__(self) -> None:
        actions = (Sticks(0.1, 0.0, 0.0, 0.0),)
        stamps = (*[START_NS] * 5, DAY_NS)
        chunks = [Chunk(k, *stamps, actions, FOREVER_NS) for k in (1, 2, 3)]
        self._inbox = [encode_to_guard(message) for message in (FLIGHT, *chunks, "engage")]

    def send(self, _message: bytes, fd: int | None = None) -> bool:
        return True

    def receive(self) -> list[bytes]:
        inbox, self._inbox = self._inbox[:1], self._inbox[1:]
        return inbox


@pytest.mark.parametrize(("lead_ns", "late_ns"), [(0, 300_000), (LEAD_NS, 0)])
def test_the_work_before_a_send_makes_it_late_only_without_a_lead(
    lead_ns: int, late_ns: int
) -> None:
    clock = FakeClock()
    vehicle = ReadyVehicle(clock)
    loop = GuardLoop(clock, vehicle, FewChunks(), lead_ns=lead_ns)
    for _ in range(10):
        clock.sleep_until_ns(loop.step())
    first_slot_ns, *slots_ns = vehicle.sent_ns[1:]
    assert len(slots_ns) >= 3
    for number, sent_ns in enumerate(slots_ns, 1):
        assert sent_ns == first_slot_ns + number * PERIOD_NS
    grid_ns = START_NS + 300_000  # where the guard was made
    assert (first_slot_ns - grid_ns) % PERIOD_NS == late_ns
