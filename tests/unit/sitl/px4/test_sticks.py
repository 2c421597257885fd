"""Choice and loss of PX4's stick input."""

import pytest

from sitl.clock import NS_PER_MS, NS_PER_S
from sitl.px4.params import Px4Params
from sitl.px4.sticks import RC_SOURCE, Px4Sticks, StickInput

PERIOD_NS = 20 * NS_PER_MS
GCS, ONBOARD = 0, 1


class Senders:
    """Sends sticks of several sources at 50 Hz; a source's throttle tells it apart."""

    def __init__(self, in_mode=1):
        self.params = Px4Params()
        self.params.set("COM_RC_IN_MODE", in_mode)
        self.input = StickInput(self.params)
        self.now_ns = 0

    def send(self, seconds, *sources, sticks=None):
        for _ in range(round(seconds * NS_PER_S / PERIOD_NS)):
            self.now_ns += PERIOD_NS
            for source in sources:
                self.input.on_sticks(source, sticks or Px4Sticks(), self.now_ns)
            self.input.update(self.now_ns)
        return self.input.source


@pytest.mark.parametrize("in_mode", [1, 2])
def test_another_link_takes_over_when_the_first_has_stopped(in_mode):
    senders = Senders(in_mode)
    senders.send(0.1, GCS)
    assert senders.send(0.56, ONBOARD) == GCS
    assert senders.send(0.1, ONBOARD) == ONBOARD


@pytest.mark.parametrize(
    ("in_mode", "order"),
    [
        (5, (RC_SOURCE, GCS, ONBOARD)),
        (6, (GCS, ONBOARD, RC_SOURCE)),
        (7, (RC_SOURCE, ONBOARD, GCS)),
        (8, (ONBOARD, GCS, RC_SOURCE)),
    ],
)
def test_a_preferred_source_wins_at_once_and_its_end_is_noticed_after_600_ms(in_mode, order):
    senders = Senders(in_mode)
    for count in (1, 2, 3):
        assert senders.send(0.02, *order[-count:]) == order[-count]
    assert senders.send(0.56, *order[1:]) == order[0]
    assert senders.send(0.1, *order[1:]) == order[1]
    assert senders.send(0.7, order[2]) == order[2]


@pytest.mark.parametrize(
    ("in_mode", "source"), [(0, RC_SOURCE), (1, GCS), (2, RC_SOURCE), (4, None)]
)
def test_the_input_mode_selects_the_receiver_or_a_link(in_mode, source):
    assert Senders(in_mode).send(0.2, RC_SOURCE, GCS) == source
