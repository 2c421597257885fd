"""The link against a vehicle made of bytes, on a virtual clock."""

from collections.abc import Iterator
from random import Random
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as dialect

from helpers.fakes import FakeClock
from helpers.parameters import SAFE
from helpers.wire import WireEnd
from mavbridge.core.clock import NS_PER_MS, NS_PER_S
from mavbridge.core.errors import PeerError, UserError
from mavbridge.core.link_settings import LinkSettings
from mavbridge.core.processes import free_port
from mavbridge.core.reasons import Code, because
from mavbridge.core.vehicle import (
    IDLE,
    ActionMeaning,
    AdviceText,
    Decision,
    ForwardedPacket,
    LinkSnapshot,
    Percentiles,
    Release,
    Sample,
    Sticks,
)
from mavbridge.mavlink.codec.messages import Endpoint
from mavbridge.mavlink.codec.packets import Codec
from mavbridge.mavlink.codec.signing import EPOCH_NS, Signing
from mavbridge.mavlink.link import MavlinkLink
from mavbridge.mavlink.transport.connection import Address, Received, TransportDownError
from mavbridge.mavlink.transport.sockets import make_transport

MS = NS_PER_MS
PARAMS = SAFE | {"RC_OVERRIDE_TIME": 3.0}


class Vehicle:
    """A transport, and a vehicle behind it that answers the requests of a handshake."""

    def __init__(self, clock: FakeClock) -> None:
        self.clock = clock
        self.end = WireEnd()
        self.inbox: list[Received] = []
        self.received: list[Any] = []
        self.channels = [1500, 1500, 1000, 1500, 1500, 1500, 1500, 1500]
        self.is_down = False
        self.is_deaf = False
        self.open_error: UserError | None = None
        self.address = ("127.0.0.1", 1)
        self.answered_to: Address | None = None
        self.opened = 0
        self.boot_ns = clock.now_ns()
        self.pace = 1.0
        self.is_alive = True

    # transport

    def open(self) -> None:
        self.opened += 1
        if self.open_error is not None:
            raise self.open_error
        if self.is_down:
            raise TransportDownError("tcp: refused")

    def drain(self) -> Iterator[Received]:
        if self.is_down:
            raise TransportDownError("tcp: gone")
        chunks, self.inbox = self.inbox, []
        yield from chunks

    def fileno(self) -> int | None:
        return 7

    def receiver(self, peer: Address | None) -> Address | None:
        return peer

    def send(self, data: bytes, peer: Address | None = None) -> bool:
        if self.is_down or self.is_deaf:
            return False
        self.answered_to = peer
        for message in self.end.read(data):
            self.received.append(message)
            self.answer(message)
        return True

    def close(self) -> None: ...

    # vehicle

    def put(self, message: dialect.MAVLink_message) -> None:
        self.put_bytes(self.end.pack(message))

    def put_bytes(self, data: bytes) -> None:
        self.inbox.append(Received(data, self.clock.now_ns(), self.address))

    def answer(self, message: Any) -> None:
        mav = self.end.mav
        match message.get_type():
            case "PARAM_REQUEST_READ" if message.param_id in PARAMS:
                value = PARAMS[message.param_id]
                self.put(mav.param_value_encode(message.param_id.encode(), value, 9, 99, 0))
            case "PARAM_REQUEST_READ":
                self.put(mav.param_error_encode(255, 191, message.param_id.encode(), -1, 1))
            case "COMMAND_LONG":
                self.put(mav.command_ack_encode(message.command, 0))
            case "TIMESYNC":
                tc1 = round(self.pace * (self.clock.now_ns() - self.boot_ns))
                self.put(mav.timesync_encode(tc1, message.ts1))
            case "RC_CHANNELS_OVERRIDE":
                for k in range(8):
                    value = getattr(message, f"chan{k + 1}_raw")
                    if value not in (0, 65535):
                        self.channels[k] = value

    def tick(self, tick: int) -> None:
        mav, ms = self.end.mav, (self.clock.now_ns() - self.boot_ns) // MS
        if tick % 100 == 0 and self.is_alive:
            self.put_bytes(self.end.heartbeat())
        self.put(mav.attitude_quaternion_encode(ms, 1, 0, 0, 0, 0, 0, 0))
        self.put(mav.local_position_ned_encode(ms, 0, 0, 0, 0, 0, 0))
        self.put(mav.highres_imu_encode(1000 * ms, 0, 0, -9.81, *[0.0] * 10, 8191))
        if tick % 2 == 0:
            self.put(mav.rc_channels_encode(ms, 8, *self.channels, *[0] * 10, 255))


