"""The link against a vehicle made of bytes, on a virtual clock."""

from collections.abc import Iterator
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as dialect

from helpers.fakes import FakeClock
from helpers.wire import CALIBRATION, WireEnd
from mavbridge.core.clock import NS_PER_MS, NS_PER_S
from mavbridge.core.errors import PeerError
from mavbridge.core.observers import BoundedQueue
from mavbridge.core.vehicle import IDLE, Command, LinkSnapshot, Packet, Release, Sticks
from mavbridge.mavlink.link import MavlinkLink
from mavbridge.mavlink.settings import LinkSettings
from mavbridge.mavlink.transport.sockets import Address, Chunk, TransportDownError

MS = NS_PER_MS
PARAMS = CALIBRATION | {"MAV_GCS_SYSID": 255.0, "RC_OVERRIDE_TIME": 3.0}


class Vehicle:
    """A transport, and a vehicle behind it that answers the requests of a handshake."""

    def __init__(self, clock: FakeClock) -> None:
        self.clock = clock
        self.end = WireEnd()
        self.inbox: list[Chunk] = []
        self.received: list[Any] = []
        self.params = dict(PARAMS)
        self.mode, self.armed = 2, False
        self.channels = [1500, 1500, 1000, 1500, 1500, 1500, 1500, 1500]
        self.follows_overrides = True
        self.shows_rc = True
        self.is_down = False
        self.is_deaf = False
        self.address = ("127.0.0.1", 1)
        self.answered_to: Address | None = None
        self.opened = 0
        self.boot_ns = clock.now_ns()
        self.is_alive = True

    # transport

    def open(self) -> None:
        self.opened += 1
        if self.is_down:
            raise TransportDownError("tcp: refused")

    def drain(self) -> Iterator[Chunk]:
        if self.is_down:
            raise TransportDownError("tcp: gone")
        chunks, self.inbox = self.inbox, []
        yield from chunks

    def wait(self, until_ns: int) -> None:
        """The next message comes 3 ms from now, or after the wait."""
        arrival_ns = self.clock.now_ns() + 3 * MS
        self.clock.sleep_until_ns(min(arrival_ns, until_ns))
        if arrival_ns <= until_ns and self.is_alive:
            self.tick(1)

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
        self.inbox.append(Chunk(self.end.pack(message), self.clock.now_ns(), self.address))

    def answer(self, message: Any) -> None:
        mav = self.end.mav
        match message.get_type():
            case "PARAM_REQUEST_READ" if message.param_id in self.params:
                value = self.params[message.param_id]
                self.put(mav.param_value_encode(message.param_id.encode(), value, 9, 99, 0))
            case "COMMAND_LONG":
                self.put(mav.command_ack_encode(message.command, 0))
            case "RC_CHANNELS_OVERRIDE" if self.follows_overrides:
                for k in range(8):
                    value = getattr(message, f"chan{k + 1}_raw")
                    if value not in (0, 65535):
                        self.channels[k] = value

    def tick(self, tick: int) -> None:
        mav, ms = self.end.mav, (self.clock.now_ns() - self.boot_ns) // MS
        if tick % 100 == 0 and self.is_alive:
            self.inbox.append(
                Chunk(
                    self.end.heartbeat(mode=self.mode, armed=self.armed),
                    self.clock.now_ns(),
                    self.address,
                )
            )
        self.put(mav.attitude_quaternion_encode(ms, 1, 0, 0, 0, 0, 0, 0))
        self.put(mav.local_position_ned_encode(ms, 0, 0, 0, 0, 0, 0))
        self.put(mav.highres_imu_encode(ms, 0, 0, -9.81, *[0.0] * 10, 8191))
        if tick % 5 == 0 and self.shows_rc:
            self.put(mav.rc_channels_encode(ms, 8, *self.channels, *[0] * 10, 255))

    def names(self) -> list[str]:
        return [message.get_type() for message in self.received]


