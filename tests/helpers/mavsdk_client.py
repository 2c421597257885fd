"""Prints as JSON the data that MAVSDK reads from the vehicle; needs MAVSDK's interpreter."""

import json
import sys
import threading

from mavsdk.component_type import ComponentType
from mavsdk.mavsdk import Configuration, Mavsdk
from mavsdk.plugins.action import Action
from mavsdk.plugins.info import Info
from mavsdk.plugins.param import Param
from mavsdk.plugins.telemetry import Telemetry

DEADLINE_S = 10.0


def main(url: str) -> None:
    configuration = Configuration.create_with_component_type(ComponentType.GROUND_STATION)
    sdk = Mavsdk(configuration)
    sdk.add_any_connection(url)
    system = sdk.first_autopilot(DEADLINE_S)

    params = Param(system)
    params.set_param_float("RC_OVERRIDE_TIME", 0.5)
    telemetry = Telemetry(system)
    telemetry.set_rate_attitude_quaternion(50.0)
    telemetry.set_rate_position_velocity_ned(50.0)
    attitude, position = threading.Event(), threading.Event()
    telemetry.subscribe_attitude_quaternion(lambda *_: attitude.set())
    telemetry.subscribe_position_velocity_ned(lambda *_: position.set())
    found = {
        "param": params.get_param_float("RC_OVERRIDE_TIME"),
        "params": len(params.get_all_params().float_params),
        "attitude": attitude.wait(DEADLINE_S),
        "position": position.wait(DEADLINE_S),
        "version": Info(system).get_version().flight_sw_major,
    }
    action = Action(system)
    action.arm()
    action.disarm()
    sys.stdout.write("RESULT " + json.dumps(found) + "\n")
    sdk.destroy()


main(sys.argv[1])
