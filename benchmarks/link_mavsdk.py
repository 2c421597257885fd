"""MAVSDK-Python 4 client of the link test; runs in the interpreter that has MAVSDK.

A subscription's callback answers with manual control, MAVSDK's way to move sticks.
"""

import sys
import threading

from mavsdk.component_type import ComponentType
from mavsdk.mavsdk import Configuration, Mavsdk
from mavsdk.plugins.manual_control import ManualControl
from mavsdk.plugins.telemetry import Telemetry

DEADLINE_S = 10.0


def main(port: str) -> None:
    """Answer until ended."""
    sdk = Mavsdk(Configuration.create_with_component_type(ComponentType.GROUND_STATION))
    sdk.add_any_connection(f"udpin://127.0.0.1:{port}")
    system = sdk.first_autopilot(DEADLINE_S)
    control, telemetry = ManualControl(system), Telemetry(system)
    telemetry.subscribe_attitude_angular_velocity_body(
        lambda rate, _: control.set_manual_control_input(0.0, rate.roll_rad_s, 0.5, 0.0)
    )
    threading.Event().wait()


if __name__ == "__main__":
    main(sys.argv[sys.argv.index("--port") + 1])
