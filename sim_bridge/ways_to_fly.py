"""Ways to fly without water, and which parts are real in each: the table of docs/reference/ways-to-fly.md."""

from typing import NamedTuple


class WayToFly(NamedTuple):
    """One way to fly: its command, and what stands in place of each part of a pool."""

    command: str
    localizer: str
    station: str
    agents: str
    boards: str
    network: str
    time: str
    same_bits: bool  # the same seed gives the same bits, on one machine with one set of packages


RUNS, IN_MEMORY = "real", "real, in this process"
WAYS = (
    WayToFly(
        "sim-bridge sil NAME --real-time", RUNS, RUNS, RUNS, "simulated, MAVLink", "Zenoh",
        "wall clock", False,
    ),
    WayToFly(
        "sim-bridge sil NAME", RUNS, RUNS, RUNS, "simulated, MAVLink", "Zenoh",
        "simulated", True,
    ),
    WayToFly(
        "sim-bridge sil NAME --one-process", IN_MEMORY, IN_MEMORY, IN_MEMORY, "simulated, MAVLink in memory", "none",
        "simulated", True,
    ),
    WayToFly(
        "sim-bridge numeric NAME", "none: true poses with noise", "planner alone", "control step",
        "none", "none", "simulated", True,
    ),
    WayToFly(
        "sim-bridge hil NAME --board 1=LINK", RUNS, RUNS, RUNS, "real, in HIL mode",
        "Zenoh, and the board's link", "wall clock", False,
    ),
)  # fmt: skip


def table() -> str:
    heads = ("Command", "Localizer", "Station", "Agents", "Boards", "Network", "Time", "Same seed, same bits")
    lines = [f"| {' | '.join(heads)} |", f"|{'---|' * len(heads)}"]
    for way in WAYS:
        command, *parts = way[:-1]
        lines.append(f"| {' | '.join((f'`{command}`', *parts, 'yes' if way.same_bits else 'no'))} |")
    return "\n".join(lines) + "\n"
