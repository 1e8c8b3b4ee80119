"""SHELL: the connection to a station for programs with an event loop: each call that waits does so in a thread.

    async with await shoal.connect_async() as fleet:
        await fleet.start()

A call that is cancelled goes on in its thread until its own time is over; a request that was made stays made.
"""

import asyncio
from collections.abc import Callable
from pathlib import Path
from typing import Any

from groundstation.scripting.fleet import FRESH_S, ConnectedFleet, connect
from shoal.messages.messages import Event, Outcome, Pose, RobotState
from shoal.messages.topics import WHOLE_FLEET
from shoal.runtime.cli_options import DEFAULT_FLEET


class AsyncFleet:
    """A ConnectedFleet whose methods are awaited; they do and raise the same."""

    def __init__(self, fleet: ConnectedFleet) -> None:
        self.blocking = fleet

    async def __aenter__(self) -> "AsyncFleet":
        return self

    async def __aexit__(self, *exception: object) -> None:
        await asyncio.to_thread(self.blocking.close)

    async def load(self, wait_s: float | None = None) -> Outcome:
        return await asyncio.to_thread(self.blocking.load, wait_s)

    async def arm(self, wait_s: float | None = None, robot: int = WHOLE_FLEET) -> Outcome:
        return await asyncio.to_thread(self.blocking.arm, wait_s, robot)

    async def start(self, wait_s: float | None = None) -> Outcome:
        return await asyncio.to_thread(self.blocking.start, wait_s)

    async def go(self, *places_m: tuple[float, float], wait_s: float | None = None, robot: int = WHOLE_FLEET) -> Outcome:
        return await asyncio.to_thread(self.blocking.go, *places_m, wait_s=wait_s, robot=robot)

    async def formation(self, form: str, wait_s: float | None = None) -> Outcome:
        return await asyncio.to_thread(self.blocking.formation, form, wait_s)

    async def fault(self, what: str, wait_s: float | None = None) -> Outcome:
        return await asyncio.to_thread(self.blocking.fault, what, wait_s)

    async def hold(self, wait_s: float | None = None, robot: int = WHOLE_FLEET) -> Outcome:
        return await asyncio.to_thread(self.blocking.hold, wait_s, robot)

    async def resume(self, wait_s: float | None = None) -> Outcome:
        return await asyncio.to_thread(self.blocking.resume, wait_s)

    async def return_to_start(self, wait_s: float | None = None) -> Outcome:
        return await asyncio.to_thread(self.blocking.return_to_start, wait_s)

    async def rejoin(self, wait_s: float | None = None) -> Outcome:
        return await asyncio.to_thread(self.blocking.rejoin, wait_s)

    async def out(self, robot: int, wait_s: float | None = None) -> Outcome:
        return await asyncio.to_thread(self.blocking.out, robot, wait_s)

    async def back_in(self, robot: int, wait_s: float | None = None) -> Outcome:
        return await asyncio.to_thread(self.blocking.back_in, robot, wait_s)

    async def test_thrusters(self, wait_s: float | None = None) -> Outcome:
        return await asyncio.to_thread(self.blocking.test_thrusters, wait_s)

    async def disarm(self, wait_s: float | None = None, robot: int = WHOLE_FLEET) -> Outcome:
        return await asyncio.to_thread(self.blocking.disarm, wait_s, robot)

    async def stop(self, wait_s: float | None = None) -> Outcome:
        return await asyncio.to_thread(self.blocking.stop, wait_s)

    async def clear_stop(self, wait_s: float | None = None) -> Outcome:
        return await asyncio.to_thread(self.blocking.clear_stop, wait_s)

    async def end(self, wait_s: float | None = None) -> Outcome:
        return await asyncio.to_thread(self.blocking.end, wait_s)

    async def set_gains(self, gains: dict[str, Any], wait_s: float | None = None) -> Outcome:
        return await asyncio.to_thread(self.blocking.set_gains, gains, wait_s)

    async def undo_gains(self, wait_s: float | None = None) -> Outcome:
        return await asyncio.to_thread(self.blocking.undo_gains, wait_s)

    @property
    def robots(self) -> tuple[int, ...]:
        return self.blocking.robots

    async def state(self, robot: int, max_age_s: float = FRESH_S) -> RobotState:
        return await asyncio.to_thread(self.blocking.state, robot, max_age_s)

    async def pose(self, robot: int, max_age_s: float = FRESH_S) -> Pose:
        return await asyncio.to_thread(self.blocking.pose, robot, max_age_s)

    async def mission(self, max_age_s: float = FRESH_S) -> str:
        return await asyncio.to_thread(self.blocking.mission, max_age_s)

    async def wait(self, condition: Callable[[], bool], timeout_s: float) -> None:
        await asyncio.to_thread(self.blocking.wait, condition, timeout_s)

    async def wait_mission(self, *states: str, timeout_s: float = 60.0) -> str:
        return await asyncio.to_thread(self.blocking.wait_mission, *states, timeout_s=timeout_s)

    async def wait_ready(self, timeout_s: float = 60.0) -> None:
        await asyncio.to_thread(self.blocking.wait_ready, timeout_s)

    async def wait_event(self, text: str = "", timeout_s: float = 60.0) -> Event:
        return await asyncio.to_thread(self.blocking.wait_event, text, timeout_s)


async def connect_async(
    station: str | None = None, *, fleet: str = DEFAULT_FLEET, keys: str | Path | None = None, insecure: bool = False
) -> AsyncFleet:
    """`connect`, awaited."""
    return AsyncFleet(await asyncio.to_thread(connect, station, fleet=fleet, keys=keys, insecure=insecure))
