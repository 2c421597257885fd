import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mav

from benchmarks.link_peer import CODES, PARAMS, LinkPeer, code_of, stick_of
from mavbridge.commands.bench.link_process import repeat_roll_rate
from mavbridge.core.clock import NS_PER_MS
from mavbridge.core.records import Sticks
from mavbridge.mavlink.session.params import calibration


def test_every_code_comes_back_through_policy_and_calibration() -> None:
    feature, history = np.zeros((1, 1), np.float32), np.zeros((1, 4, 4), np.float32)
    state = np.zeros((1, 13), np.float32)
    for code in range(CODES):
        state[0, 7] = stick_of(code)
        chunk = repeat_roll_rate(feature, state, history, None)
        assert chunk.shape == (1, 16, 4)
        roll_us = calibration(PARAMS).to_pwm_us(Sticks(*chunk[0, 0].tolist()))[3]
        assert roll_us == 1000 + code


def test_every_code_comes_back_through_manual_control() -> None:
    assert [code_of(round(1000 * stick_of(code)) / 1000) for code in range(CODES)] == [
        *range(CODES)
    ]


def override(roll_us: int) -> mav.MAVLink_message:
    return mav.MAVLink_rc_channels_override_message(1, 1, roll_us, *[1500] * 7)


@pytest.fixture
def peer() -> LinkPeer:
    return LinkPeer(9, attitudes=10)  # the discard port: nobody answers


def counting(peer: LinkPeer, sent_ns: dict[int, int]) -> LinkPeer:
    peer._is_counting = True
    peer._pending = dict(sent_ns)
    return peer


def test_an_answer_is_timed_from_its_own_attitude(peer: LinkPeer) -> None:
    counting(peer, {7: 1000 * NS_PER_MS, 8: 1010 * NS_PER_MS})
    peer._take(override(1008), 1012 * NS_PER_MS)
    assert peer.round_trip.count == 1
    assert peer.round_trip.max_ns == 2 * NS_PER_MS


def test_only_the_first_answer_to_an_attitude_counts(peer: LinkPeer) -> None:
    counting(peer, {7: 0})
    for arrived_ms in (2, 12):
        peer._take(override(1007), arrived_ms * NS_PER_MS)
    assert peer.round_trip.count == 1


def test_an_answer_to_nothing_is_passed_over(peer: LinkPeer) -> None:
    counting(peer, {7: 0})
    peer._take(override(1009), NS_PER_MS)
    assert peer.round_trip.count == 0
