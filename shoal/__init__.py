"""Scripts for a fleet: connect to a station, make its operator's requests, read live states, simulate, open runs as tables.

    import shoal

    with shoal.connect() as fleet:
        fleet.start()
        fleet.go((1.0, 0.5))

Requests are those of `groundstation mission ...`, with the same checks by the station; nothing here speaks to a robot. Lengths
in m, angles in rad, pool frame; messages are those of shoal/messages/messages.py. docs/scripting.md has examples.
"""

from groundstation.scripting.asynchronous import AsyncFleet, connect_async
from groundstation.scripting.fleet import ConnectedFleet, NotHeard, RequestFailed, connect
from groundstation.scripting.runs import FlownRun, open_run
from sim_bridge.scripting import simulate, simulation

__all__ = [
    "AsyncFleet",
    "ConnectedFleet",
    "FlownRun",
    "NotHeard",
    "RequestFailed",
    "connect",
    "connect_async",
    "open_run",
    "simulate",
    "simulation",
]
