"""Print what a fleet does while it flies, with an event loop: poses, modes, and the station's lines.

python examples/watch_fleet.py
"""

import asyncio

import shoal


async def watch(fleet: shoal.ConnectedFleet) -> None:
    """Print each robot's state, until the mission is over."""
    while await asyncio.to_thread(fleet.mission, max_age_s=10.0) not in ("DONE", "FAILED", "CANCELLED"):
        for robot in fleet.robots:
            state = await asyncio.to_thread(fleet.state, robot, max_age_s=10.0)
            where = "place not known" if state.estimate is None else "x {:.2f} y {:.2f} m".format(*state.estimate.eta[:2])
            battery_v = 0.0 if state.board is None else state.board.battery_v  # 0 until the board has reported it
            battery = f"{battery_v:.1f} V" if battery_v > 0.0 else "battery not known"
            print(f"robot {robot}: {state.mode.name}, {where}, {battery}")
        await asyncio.sleep(1.0)


async def main() -> None:
    """Start a simulated flight, and watch it to its end."""
    with shoal.simulation("pool", duration_s=5.0, lockstep=True) as fleet:
        watching = asyncio.create_task(watch(fleet))
        await asyncio.to_thread(fleet.start)
        await watching
        print("mission:", await asyncio.to_thread(fleet.wait_mission, "DONE", "FAILED"))
        await asyncio.to_thread(fleet.end)


asyncio.run(main())
