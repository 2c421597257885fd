"""Setpoints that the simulated PX4 refuses."""

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mav


@pytest.mark.parametrize("quaternion", [[0, 0, 0, 0], [float("nan"), 0, 0, 0]])
def test_an_attitude_that_is_none_is_refused(ends, quaternion):
    ends.send(mav.MAVLink_set_attitude_target_message(0, 1, 1, 7, quaternion, 0, 0, 0, 0.5))
    assert ends.ap.setpoint is None
    assert ends.vehicle.log.refused_messages == 1