class Rig:
    """Ticks both at 100 Hz."""

    def __init__(self, **config: Any) -> None:
        self.clock = FakeClock()
        self.vehicle = Vehicle(self.clock)
        self.packet_log: BoundedQueue[Packet] = BoundedQueue(20_000)
        self.link = MavlinkLink(
            self.vehicle,
            self.clock,
            LinkSettings(connect="memory", **config),
            packet_log=self.packet_log,
        )
        self.ticks = 0
        self.texts: list[str] = []

    def run(self, duration_s: float, decision: Command | Release | None = None) -> LinkSnapshot:
        for _ in range(round(duration_s * 100)):
            self.vehicle.tick(self.ticks)
            self.ticks += 1
            snapshot = self.link.poll()
            self.texts += snapshot.texts
            if decision is not None:
                self.link.send(decision)
            self.link.service()
            self.clock.advance_ns(10 * MS)
        return snapshot

    def overrides(self) -> list[list[int]]:
        return [
            [getattr(message, f"chan{k}_raw") for k in range(1, 9)]
            for message in self.vehicle.received
            if message.get_type() == "RC_CHANNELS_OVERRIDE"
        ]


IDLE_US = [1500, 1500, 1100, 1500, 65535, 65535, 65535, 65535]
RELEASE_US = [0, 0, 0, 0, 65535, 65535, 65535, 65535]


def test_from_first_heartbeat_to_ready() -> None:
    rig = Rig()
    assert rig.run(1.0).problem == "waiting for the vehicle's heartbeat"
    snapshot = rig.run(9.0)
    assert snapshot.problem is None
    assert not snapshot.echo_confirmed
    assert snapshot.status is not None
    assert (snapshot.status.mode, snapshot.status.armed) == ("ALT_HOLD", False)
    assert snapshot.status.rc_channels_us[:4] == (1500, 1500, 1000, 1500)
    assert rig.overrides() == []
    intervals = {
        int(message.param1): int(message.param2)
        for message in rig.vehicle.received
        if message.get_type() == "COMMAND_LONG" and message.command == 511
    }
    assert intervals == {31: 10000, 32: 10000, 105: 10000, 65: 50000}
    assert any("RC_OVERRIDE_TIME is 3" in text for text in rig.texts)


def test_the_packet_log_has_both_directions_and_only_what_left() -> None:
    rig = Rig()
    rig.run(9.5)
    rig.vehicle.is_deaf = True
    rig.run(1.0)
    rig.vehicle.is_deaf = False
    packets = rig.packet_log.take()
    assert rig.packet_log.dropped == 0
    end = WireEnd()
    read = [message for packet in packets for message in end.read(packet.data)]
    assert len(read) == len(packets)
    sent = [message for message in read if message.get_srcSystem() == 255]
    assert [m.get_type() for m in sent] == rig.vehicle.names()
    assert sum(m.get_type() == "ATTITUDE_QUATERNION" for m in read) == rig.ticks
    assert all(packet.stamp_ns <= rig.clock.now_ns() for packet in packets)


def test_heartbeats_go_out_once_a_second_and_only_while_serviced() -> None:
    rig = Rig()
    rig.run(5.0)
    assert rig.vehicle.names().count("HEARTBEAT") == 5
    rig.clock.advance_ns(10 * NS_PER_S)
    assert rig.vehicle.names().count("HEARTBEAT") == 5


def test_commands_are_echoed_and_confirmed() -> None:
    rig = Rig()
    rig.run(8.0)
    snapshot = rig.run(0.2, Command(sticks=IDLE))
    assert snapshot.echo_confirmed
    assert snapshot.problem is None
    assert rig.overrides()[-1] == IDLE_US
    assert rig.link.send(Command(sticks=Sticks(0.0, 0.0, 0.001, 0.5))) == Sticks(0, 0, 0, 0.5)
    assert rig.link.stats().echo_confirmed is True


