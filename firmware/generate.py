"""SHELL: write the C headers that the firmware shares with the Python programs: MAVLink's, and the table of parameters.

Run by firmware/Makefile:  python firmware/generate.py BUILD EXPERIMENT
The MAVLink headers come from pymavlink's own generator and the dialect that the Python programs speak. The parameters' names,
ranges and defaults are those of the experiment's vehicle (sim_bridge/thruster_board/parameters.py).
"""

import sys
from pathlib import Path

from pymavlink.dialects import v20
from pymavlink.generator import mavgen

from shoal.config.experiment import load_experiment
from sim_bridge.thruster_board.parameters import Parameters

DIALECT = "common"


def mavlink_headers(folder: Path) -> None:
    """Generate the C headers of the dialect."""
    definitions = Path(v20.__path__[0]) / f"{DIALECT}.xml"
    options = mavgen.Opts(str(folder), wire_protocol="2.0", language="C", validate=False)
    if not mavgen.mavgen(options, [str(definitions)]):
        raise SystemExit(f"{definitions}: pymavlink's generator cannot read it")


def parameter_table(file: Path, experiment: str) -> None:
    """Write one PARAMETER(name, low, high, whole, default, bounds) for each row, in the order of the wire."""
    parameters = Parameters.of(load_experiment(experiment))
    rows = [
        f'PARAMETER({row.name}, {row.low:.1f}f, {row.high:.1f}f, {str(row.whole).lower()}, {value!r}f, "{row.bounds}")'
        for row, value in zip(parameters.table, parameters.values, strict=True)
    ]
    text = f"/* Parameters of the experiment {experiment}, by generate.py. */\n" + "\n".join(rows) + "\n"
    file.write_text(text, encoding="ascii")


if __name__ == "__main__":
    build = Path(sys.argv[1])
    build.mkdir(parents=True, exist_ok=True)
    mavlink_headers(build / "mavlink")
    parameter_table(build / "parameter_table.h", sys.argv[2])
