"""Watch a fleet, and stop it when a robot is too far from its trajectory. Then clear the stop.

    python examples/emergency_stop.py

The script is one more person at the stop button: robots watch themselves, and fail safe without it (docs/safety.md).
"""

import shoal

LIMIT_M = 0.05  # far below what is dangerous: here it shall happen


def too_far(fleet: shoal.ConnectedFleet) -> bool:
    """True if a robot is beyond the limit."""
    states = [fleet.state(robot, max_age_s=10.0) for robot in fleet.robots]
    return any((state.error_m or 0.0) > LIMIT_M for state in states)


with shoal.simulation("pool", lockstep=True) as fleet:
    fleet.start()
    fleet.wait(lambda: too_far(fleet), timeout_s=120.0)
    outcome = fleet.stop()
    print("stopped:", outcome.confirmed)
    print("mission:", fleet.wait_mission("STOPPED"))
    fleet.clear_stop()
    print("modes:", [fleet.state(robot, max_age_s=10.0).mode.name for robot in fleet.robots])
    fleet.end()
