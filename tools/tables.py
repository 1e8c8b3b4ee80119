"""Pages from tables in the programs: modes of a robot, parameters of a board, and the ways to fly of docs/simulator.md."""

import re
from pathlib import Path
from typing import NamedTuple

from robot_agent.safety import guidance_states, modes
from shoal.config.experiment import load_experiment
from sim_bridge.thruster_board.parameters import FIXED, Parameters

REFERENCE = Path(__file__).parents[1] / "docs" / "reference"

MODES = """# Modes and guidance states of a robot

Written by `make docs` from the agent's own tables; `robot-agent modes` prints them. The reasons behind them:
[modes.md](../modes.md).

"""
GUIDANCE = """
## Guidance states

A robot with power is in one guidance state. In each state exactly one thing decides what is flown. Half a horizon is the
time in which a robot can turn round and stop, 3.5 s for `spherical`.

"""
WAYS_MARK = "<!-- ways to fly: written by `make docs` -->\n"
PARAMETERS = """# Parameters of a thruster board

Written by `make docs` from `sim_bridge/thruster_board/parameters.py`; edit that. "Here" is the value for `pool`.
Rules for reading and writing them: [board.md](../board.md#parameters).

| Parameter | Range | Here | |
|---|---|---|---|
"""
CURVE = (
    "| `CRV01_US`, `CRV01_N` ... `CRV12_US`, `CRV12_N` | 500 to 2500, whole; -1000 to 1000 | the vehicle file's "
    "| the thrust curve, point by point: pulse, and thrust in N |\n"
)


def _parameters() -> str:
    """Every parameter but the curve's points, which are one row."""
    values = Parameters.of(load_experiment("pool")).values
    by_text: dict[tuple[str, ...], list[str]] = {}  # parameters that differ by their output's number share a row
    for row, value in zip(FIXED, values, strict=False):
        text = (row.bounds, f"{value:g}", re.sub(r"output \d", "the output of that number", row.meaning))
        by_text.setdefault(text, []).append(f"`{row.name}`")
    rows = (f"| {', '.join(names)} | {' | '.join(text)} |\n" for text, names in by_text.items())
    return PARAMETERS + "".join(rows) + CURVE


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


def _ways() -> str:
    """The table of the ways to fly."""
    heads = ("Command", "Localizer", "Station", "Agents", "Boards", "Network", "Time", "Same seed, same bits")
    lines = [f"| {' | '.join(heads)} |", f"|{'---|' * len(heads)}"]
    for way in WAYS:
        command, *parts = way[:-1]
        lines.append(f"| {' | '.join((f'`{command}`', *parts, 'yes' if way.same_bits else 'no'))} |")
    return "\n".join(lines) + "\n"


def files() -> dict[Path, str]:
    """The pages and their text."""
    simulator = REFERENCE.parent / "simulator.md"
    before, _, after = simulator.read_text(encoding="utf-8").split(WAYS_MARK)
    return {
        REFERENCE / "modes.md": MODES + modes.table() + GUIDANCE + guidance_states.table(),
        simulator: f"{before}{WAYS_MARK}{_ways()}{WAYS_MARK}{after}",
        REFERENCE / "board-parameters.md": _parameters(),
    }
