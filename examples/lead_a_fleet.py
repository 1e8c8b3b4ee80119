"""Lead a fleet as its operator: start, go elsewhere, hold, resume, end. Here a simulated one, in lockstep.

    python examples/lead_a_fleet.py

In the lab the same requests are made of the station that runs: `with shoal.connect() as fleet:`.
"""

import shoal

with shoal.simulation("open-water", {"path.stop": True}, duration_s=600.0, lockstep=True) as fleet:
    print("robots:", fleet.robots)
    fleet.start()
    fleet.wait(lambda: fleet.state(1).trajectory_s > 2.0, timeout_s=120.0)
    try:
        fleet.go((0.0, 1.5), (2.0, 2.0))
    except shoal.RequestFailed as refused:
        print(refused)
    fleet.hold()
    print("holding:", [f"{fleet.pose(robot).x_m:.1f} m" for robot in fleet.robots])
    fleet.resume()
    print(fleet.wait_mission("RUNNING", "SLOWED", timeout_s=60.0))
    fleet.end()
