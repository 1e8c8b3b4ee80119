"""Write docs/reference/, shoal/config/schemas/ and the table of gains in docs/control.md from the sources: `make docs`.

A test fails when they are behind."""

import json
import re
from collections.abc import Iterable, Iterator
from pathlib import Path

from robot_agent.control.nonlinear.tuning import formulas
from shoal.config import key_reference
from shoal.config.fault_injection import KINDS, OF_PROCESSES
from shoal.config.key_reference import KeyEntry, KeyTable
from shoal.config.vehicle import load_vehicle

ROOT = Path(__file__).parents[1]
LAID = "Written by `make docs` from the models in `shoal/config/`; edit those. `groundstation keys-of` searches it.\n"
COLUMNS = "| Key | Type | Unit | Range | Default | Meaning | Example |\n|---|---|---|---|---|---|---|"
OUT = "A default that is empty: leaving the key out has a meaning of its own.\n"


def _row(entry: KeyEntry, prefix: str) -> str:
    name = f"`{entry.name.removeprefix(prefix)}`{' (live)' if entry.live else ''}"
    default = f"`{entry.default}`" if entry.default not in ("", "required") else entry.default
    example = f"`{entry.example.partition('=')[2]}`"
    cells = (name, entry.type, entry.unit, entry.allowed, default, entry.meaning, example)
    return f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in cells)} |"


def _table(table: KeyTable) -> Iterator[str]:
    when = next((f', kind "{entry.when}"' for entry in table.entries if entry.when), "")
    repeated = any(f"{table.name}.N." in entry.name for entry in table.entries)
    yield f"\n## {f'[[{table.name}]]' if repeated else f'[{table.name}]' if table.name else 'Top of the file'}{when}\n"
    yield f"{table.meaning}\n"
    if table.entries:
        yield COLUMNS
        prefix = f"{table.name}.{'N.' if repeated else ''}" if table.name else ""
        yield from (_row(entry, prefix) for entry in table.entries)


def _page(title: str, intro: str, tables: Iterable[KeyTable]) -> str:
    return "\n".join([f"# {title}\n\n{LAID}\n{intro}\n{OUT}", *(line for table in tables for line in _table(table))]) + "\n"


def _faults() -> Iterator[str]:
    yield f"# Faults that can be injected\n\n{LAID}"
    yield "Each is a line after `--fault`, or a table `[[sim.faults]]` ([simulation.md](simulation.md)). `for=SECONDS` makes"
    yield "it end. A value may be left out.\n"
    yield "| Fault | Value | Default | Range | Not in lockstep | Example |\n|---|---|---|---|---|---|"
    for kind, (target, effects) in KINDS.items():
        for name, effect in effects.items():
            place = {"ROBOT": "2", "ROBOT/THRUSTER": "2/3", "NAME": "agent-2"}.get(target, "")
            words = " ".join(word for word in (kind, target, name) if word)
            value = f"{effect.default:g}" if effect.meaning else ""
            line = " ".join(word for word in ("t=20", kind, place, name, value) if word)
            allowed = f"{effect.low:g} to {effect.high:g}" if effect.meaning else ""
            real_time = "x" if kind in OF_PROCESSES else ""
            yield f"| `{words}` | {effect.meaning} | {value} | {allowed} | {real_time} | `{line}` |"


GAINS = "<!-- gains of the nonlinear MPC: written by `make docs` -->\n"
SHIPPED = ("spherical", "vectored")
PERIOD_S = 0.05


def _gains() -> str:
    """The table of gains: quantity, formula, and the value for each shipped vehicle."""
    of_each = [formulas(load_vehicle(name), PERIOD_S) for name in SHIPPED]
    rows = [(name, how, *(column[i][2] for column in of_each)) for i, (name, how, _) in enumerate(of_each[0])]
    head = "| Quantity | Formula | " + " | ".join(f"`{name}`" for name in SHIPPED) + " |\n|---|---|" + "---|" * len(SHIPPED)
    return "\n".join([head, *(f"| {' | '.join(row)} |" for row in rows)]) + "\n"