class Rig:
    """Ticks both at 100 Hz."""

    def __init__(
        self,
        *,
        meaning: ActionMeaning | None = ActionMeaning(),  # noqa: B008 - frozen
        keeps_packets: bool = True,
        signing: Signing | None = None,
        **config: Any,
    ) -> None:
        self.clock = FakeClock()
        self.vehicle = Vehicle(self.clock)
        self.packets: list[ForwardedPacket] = []
        self.samples: list[Sample] = []
        self.link = MavlinkLink(
            self.vehicle,
            self.clock,
            LinkSettings(connect="udp:127.0.0.1:14550", **config),
            keeps_packets=keeps_packets,
            signing=signing,
        )
        if meaning is not None:
            self.link.begin_flight(meaning, None)
        self.ticks = 0
        self.texts: list[str] = []

    def run(self, duration_s: float, decision: Decision | None = None) -> LinkSnapshot:
        for _ in range(round(duration_s * 100)):
            self.vehicle.tick(self.ticks)
            self.ticks += 1
            samples, packets = self.link.receive()
            self.samples += samples
            self.packets += packets
            snapshot = self.link.snapshot()
            self.texts += snapshot.texts
            if decision is not None:
                self.link.send(decision)
            self.link.service()
            self.clock.advance_ns(10 * MS)
        return snapshot

    def ready(self) -> "Rig":
        """With the handshake behind it."""
        self.run(8.0)
        return self

    def received(self, name: str) -> list[Any]:
        return [message for message in self.vehicle.received if message.get_type() == name]

    def overrides(self) -> list[list[int]]:
        messages = self.received("RC_CHANNELS_OVERRIDE")
        return [[getattr(message, f"chan{k}_raw") for k in range(1, 9)] for message in messages]

    def commands(self, number: int) -> list[tuple[float, float]]:
        messages = self.received("COMMAND_LONG")
        return [(m.param1, m.param2) for m in messages if m.command == number]


def test_another_firmware_at_the_address_gets_sticks_of_its_own_kind() -> None:
    rig = Rig().ready()
    rig.vehicle.is_alive = False
    rig.run(4.0)
    rig.vehicle.is_alive = True
    become_px4(rig)
    rig.run(9.0)
    rig.run(0.1, Sticks(0.1, 0.0, 0.2, 0.0))
    assert rig.link.autopilot.startswith("px4")
    assert rig.received("MANUAL_CONTROL")
    assert not rig.received("RC_CHANNELS_OVERRIDE")


PILOTS = Release()
RELEASE_US = [0, 0, 0, 0, 65535, 65535, 65535, 65535]


def test_a_silent_vehicle_is_lost_with_what_may_explain_it_and_found_again() -> None:
    """ArduPilot 4.7 with a key sent its state, and no parameter; "does it have RC input?"."""
    signing, slow = Rig(), Rig()
    signing.vehicle.end.mav.signing.secret_key = bytes(range(32))
    signing.vehicle.end.mav.signing.sign_outgoing = True
    signing.vehicle.is_deaf = True
    slow.vehicle.pace = 0.25
    for rig, hints in ((Rig(), ()), (signing, (Code.VEHICLE_SIGNS,)), (slow, (Code.SLOW_CLOCK,))):

        def problem(after_s: float, rig: Rig = rig) -> tuple[Code, ...]:
            why = rig.run(after_s).problem
            return () if why is None else why.codes

        hinted = (Code.WITH_HINT,) * len(hints)
        unheard = (*hinted, Code.REQUESTING_TELEMETRY, *hints) if rig is signing else ()
        assert problem(12.0) == unheard
        rig.vehicle.is_alive = False
        assert problem(1.9) == unheard  # the last beat was a second before
        assert problem(1.2) == (*hinted, Code.HEARTBEAT_LOST, *hints)
        rig.vehicle.is_alive = True
        assert (problem(1.0) == ()) is (rig is not signing)
    assert len([text for text in slow.texts if "the vehicle's clock runs at 0.25" in text]) == 1


@pytest.mark.parametrize("is_px4", [False, True])
def test_we_beat_once_a_second_and_as_a_ground_station_to_px4_alone(is_px4: bool) -> None:
    """PX4 sends texts to nobody else; until the vehicle is known we are an onboard computer."""
    rig = px4_rig() if is_px4 else Rig()
    rig.run(5.0)
    rig.clock.advance_ns(10 * NS_PER_S)  # unserviced
    onboard, station = dialect.MAV_TYPE_ONBOARD_CONTROLLER, dialect.MAV_TYPE_GCS
    kinds = [message.type for message in rig.received("HEARTBEAT")]
    assert len(kinds) == 5
    assert (kinds[0], kinds[-1]) == (onboard, station if is_px4 else onboard)


