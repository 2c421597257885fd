"""RC_CHANNELS_OVERRIDE as measured on ArduCopter: whose, for how long, and how it is released."""

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mav


@pytest.fixture
def companion(companion):
    """Return a companion that watches the channels."""
    companion.stream(mav.MAVLINK_MSG_ID_RC_CHANNELS, 100)
    return companion


@pytest.mark.parametrize(
    ("sent", "shown"),
    [
        ([(1501, 1502, 1103, 1504)], (1501, 1502, 1103, 1504)),
        *(([(value,)], (value,)) for value in (1, 900, 2500, 32767, 40000, 65534)),  # no range
        ([(1700, 1600), (0, 65535)], (1500, 1600)),  # a release, and a field that is ignored
    ],
)
def test_an_override_shows_at_once_in_rc_channels(companion, sent, shown):
    for channels_us in sent:
        companion.override(*channels_us)
        companion.advance(0.05)
    assert companion.channels()[: len(shown)] == shown


@pytest.mark.parametrize(("system_id", "target"), [(42, 1), (254, 1), (1, 1), (255, 2), (255, 99)])
def test_overrides_of_others_are_ignored(companion, system_id, target):
    before = companion.channels()
    companion.override(1777, system_id=system_id, target=target)
    companion.advance(0.05)
    assert companion.channels() == before


def test_the_gcs_sysid_parameter_decides_at_once(companion):
    companion.set_param("MAV_GCS_SYSID", 42)
    companion.override(1601, system_id=42)
    companion.advance(0.05)
    companion.override(1777, system_id=255)
    companion.advance(0.05)
    assert companion.channels()[0] == 1601


@pytest.mark.parametrize(("override_time_s", "low_s", "high_s"), [(3.0, 3.0, 3.1), (0.5, 0.5, 0.6)])
def test_an_override_expires(companion, override_time_s, low_s, high_s):
    companion.set_param("RC_OVERRIDE_TIME", override_time_s)
    sent_ns = companion.peer.now_ns()
    companion.override(1700)
    companion.wait("RC_CHANNELS", where=lambda m: m.chan1_raw == 1700)
    companion.wait("RC_CHANNELS", timeout_s=5.0, where=lambda m: m.chan1_raw == 1500)
    assert low_s <= (companion.peer.now_ns() - sent_ns) / 1e9 <= high_s


def test_ignored_fields_do_not_keep_an_override_alive(companion):
    companion.override(1700)
    for _ in range(160):
        companion.override()
        companion.advance(0.02)
    assert companion.channels()[0] == 1500


@pytest.mark.parametrize("override_time_s", [0.0, -1.0])
def test_override_time_zero_refuses_and_minus_one_never_expires(companion, override_time_s):
    companion.set_param("RC_OVERRIDE_TIME", override_time_s)
    companion.override(1700)
    companion.advance(3.5 if override_time_s else 0.5)
    assert companion.channels()[0] == (1700 if override_time_s < 0 else 1500)
    companion.override(0)
