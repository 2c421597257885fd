"""The link breaks, or somebody else takes the vehicle: measured by the vehicle's own record."""

import signal
import socket
import struct
from pathlib import Path

import pytest
from pymavlink.dialects.v20 import ardupilotmega as dialect

from mavbridge.core.processes import free_port
from sitl.faults.link import LinkFaults
from sitl.faults.record import NUDGE_US, aftermath, is_safe
from sitl.faults.relay import Override, Relay
from sitl.faults.stage import ORDERLY, Stage, faulty_policy, staged

pytestmark = pytest.mark.system

FLY = ("--dual-rate", "--mode", "ALT_HOLD", "--arm", "--policy", faulty_policy("Leaning"))
CLEAR = LinkFaults()
NOTICE_LIMIT_MS = 800
"""The echo must have been constant for 0.4 s; then the gate leaves the flight."""
TAKEOVER_LIMIT_MS = 150
"""The aim is 100 ms."""


def noticed_ms(relay: Relay, at_ns: int) -> float:
    """Until the gate sent other sticks than the policy's, wherever they got to."""
    for sent in relay.sent:
        # Neutral, or a release.
        is_off = sent.override is not None and sent.override.roll <= 1500 + NUDGE_US
        if sent.at_ns > at_ns and is_off:
            return (sent.at_ns - at_ns) / 1e6
    raise AssertionError("the gate has noticed nothing")


def mode_commands(relay: Relay, at_ns: int) -> int:
    """Requests of ours for a mode since a moment."""
    commands = relay.sent_since(at_ns, "COMMAND_LONG")
    sets = [sent for sent in commands if sent.message.command == dialect.MAV_CMD_DO_SET_MODE]
    return len(sets) + len(relay.sent_since(at_ns, "SET_MODE"))


def end_in_order(flying: Stage) -> str:
    flying.kill_group(signal.SIGINT)
    status, output = flying.end()
    assert status in ORDERLY, output
    return output


@pytest.mark.parametrize("receiver", ["mid", "none"])
@pytest.mark.parametrize("ways", ["to_bridge", "to_vehicle", "both"])
def test_a_silent_link_ends_the_flight_for_good(ways: str, receiver: str, tmp_path: Path) -> None:
    with staged(tmp_path, "--receiver", receiver, renders=False) as flying:
        flying.start(*FLY)
        flying.wait_for_lean()
        relay = flying.relay
        names = ("to_bridge", "to_vehicle") if ways == "both" else (ways,)
        fault = LinkFaults(loss=1.0)
        at_ns = relay.impair(**dict.fromkeys(names, fault))
        flying.observe(3.0)
        relay.impair(**dict.fromkeys(names, CLEAR))
        flying.observe(1.5)
        relay.disarm()
        end_in_order(flying)
    measured = aftermath(flying.vehicle_report(), at_ns, receiver)
    noticed = noticed_ms(relay, at_ns)
    assert noticed <= NOTICE_LIMIT_MS
    assert not measured.flew_again
    if ways == "to_bridge":
        assert measured.safe_ms <= NOTICE_LIMIT_MS


@pytest.mark.parametrize("steps", [1, 20])
def test_a_delay_that_begins_in_flight_is_noticed(steps: int, tmp_path: Path) -> None:
    """Where it grows in steps, every packet looks fresh: only the vehicle's clock tells the age."""
    with staged(tmp_path, "--receiver", "mid", renders=False) as flying:
        flying.start(*FLY)
        flying.wait_for_lean()
        began_ns = None
        for step in range(steps):
            late = LinkFaults(delay_ms=200.0 * (step + 1) / steps)
            at_ns = flying.relay.impair(to_bridge=late, to_vehicle=late)
            began_ns = began_ns or at_ns
            flying.observe(0.025 if steps > 1 else 0.0)
        flying.observe(2.0)
        output = end_in_order(flying)
    assert began_ns is not None
    measured = aftermath(flying.vehicle_report(), began_ns, "mid")
    noticed = noticed_ms(flying.relay, began_ns)
    assert noticed <= NOTICE_LIMIT_MS
    assert measured.safe_ms <= noticed + 350
    assert not measured.flew_again
    assert steps == 1 or "attitude is older than 100 ms" in output