def test_releases_leave_every_50_ms_while_they_are_asked_for_and_not_for_ever() -> None:
    rig = Rig().ready()
    for k in range(2):
        rig.run(0.2, IDLE)
        count = len(rig.overrides())
        rig.run(0.01, PILOTS)
        assert rig.overrides()[count:] == [RELEASE_US]  # in the same tick
        rig.run(0.05 + 0.05 * k, PILOTS)
        rig.run(1.0)  # nobody asks
        assert rig.overrides()[count:] == [RELEASE_US] * (2 + k)
    rig.run(0.01, PILOTS)
    rig.run(0.01, IDLE)
    count = len(rig.overrides())
    rig.run(0.01, PILOTS)
    assert rig.overrides()[count:] == [RELEASE_US]  # the last one was before an override
    rig.run(6.0, PILOTS)
    assert rig.overrides()[count:] == [RELEASE_US] * 80
    assert rig.link.stats().sent_actions == 41


@pytest.mark.parametrize(("dropped", "is_refused"), [(1, True), (2, True), (1, False)])
def test_level_sticks_precede_a_release_over_a_link_that_drops_some(
    dropped: int, is_refused: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without a receiver, ArduPilot keeps the last sticks that it heard."""
    rig = Rig()
    rig.vehicle.channels = [0] * 8
    beat = rig.vehicle.end.heartbeat(armed=True)
    monkeypatch.setattr(rig.vehicle.end, "heartbeat", lambda: beat)
    rig.ready().run(0.3, Sticks(0.3, 0.0, 0.5, 0.5))
    count, send = len(rig.overrides()), rig.vehicle.send
    fates = iter([not is_refused] * dropped)

    def drop(data: bytes, peer: Address | None = None) -> bool:
        is_override = data[7] == dialect.MAVLINK_MSG_ID_RC_CHANNELS_OVERRIDE
        fate = next(fates, None) if is_override else None
        return send(data, peer) if fate is None else fate

    monkeypatch.setattr(rig.vehicle, "send", drop)
    snapshot = rig.run(0.3, PILOTS)
    first, *_, last = rig.overrides()[count:]
    assert (first[:4], last) == ([1500] * 4, RELEASE_US)
    assert not snapshot.is_released  # the vehicle shows only ours


def test_the_report_tells_of_echo_and_clocks() -> None:
    rig = Rig().ready()
    told = rig.link.stats()
    assert told.echo_confirmed is None  # nothing was sent
    rig.run(0.8, IDLE)
    told = rig.link.stats()
    assert (told.sent_actions, told.echo_confirmed) == (80, True)
    assert told.rtt_ms == Percentiles(p50=0.0, p99=0.0, p999=0.0, max=0.0)
    assert (told.is_timesync_good, told.slow_clock) == (True, None)
    assert told.vehicle_clock_offset_ns == -rig.vehicle.boot_ns
    assert told.timesync_error_ms == pytest.approx(0.01, abs=0.01)  # by drift since an exchange


def test_readonly_sends_no_stick() -> None:
    # Heard in time, it may settle; nobody records its packets.
    rig = Rig(readonly=True, connect_timeout_s=0.1, keeps_packets=False).ready()
    rig.run(1.0, IDLE)
    assert rig.samples
    assert rig.packets == []
    assert rig.overrides() == []
    rig.link.announce("mavbridge: the policy has control")
    rig.run(0.1)
    assert rig.received("STATUSTEXT") == []


def test_a_lost_connection_to_the_same_peer_is_opened_again_once_a_second() -> None:
    rig = Rig().ready()
    assert rig.link.fileno() == 7
    rig.vehicle.is_down = True
    rig.run(3.05)
    assert (rig.vehicle.opened, rig.link.fileno()) == (1 + 3, None)  # nothing to select on
    rig.vehicle.is_down, rig.vehicle.open_error = False, UserError("port in use")
    assert rig.run(3.0).problem == because(Code.CONNECTION_LOST)
    rig.vehicle.open_error, rig.vehicle.answered_to = None, None
    assert rig.run(2.0).problem is None
    assert rig.vehicle.answered_to == ("127.0.0.1", 1)
    lost = ["tcp: gone", "tcp: refused", "port in use"]  # each once, not once a second
    told = [text for text in rig.texts if "connection lost" in text]
    assert told == [f"connection lost ({why}); reconnecting" for why in lost]


def test_on_the_ground_a_vehicle_that_moves_is_followed_and_said_to_have_moved() -> None:
    rig = Rig()
    assert rig.run(8.0).interruption is None
    told = []
    for count, port in enumerate((2, 1), 1):
        rig.vehicle.address = ("127.0.0.1", port)
        snapshot = rig.run(10.0)
        assert snapshot.interruptions == count
        told.append(snapshot.interruption)
        assert rig.vehicle.answered_to == ("127.0.0.1", port)
        assert rig.run(0.1).problem is None
    assert all(why is not None and why.code is Code.MOVED_AT_REST for why in told)
    assert all(str(why) in rig.texts for why in told)
    assert "now sends from 127.0.0.1:2 instead of 127.0.0.1:1" in str(told[0])
    assert told[0] != told[1]


def test_a_vehicle_that_becomes_a_plane_is_refused_and_has_not_moved() -> None:
    rig = Rig().ready()
    plane = rig.vehicle.end.mav.heartbeat_encode(1, 3, 81, 0, 4)
    rig.vehicle.end.heartbeat = lambda: rig.vehicle.end.pack(plane)  # type: ignore[method-assign]
    with pytest.raises(PeerError, match="FIXED_WING"):
        rig.run(5.0)
    assert not any("now sends from" in text for text in rig.texts)


def test_in_flight_a_vehicle_is_followed_each_time_that_it_moves() -> None:
    rig = Rig().ready()
    rig.link.is_engaged = True
    for port in (2, 1, 2, 1):
        rig.vehicle.address = ("127.0.0.1", port)
        rig.run(1.0, IDLE)  # a heartbeat comes before it counts as moved
        assert rig.vehicle.answered_to == rig.vehicle.address


@pytest.mark.parametrize("is_engaged", [False, True])
def test_a_second_sender_with_the_vehicles_id_is_ignored_and_ends_no_flight(
    is_engaged: bool,
) -> None:
    rig = Rig().ready()
    rig.link.is_engaged = is_engaged
    for _ in range(3):
        stranger = Received(WireEnd().heartbeat(mode=9), rig.clock.now_ns(), ("10.0.0.9", 4))
        rig.vehicle.inbox.append(stranger)
        snapshot = rig.run(1.0, IDLE)
    assert (snapshot.interruption, snapshot.problem) == (None, None)
    assert snapshot.status is not None
    assert snapshot.status.mode == "ALT_HOLD"
    told = [text for text in rig.texts if "10.0.0.9:4" in text]
    assert len(told) == 1
    assert "is ignored: the vehicle is at 127.0.0.1:1" in told[0]


def test_mode_and_arm_are_requested_and_refusals_are_reported() -> None:
    rig = Rig().ready()
    rig.link.commands.set_mode("ACRO")
    rig.link.commands.arm()
    assert (rig.commands(176), rig.commands(400)) == ([(1, 1)], [(1, 0)])
    rig.vehicle.put(rig.vehicle.end.mav.command_ack_encode(400, dialect.MAV_RESULT_FAILED))
    rig.vehicle.put(rig.vehicle.end.mav.statustext_encode(2, b"Arm: Throttle too high"))
    rig.run(0.01)
    assert "the vehicle answered COMPONENT_ARM_DISARM with FAILED" in rig.texts
    assert "vehicle: Arm: Throttle too high" in rig.texts


def become_px4(rig: Rig) -> Rig:
    beat = rig.vehicle.end.heartbeat
    rig.vehicle.end.heartbeat = (  # type: ignore[method-assign]
        lambda **options: beat(**(options | {"autopilot": 12, "mode": 2 << 16}))
    )
    return rig


def px4_rig(**config: Any) -> Rig:
    return become_px4(Rig(**config))


def test_other_peoples_sticks_that_px4_passes_on_are_not_its_own() -> None:
    """PX4's links pass the packets of other senders on, under their own ids."""
    rig = px4_rig().ready()
    count = len(rig.packets)
    for system, component in ((42, 191), (255, 190), (1, 191)):
        sender = WireEnd(system=system, component=component)
        rig.vehicle.put_bytes(sender.pack(sender.mav.manual_control_encode(1, 900, 0, 500, 0, 0)))
    rig.run(0.1)
    assert all(packet.data[7] != 69 for packet in rig.packets[count:])
    rig.vehicle.put(rig.vehicle.end.mav.manual_control_encode(1, 900, 0, 500, 0, 0))
    rig.run(0.1)
    assert [packet.data[5:8] for packet in rig.packets if packet.data[7] == 69] == [b"\1\1\x45"]


def test_without_a_policy_nothing_is_sent() -> None:
    rig = Rig(meaning=None)
    assert rig.run(8.0, IDLE).problem == because(Code.NO_POLICY_LOADED)
    assert rig.overrides() == []
    with pytest.raises(PeerError, match="--output rc-override"):
        rig.link.begin_flight(ActionMeaning(), "manual-control")
    rig.link.begin_flight(ActionMeaning(), None)
    assert rig.run(0.1, PILOTS).problem is None
    assert rig.overrides() == []  # nothing is released that was never overridden
    assert rig.run(0.1, IDLE).echo_confirmed


def test_acks_for_other_stations_are_ignored() -> None:
    rig = Rig()
    rig.run(2.0)
    for _ in range(6):
        denied = dialect.MAV_RESULT_DENIED
        rig.vehicle.put(rig.vehicle.end.mav.command_ack_encode(511, denied, 0, 0, 250, 190))
        rig.run(0.01)
    rig.run(6.0)
    intervals = [number for number, _ in rig.commands(511)]
    assert intervals[:8] == [31, 32, 105, 65, 1, 245, 193, 0]
    assert set(intervals[8:]) == {1, 245, 193, 0}  # which this vehicle grants and never sends


def test_advice_is_shown_once_and_ends_where_its_values_keep_changing() -> None:
    rig = Rig()
    for k in range(1000):
        rig.link._report(AdviceText(f"RC_OVERRIDE_TIME is {k // 2}"))
        rig.link._report("lost")
    texts = rig.link.snapshot().texts
    assert texts.count("lost") == 1000
    assert [t for t in texts if t != "lost"] == [f"RC_OVERRIDE_TIME is {k}" for k in range(100)]


@pytest.mark.parametrize("is_signed", [False, True])
@pytest.mark.parametrize("sends_noise", [False, True])
def test_without_a_vehicle_the_cause_is_told(is_signed: bool, sends_noise: bool) -> None:
    """At a wrong baud rate half of the bytes look like packets of unknown messages: nobody can
    check their sums."""
    signing = Signing(bytes(32), unix_ns=lambda: EPOCH_NS) if is_signed else None
    rig, noise = Rig(connect_timeout_s=5.0, signing=signing), Random(1)
    unsigned = rig.vehicle.end.pack(rig.vehicle.end.mav.heartbeat_encode(6, 8, 0, 0, 4))
    told = "no MAVLink in it" if sends_noise else "heard only GCS"
    if is_signed and not sends_noise:
        told = "refusing packets without a signature"
    rig.vehicle.address = None
    for _ in range(50):
        rig.vehicle.put_bytes(noise.randbytes(600) if sends_noise else unsigned)
        rig.link.receive()
        rig.link.service()
        rig.clock.advance_ns(100 * MS)
    rig.clock.advance_ns(1000 * MS)
    with pytest.raises(PeerError, match=told):
        rig.link.service()


def test_a_system_that_refuses_every_packet_is_told() -> None:
    clock, spec = FakeClock(), "udpout:255.255.255.255:14550"  # a broadcast needs a permission
    settings = LinkSettings(connect=spec, connect_timeout_s=1.0)
    link = MavlinkLink(make_transport(spec, clock), clock, settings)
    link.service()
    clock.advance_ns(1100 * MS)
    with pytest.raises(PeerError, match=r"refuses to send there \((Permission|Network)"):
        link.service()
    link.close()


@pytest.mark.parametrize("behind_s", [0, 3600])
def test_a_vehicle_whose_signing_clock_is_behind_gets_the_time_from_us(behind_s: int) -> None:
    """After a reboot PX4 signs by its stored time, until it hears a signed packet."""
    clock, port, key, now_ns = FakeClock(), free_port(), bytes(range(32)), EPOCH_NS + 10**18
    ours = Signing(key, unix_ns=lambda: now_ns)
    settings = LinkSettings(connect=f"udp:127.0.0.1:{port}")
    link = MavlinkLink(make_transport(settings.connect, clock), clock, settings, signing=ours)
    behind = Signing(key, unix_ns=lambda: now_ns - behind_s * NS_PER_S)
    vehicle = Codec(source_system=1, signing=behind)
    end = make_transport(f"udpout:127.0.0.1:{port}", clock)
    vehicle.source = Endpoint(1, 1)
    end.open()
    for _ in range(4):
        beat = vehicle._pack(dialect.MAVLink_heartbeat_message, 0, 2, 3, 0, 4, 3)
        end.send(beat)
        link.receive()
        link.service()
        clock.advance_ns(1000 * MS)
        for data, _, _ in end.drain():
            list(vehicle.decode(data))
    assert link.vehicle is not None
    link.close()
    end.close()