@pytest.mark.parametrize(
    ("params", "expected"),
    [
        ({"MAV_GCS_SYSID": 42.0}, "--source-system 42"),
        ({"RC_OPTIONS": 2.0}, "RC_OPTIONS bit 1"),
        ({"RC_OVERRIDE_TIME": 0.0}, "RC_OVERRIDE_TIME is 0"),
    ],
)
def test_a_vehicle_that_would_ignore_us_is_reported_before_a_stick_is_sent(
    params: dict[str, float], expected: str
) -> None:
    rig = Rig()
    rig.vehicle.params |= params
    problem = rig.run(8.0).problem
    assert problem is not None
    assert "would ignore our sticks" in problem
    assert expected in problem


@pytest.mark.parametrize("resting_throttle_us", [1000, 1100])
def test_a_vehicle_that_ignores_us_is_noticed(resting_throttle_us: int) -> None:
    rig = Rig()
    rig.vehicle.channels[2] = resting_throttle_us  # 1100: just where IDLE is
    rig.vehicle.follows_overrides = False
    rig.run(8.0)
    assert rig.run(0.9, Command(sticks=IDLE)).problem is None
    snapshot = rig.run(0.3, Command(sticks=IDLE))
    assert "another station may be overriding" in (snapshot.problem or "")
    assert snapshot.is_overruled
    assert not snapshot.echo_confirmed
    assert rig.link.stats().echo_confirmed is False


def test_without_rc_channels_there_is_nothing_to_check_against() -> None:
    rig = Rig()
    rig.run(8.0)
    rig.vehicle.shows_rc = False
    rig.vehicle.follows_overrides = False
    assert "no RC_CHANNELS" in (rig.run(1.3, Command(sticks=IDLE)).problem or "")


def test_a_release_is_sent_ten_times_and_then_nothing() -> None:
    rig = Rig()
    rig.run(8.0)
    rig.run(0.2, Command(sticks=IDLE))
    rig.run(3.0, Release("pilot"))
    assert rig.overrides()[20:] == [RELEASE_US] * 10
    rig.run(1.0, Command(sticks=IDLE))
    count = len(rig.overrides())
    rig.link.send(Release("end"))
    rig.link.hand_back()
    assert rig.overrides()[count:] == [RELEASE_US] * 10
    assert rig.link.stats().sent_overrides == 120


def test_releases_that_could_not_be_sent_are_sent_later() -> None:
    rig = Rig()
    rig.run(8.0)
    rig.run(0.2, Command(sticks=IDLE))
    rig.vehicle.is_deaf = True
    rig.run(1.0, Release("pilot"))
    assert RELEASE_US not in rig.overrides()
    rig.vehicle.is_deaf = False
    rig.run(1.0, Release("pilot"))
    assert rig.overrides()[20:] == [RELEASE_US] * 10


def test_sticks_that_could_not_be_sent_are_not_reported_as_sent() -> None:
    rig = Rig()
    rig.run(8.0)
    rig.run(0.2, Command(sticks=IDLE))
    rig.vehicle.is_deaf = True
    assert rig.link.send(Command(sticks=IDLE)) is None
    rig.vehicle.is_down = True
    assert rig.run(0.1).problem == "the connection to the vehicle is lost: reconnecting"
    assert rig.link.send(Command(sticks=IDLE)) is None
    assert rig.link.stats().sent_overrides == 20


def test_after_a_forced_release_only_releases_leave() -> None:
    rig = Rig()
    rig.run(8.0)
    rig.run(0.2, Command(sticks=IDLE))
    rig.link.force_release()
    assert rig.overrides()[20:] == [RELEASE_US] * 10
    count = len(rig.vehicle.received)
    rig.run(1.0, Command(sticks=IDLE))  # the owner has come back
    rig.link.hand_back()
    assert len(rig.vehicle.received) == count


def test_nothing_is_released_that_was_never_overridden() -> None:
    rig = Rig()
    rig.run(8.0)
    rig.run(1.0, Release("disarmed"))
    rig.link.hand_back()
    assert rig.overrides() == []


def test_readonly_sends_no_stick() -> None:
    rig = Rig(readonly=True)
    rig.run(8.0)
    rig.run(1.0, Command(sticks=IDLE))
    rig.link.hand_back()
    assert rig.overrides() == []


