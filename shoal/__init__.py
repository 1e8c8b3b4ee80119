"""Scripts for a fleet: connect to a station, make its operator's requests, read live states, simulate, open runs as tables.

    import shoal

    with shoal.connect() as fleet:
        fleet.start()
        fleet.go((1.0, 0.5))

Requests are those of `groundstation mission ...`, with the same checks by the station; nothing here speaks to a robot. Lengths
in m, angles in rad, pool frame; messages are those of wire/messages/messages.py. docs/scripting.md has examples.
"""

from shoal.asynchronous import AsyncFleet, connect_async
from shoal.fleet import ConnectedFleet, NotHeard, RequestFailed, connect
from shoal.runs import FlownRun, open_run
from shoal.simulation import simulate, simulation

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
