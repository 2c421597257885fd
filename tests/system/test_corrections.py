"""A pilot corrects the policy in flight, and the recording teaches what the pilot did."""

import signal
from pathlib import Path

import numpy as np
import pytest

from faults.props import Transmitter
from faults.stage import ORDERLY, staged
from policy.data.flight_folders import leave_out_failed, read_flight

pytestmark = pytest.mark.system

FLY = ("--dual-rate", "--mode", "ALT_HOLD", "--arm", "--engage-channel", "7")
PITCH_CHANNEL, FORWARD_US, SWITCH = 2, 1300, 7


def test_a_pilot_who_takes_over_by_the_switch_labels_the_flight(tmp_path: Path) -> None:
    transmitter, recording = Transmitter("mid"), tmp_path / "recording"
    with staged(tmp_path, "--receiver", "mid", *transmitter.flags) as flying:
        flying.start(*FLY, "--policy", "scripted:hover", "--record", str(recording))
        assert flying.wait_for("FLYING: the policy has control")
        flying.observe(4.0)
        transmitter.move(PITCH_CHANNEL, FORWARD_US)
        transmitter.move(SWITCH, 1000)
        flying.observe(2.0)
        transmitter.move(PITCH_CHANNEL, 1500)
        flying.observe(0.5)
        flying.kill_group(signal.SIGINT)
        status, output = flying.end()
    assert status in ORDERLY, output
    exemplary, _ = leave_out_failed([recording], include_failed=False)
    episode = read_flight(*exemplary)
    assert len(episode.target) > 100
    forward = episode.target[:, 2]
    assert (forward > 0.3).mean() > 0.6  # a pilot's stick of 1300 us, pitch reversed
    np.testing.assert_allclose(episode.target[:, [1, 3]], 0.0, atol=0.05)
