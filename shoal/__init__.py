"""Formations of small underwater robots: what the programs share, and the door for scripts.

    import shoal

    with shoal.connect() as fleet:
        fleet.start()
        fleet.go((1.0, 0.5))

Scripts connect to a station, make its operator's requests, read live states, simulate, and open runs as tables. Requests are
those of `groundstation mission ...`, with the same checks by the station; nothing here speaks to a robot. Lengths in m, angles
in rad, pool frame; messages are those of shoal/messages/messages.py. docs/scripting.md has examples.

The packages below hold what at least two of groundstation, localizer and robot_agent need, and import none of them. This door
names functions of other packages and loads them when a script asks for one, so that `import shoal` costs a program nothing.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from groundstation.scripting.fleet import ConnectedFleet, NotHeard, RequestFailed, connect
    from groundstation.scripting.runs import FlownRun, open_run
    from sim_bridge.in_process.env import Env
    from sim_bridge.scripting import simulate, simulation

__all__ = [
    "ConnectedFleet",
    "Env",
    "FlownRun",
    "NotHeard",
    "RequestFailed",
    "connect",
    "open_run",
    "simulate",
    "simulation",
]

_HOMES = {
    "ConnectedFleet": "groundstation.scripting.fleet",
    "Env": "sim_bridge.in_process.env",
    "FlownRun": "groundstation.scripting.runs",
    "NotHeard": "groundstation.scripting.fleet",
    "RequestFailed": "groundstation.scripting.fleet",
    "connect": "groundstation.scripting.fleet",
    "open_run": "groundstation.scripting.runs",
    "simulate": "sim_bridge.scripting",
    "simulation": "sim_bridge.scripting",
}


def __getattr__(name: str) -> Any:
    """Load what a script asks for. Raises AttributeError for a name that the door does not have."""
    if name not in _HOMES:
        raise AttributeError(f"module 'shoal' has no attribute {name!r}")
    return getattr(import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    """The names of the door, for completion."""
    return [*globals(), *__all__]
