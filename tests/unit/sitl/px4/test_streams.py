"""Rates of PX4's streams: grid, topics, a link's bandwidth."""

from pymavlink.dialects.v20 import ardupilotmega as mav

from sitl.clock import NS_PER_MS
from sitl.px4.endpoint import Px4Streams

ATTITUDE = mav.MAVLINK_MSG_ID_ATTITUDE
PLENTY = 1e9
STEP_MS = 4


def sent_ms(streams, seconds, message_id=ATTITUDE, version_of=None, begin_ms=0):
    """When the message was sent."""
    times = []
    for ms in range(begin_ms + STEP_MS, begin_ms + round(1000 * seconds) + 1, STEP_MS):
        version = version_of(ms) if version_of else ms
        due = streams.due(ms * NS_PER_MS, lambda _key, version=version: version)
        times += [ms] * (message_id in due)
    return times


def test_nothing_is_sent_while_the_topic_is_old():
    streams = Px4Streams({}, PLENTY, 0)
    streams.set_interval(ATTITUDE, 4000, 0)

    times = sent_ms(streams, 1.0, version_of=lambda ms: ms // 100)

    assert len(times) == 11


def test_zero_restores_the_links_default_and_minus_one_stops():
    streams = Px4Streams({ATTITUDE: 50.0}, PLENTY, 0)
    streams.set_interval(ATTITUDE, -1, 0)
    assert streams.interval_us(ATTITUDE) == -1
    streams.set_interval(ATTITUDE, 0, 0)
    assert streams.interval_us(ATTITUDE) == 20_000