def _constants() -> Iterator[str]:
    yield f"# Constants of controller and observer\n\n{LAID.replace('the models in `shoal/config/`', 'the sources')}"
    yield "Everything else follows from the vehicle file, the control period and the reported noise"
    yield "([control.md](../control.md#weights) has the formulas). A name ends with its unit; one without is a ratio."
    yield "Each was flown on all cells of the grid ([evidence](../evidence/robots.md)): 2.3 to 40 kg, thrust x 0.5 to 3,"
    yield "inertia x 0.25 to 8, lag 0.05 to 0.5 s, dead time up to 0.15 s, 10 to 50 Hz, noise x 1 to 10, currents up to 0.8 of"
    yield "the speed."
    for path in CONSTANTS:
        yield f"\n## {path}\n\n| Constant | Value | Reason |\n|---|---|---|"
        lines = (ROOT / path).read_text(encoding="utf-8").splitlines()
        for line in lines:
            found = re.match(r"([A-Z][A-Z0-9_, ]*) = ([^#]+?)  # (.+)", line)
            if found and re.search(r"\d", found[2]) and not re.search(r"range\(|slice\(|{", found[2]):
                name, value, reason = found.groups()
                yield f"| `{name}` | `{value}` | {reason.replace('|', chr(92) + '|')} |"


CONSTANTS = (
    *(f"robot_agent/control/nonlinear/{name}.py" for name in (
        "tuning", "prediction", "program", "planner", "first_guess", "course", "obstacle_rows", "nonlinear_controller",
    )),
    "robot_agent/vehicle/kalman.py",
    "robot_agent/vehicle/filter_bank.py",
)  # fmt: skip


def files() -> dict[Path, str]:
    """Every generated file and its text."""
    everything = key_reference.tables("experiment")
    in_controller = [t for t in everything if t.name.partition(".")[0] == "controller"]
    in_sim = [t for t in everything if t.name.partition(".")[0] == "sim"]
    others = [t for t in everything if t not in in_controller and t not in in_sim]
    vehicle = key_reference.tables("vehicle")
    folder, control = ROOT / "docs" / "reference", ROOT / "docs" / "control.md"
    before, _, after = control.read_text(encoding="utf-8").split(GAINS)
    return {
        control: f"{before}{GAINS}{_gains()}{GAINS}{after}",
        folder / "gains.md": "\n".join(_constants()) + "\n",
        folder / "experiment.md": _page(
            "Keys of an experiment",
            "Every key but those of [controller.md](controller.md) and [simulation.md](simulation.md).\n"
            "`--set pool.walls=false` changes one; entries of lists are numbered from 0: `--set robots.0.urgent=true`.\n",
            others,
        ),
        folder / "controller.md": _page(
            "Keys of the controller",
            "They stand below `[controller]` in the experiment. `groundstation gains set` changes (live) keys in flight.\n",
            in_controller,
        ),
        folder / "simulation.md": _page(
            "Keys of the simulator",
            "They stand below `[sim]` in the experiment. Only the simulator reads them. Faults: [faults.md](faults.md).\n",
            in_sim,
        ),
        folder / "vehicle.md": _page(
            "Keys of a vehicle",
            "A vehicle has a file of its own. An experiment may change keys of it: `--set vehicle.limits.speed_mps=0.3`, or\n"
            '`vehicle = { like = "spherical", radius_m = 0.2 }`.\n',
            vehicle,
        ),
        folder / "faults.md": "\n".join(_faults()) + "\n",
        **{
            key_reference.SCHEMAS / f"{kind}.schema.json": json.dumps(key_reference.schema(kind), indent=1) + "\n"
            for kind in key_reference.ROOTS
        },
    }


if __name__ == "__main__":
    for path, text in files().items():
        path.parent.mkdir(exist_ok=True)
        path.write_text(text, encoding="utf-8")