def test_the_override_switch_decides() -> None:
    rig = Rig()
    rig.vehicle.params["RC7_OPTION"] = 46.0
    rig.vehicle.channels[6] = 1000
    assert "override switch (RC7) is off" in (rig.run(9.0).problem or "")
    rig.vehicle.channels[6] = 2000
    assert rig.run(0.1).problem is None


def test_a_silent_vehicle_is_lost_after_three_beats_and_found_again() -> None:
    rig = Rig()
    rig.run(8.0)
    rig.vehicle.is_alive = False
    assert rig.run(1.9).problem is None  # the last beat was a second before
    assert rig.run(0.3).problem == "the vehicle's heartbeat is lost"
    rig.vehicle.is_alive = True
    assert rig.run(1.0).problem is None


def test_a_lost_connection_is_opened_again_once_a_second() -> None:
    rig = Rig()
    rig.run(8.0)
    rig.vehicle.is_down = True
    rig.run(3.05)
    assert rig.vehicle.opened == 1 + 3
    rig.vehicle.is_down = False
    assert rig.run(2.0).problem is None
    assert any("connection lost" in text for text in rig.texts)


def test_after_reconnecting_packets_go_to_the_same_peer() -> None:
    rig = Rig()
    rig.run(8.0)
    rig.vehicle.is_down = True
    rig.run(0.5)
    rig.vehicle.is_down, rig.vehicle.answered_to = False, None
    rig.run(2.0)
    assert rig.vehicle.answered_to == ("127.0.0.1", 1)


def test_a_vehicle_that_comes_back_from_another_port_is_followed() -> None:
    rig = Rig()
    rig.run(8.0)
    rig.vehicle.address = ("127.0.0.1", 2)
    assert rig.run(2.2).problem is not None
    assert rig.vehicle.answered_to == ("127.0.0.1", 2)
    assert rig.run(5.0).problem is None
    assert any("now sends from" in text for text in rig.texts)


def test_one_old_stamp_is_no_reboot_and_costs_no_release() -> None:
    rig = Rig()
    rig.run(8.0)
    rig.run(0.2, Command(sticks=IDLE))
    mav = rig.vehicle.end.mav
    rig.vehicle.put(mav.attitude_quaternion_encode(3, 1, 0, 0, 0, 0, 0, 0))
    assert rig.run(0.2, Command(sticks=IDLE)).problem is None
    assert not any("rebooted" in text for text in rig.texts)
    rig.vehicle.boot_ns = rig.clock.now_ns()
    assert rig.run(0.05).problem is not None
    rig.link.hand_back()
    assert rig.overrides()[-10:] == [RELEASE_US] * 10


def test_a_reboot_starts_the_handshake_again() -> None:
    rig = Rig()
    rig.run(8.0)
    reads = rig.vehicle.names().count("PARAM_REQUEST_READ")
    rig.vehicle.boot_ns = rig.clock.now_ns()
    assert rig.run(0.05).problem is not None
    assert rig.run(5.0).problem is None
    assert rig.vehicle.names().count("PARAM_REQUEST_READ") == 2 * reads
    assert any("rebooted" in text for text in rig.texts)


def test_mode_and_arm_are_requested_once_a_second_and_refusals_are_reported() -> None:
    rig = Rig()
    rig.run(8.0)
    for _ in range(150):
        rig.link.set_mode("ACRO")
        rig.link.arm()
        rig.run(0.01)
    commands = [
        (message.command, message.param1, message.param2)
        for message in rig.vehicle.received
        if message.get_type() == "COMMAND_LONG" and message.command in (176, 400)
    ]
    assert sorted(commands) == [(176, 1, 1), (176, 1, 1), (400, 1, 0), (400, 1, 0)]
    rig.vehicle.put(rig.vehicle.end.mav.command_ack_encode(400, dialect.MAV_RESULT_FAILED))
    rig.vehicle.put(rig.vehicle.end.mav.statustext_encode(2, b"Arm: Throttle too high"))
    rig.run(0.01)
    assert "the vehicle answered COMPONENT_ARM_DISARM with FAILED" in rig.texts
    assert "vehicle: Arm: Throttle too high" in rig.texts


