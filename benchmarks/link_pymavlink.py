"""Link test, client: the shortest loop that pymavlink allows, blocking receive and send."""

import argparse

from pymavlink import mavutil
from pymavlink.dialects.v20 import ardupilotmega as mav


def main() -> None:
    """Answer until ended."""
    parser = argparse.ArgumentParser(description=__doc__, allow_abbrev=False)
    parser.add_argument("--port", type=int, required=True)
    connection = mavutil.mavlink_connection(
        f"udpin:127.0.0.1:{parser.parse_args().port}",
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
    main()