def test_the_pilots_mode_is_honoured_and_a_lossy_link_flies_on(tmp_path: Path) -> None:
    """First 20 % of loss, duplicates and reordering, then the pilot takes over and gives back."""
    with staged(tmp_path, "--receiver", "mid", renders=False) as flying:
        flying.start(*FLY)
        flying.wait_for_lean()
        relay = flying.relay
        bad = LinkFaults(loss=0.2, duplicate=0.2, reorder=0.2)
        bad_ns = relay.impair(to_bridge=bad, to_vehicle=bad)
        flying.observe(2.0)
        taken_ns = relay.impair(to_bridge=CLEAR, to_vehicle=CLEAR)
        flying.observe(0.2)
        taken_ns = relay.set_mode("LOITER")
        flying.observe(1.0)
        relay.disarm()
        flying.observe(0.2)
        relay.set_mode("ALT_HOLD")
        flying.observe(3.0)
        armed_ns = relay.arm()
        flying.observe(3.0)
        relay.disarm()
        output = end_in_order(flying)
    report = flying.vehicle_report()
    start_ns = report["start_ns"]
    lossy = [
        entry for entry in report["sticks"] if bad_ns <= start_ns + entry["t_s"] * 1e9 < taken_ns
    ]
    assert lossy
    assert not any(is_safe(entry, "mid", "ALT_HOLD") for entry in lossy)
    sticks = [sent for sent in relay.sent if sent.at_ns > taken_ns and sent.is_command]
    last_ms = max([(sent.at_ns - taken_ns) / 1e6 for sent in sticks], default=0.0)
    assert last_ms <= TAKEOVER_LIMIT_MS
    assert mode_commands(relay, taken_ns) == 0
    assert any(
        entry["armed"] and start_ns + entry["t_s"] * 1e9 > armed_ns for entry in report["sticks"]
    ), "the pilot's second arming was refused"
    assert "mode changed from ALT_HOLD to LOITER" in output


def test_a_joystick_on_our_system_id_is_noticed(tmp_path: Path) -> None:
    """At 50 Hz each of the two has the vehicle for a while, a hundred times a second."""
    with staged(tmp_path, "--receiver", "mid", renders=False) as flying:
        flying.start(*FLY)
        flying.wait_for_lean()
        sticks = Override(roll=1400, pitch=1500, throttle=1500, yaw=1500)
        began_ns = flying.relay.move_joystick(sticks)
        for _ in range(75):
            flying.observe(0.02)
            flying.relay.move_joystick(sticks)
        output = end_in_order(flying)
    last_ms = max((sent.at_ns - began_ns) / 1e6 for sent in flying.relay.sent if sent.is_command)
    assert last_ms <= NOTICE_LIMIT_MS
    assert mode_commands(flying.relay, began_ns) == 0
    assert "overrid" in output


class Transmitter:
    """The pilot's sticks and switches, by ``--rc-in``."""

    def __init__(self, port: int) -> None:
        self._address = ("127.0.0.1", port)

    def send(self, *, switch_us: int, throttle_us: int = 1000) -> None:
        values = (1500, 1500, throttle_us, 1500, 1500, 1500, switch_us, 1500)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            sender.sendto(struct.pack("<8H", *values), self._address)


def test_only_the_engage_switch_engages_where_the_pilot_arms(tmp_path: Path) -> None:
    transmitter = Transmitter(port := free_port())
    flags = ("--receiver", "idle", "--rc-in", str(port))
    with staged(tmp_path, *flags, renders=False) as flying:
        policy = ("--policy", faulty_policy("Leaning"))
        flying.start("--dual-rate", "--engage-channel", "7", *policy)
        relay = flying.relay
        assert flying.wait_for("not engaged: press e, use the engage switch")
        transmitter.send(switch_us=1000)
        relay.set_mode("ALT_HOLD")
        armed_ns = relay.arm()
        flying.observe(3.0)
        assert relay.overrides == []
        assert mode_commands(relay, 0) == 0
        transmitter.send(switch_us=2000)
        flying.wait_for_lean()
        flying.observe(0.5)
        off_ns = relay.impair()
        transmitter.send(switch_us=1000)
        flying.observe(1.0)
        relay.disarm()
        output = end_in_order(flying)
    report = flying.vehicle_report()
    armed = [entry for entry in report["sticks"] if entry["armed"]]
    assert report["start_ns"] + armed[0]["t_s"] * 1e9 > armed_ns
    measured = aftermath(report, off_ns, "idle")
    assert measured.safe_ms <= TAKEOVER_LIMIT_MS
    assert not measured.flew_again
    assert mode_commands(relay, 0) == 0
    assert "engage switch is off" in output
