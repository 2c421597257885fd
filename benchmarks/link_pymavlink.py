"""Shortest pymavlink client of the link test: blocking receive, then send."""

from cyclopts import run
from pymavlink import mavutil
from pymavlink.dialects.v20 import ardupilotmega as mav


def main(*, port: int) -> None:
    """Answer until ended."""
    connection = mavutil.mavlink_connection(
        f"udpin:127.0.0.1:{port}",
        source_system=255,
        source_component=mav.MAV_COMP_ID_ONBOARD_COMPUTER,
    )
    connection.wait_heartbeat()
    while True:
        attitude = connection.recv_match(type="ATTITUDE_QUATERNION", blocking=True)
        connection.mav.rc_channels_override_send(
            connection.target_system,
            connection.target_component,
            round(1500 + 500 * attitude.rollspeed),
            *(1500, 1500, 1500, 65535, 65535, 65535, 65535),
        )


if __name__ == "__main__":
    run(main)
