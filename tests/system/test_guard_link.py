"""The link breaks, or somebody else takes the vehicle: measured by the vehicle's own record."""

import re
import signal
from pathlib import Path

import pytest

from faults.link import LinkFaults
from faults.props import Transmitter
from faults.record import DITHER_US, aftermath
from faults.relay import Relay
from faults.stage import ORDERLY, Stage, faulty_policy, free_port, staged
from mavbridge.core.reasons import Code, because

pytestmark = pytest.mark.system

FLY = ("--dual-rate", "--mode", "ALT_HOLD", "--arm", "--policy", faulty_policy("Leaning"))
CLEAR = LinkFaults()
NOTICE_LIMIT_MS = 800
"""The echo must have been constant for 0.4 s; then the guard leaves the flight."""
TAKEOVER_LIMIT_MS = 150
"""The aim is 100 ms."""


def noticed_ms(relay: Relay, at_ns: int) -> float:
    """Until the guard sent other sticks than the policy's, wherever they got to."""
    for sent in relay.sent:
        # Neutral, or a release.
        is_off = sent.override is not None and sent.override.roll <= 1500 + DITHER_US
        if sent.at_ns > at_ns and is_off:
            return (sent.at_ns - at_ns) / 1e6
    raise AssertionError("the guard has noticed nothing")


def mode_commands(relay: Relay) -> int:
    """Requests of ours for a mode."""
    return sum(sent.asks_mode for sent in relay.sent)


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
    assert steps == 1 or re.search(r"attitude is \d+ ms old, beyond 100 ms", output)


def test_only_the_engage_switch_engages_where_the_pilot_arms(tmp_path: Path) -> None:
    transmitter = Transmitter(free_port(), "idle")
    flags = ("--receiver", "idle", *transmitter.flags)
    with staged(tmp_path, *flags, renders=False) as flying:
        policy = ("--policy", faulty_policy("Leaning"))
        flying.start("--dual-rate", "--engage-channel", "7", *policy)
        relay = flying.relay
        assert flying.wait_for(str(because(Code.NOT_ENGAGED)))
        transmitter.move(7, 1000)
        relay.set_mode("ALT_HOLD")
        armed_ns = relay.arm()
        flying.observe(3.0)
        assert relay.overrides == []
        assert mode_commands(relay) == 0
        transmitter.move(7, 2000)
        flying.wait_for_lean()
        flying.observe(0.5)
        off_ns = relay.impair()
        transmitter.move(7, 1000)
        flying.observe(1.0)
        relay.disarm()
        output = end_in_order(flying)
    report = flying.vehicle_report()
    armed = [entry for entry in report["sticks"] if entry["armed"]]
    assert report["start_ns"] + armed[0]["t_s"] * 1e9 > armed_ns
    measured = aftermath(report, off_ns, "idle")
    assert measured.safe_ms <= TAKEOVER_LIMIT_MS
    assert not measured.flew_again
    assert mode_commands(relay) == 0
    assert "engage switch is off" in output
