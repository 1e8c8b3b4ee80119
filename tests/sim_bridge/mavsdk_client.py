"""A client written with MAVSDK alone. It says on stdout, after "client", how it went; waits for a line now and then."""

import math
import sys
import time

from mavsdk import ComponentType, Configuration, Mavsdk
from mavsdk.plugins.action import Action
from mavsdk.plugins.param import Param
from mavsdk.plugins.telemetry import Telemetry


def say(*words: object) -> None:
    print("client", *words, flush=True)


def problem(error: Exception) -> str:
    return str(error).partition(";")[0]


def main() -> None:
    mavsdk = Mavsdk(Configuration.create_with_component_type(ComponentType.GROUND_STATION))
    mavsdk.add_any_connection(f"udpout://127.0.0.1:{sys.argv[1]}")
    system = mavsdk.first_autopilot(20.0)
    say("system", system.get_system_id())
    action, param, telemetry = Action(system), Param(system), Telemetry(system)
    while telemetry.battery().id != 0 or not telemetry.battery().voltage_v > 1.0:
        time.sleep(0.05)
    say("yaw", math.isfinite(telemetry.attitude_euler().yaw_deg))
    say("volts", abs(telemetry.battery().voltage_v - 12.4) < 0.3)
    say("parameters", len(param.get_all_params().float_params))
    param.set_param_float("SLEW_US_S", 7000.0)
    say("set", round(param.get_param_float("SLEW_US_S")))
    try:
        param.set_param_float("SLEW_US_S", 1.0)
    except Exception as error:
        say("refused", problem(error))
    try:
        action.arm()
    except Exception as error:
        say("alone", problem(error))
    sys.stdin.readline()
    action.arm()
    say("armed")
    sys.stdin.readline()
    action.disarm()
    say("disarmed")
    sys.stdin.readline()


if __name__ == "__main__":
    main()