def test_no_vehicle_is_an_error_with_advice() -> None:
    rig = Rig(connect_timeout_s=2.0)
    rig.vehicle.is_alive = False
    with pytest.raises(PeerError, match="no vehicle on memory after 2 s: heard nothing"):
        rig.run(3.0)


def test_a_vehicle_heard_in_time_is_not_given_up_while_it_settles() -> None:
    assert Rig(connect_timeout_s=0.1).run(8.0).problem is None


def test_it_waits_for_the_attitude_and_no_longer() -> None:
    rig = Rig()
    rig.run(8.0)
    now_ns = rig.clock.now_ns()
    newest_ns = rig.link.wait_for_attitude(newer_than_ns=now_ns, until_ns=now_ns + 10 * MS)
    assert newest_ns == rig.clock.now_ns() == now_ns + 3 * MS
    newest_ns = rig.link.wait_for_attitude(newer_than_ns=now_ns + 5 * MS, until_ns=now_ns + 12 * MS)
    assert newest_ns == rig.clock.now_ns() == now_ns + 6 * MS
    rig.vehicle.is_alive = False
    rig.link.wait_for_attitude(newer_than_ns=now_ns + 7 * MS, until_ns=now_ns + 12 * MS)
    assert rig.clock.now_ns() == now_ns + 12 * MS
    rig.vehicle.is_down = True
    rig.link.wait_for_attitude(newer_than_ns=now_ns + 13 * MS, until_ns=now_ns + 20 * MS)
    assert rig.clock.now_ns() == now_ns + 20 * MS


def test_other_systems_on_the_link_are_ignored() -> None:
    rig = Rig()
    rig.run(8.0)
    stranger = WireEnd(system=9)
    rig.vehicle.inbox.append(
        Chunk(
            stranger.pack(stranger.mav.attitude_encode(0, 1, 1, 1, 1, 1, 1)),
            0,
            rig.vehicle.address,
        )
    )
    snapshot = rig.run(0.01)
    assert snapshot.telemetry.rate_body_radps is not None
    assert snapshot.telemetry.rate_body_radps.values == (0, 0, 0)


def px4_rig(**config: Any) -> Rig:
    rig = Rig(**config)
    beat = rig.vehicle.end.heartbeat
    rig.vehicle.end.heartbeat = (  # type: ignore[method-assign]
        lambda **options: beat(**(options | {"autopilot": 12, "mode": 2 << 16}))
    )
    return rig


def test_px4_is_flown_with_manual_control_and_released_by_silence() -> None:
    rig = px4_rig(output="manual-control")
    snapshot = rig.run(8.0)
    assert snapshot.problem is None
    assert snapshot.echo_confirmed
    assert snapshot.status is not None
    assert snapshot.status.mode == "ALTCTL"
    rig.run(0.1, Command(sticks=IDLE))
    rig.run(0.1, Release("pilot"))
    assert rig.vehicle.names().count("MANUAL_CONTROL") == 10
    assert rig.overrides() == []


def test_ardupilot_with_manual_control_is_refused() -> None:
    with pytest.raises(PeerError, match="--output rc-override"):
        Rig(output="manual-control").run(3.0)


def test_acks_for_other_stations_are_ignored() -> None:
    rig = Rig()
    rig.run(2.0)
    for _ in range(6):
        denied = dialect.MAV_RESULT_DENIED
        rig.vehicle.put(rig.vehicle.end.mav.command_ack_encode(511, denied, 0, 0, 250, 190))
        rig.run(0.01)
    rig.run(6.0)
    intervals = [
        int(message.param1)
        for message in rig.vehicle.received
        if message.get_type() == "COMMAND_LONG" and message.command == 511
    ]
    assert intervals == [31, 32, 105, 65]


def test_px4_with_rc_override_is_refused() -> None:
    with pytest.raises(PeerError, match="--output manual-control"):
        px4_rig().run(3.0)
