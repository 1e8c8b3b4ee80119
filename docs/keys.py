"""Write docs/reference/ and wire/schemas/ from the models that check the files: `make docs`.

A test fails when they are behind."""

import json
from collections.abc import Iterable, Iterator
from pathlib import Path

from wire import key_reference
from wire.config.fault_injection import KINDS, OF_PROCESSES
from wire.key_reference import KeyEntry, KeyTable

ROOT = Path(__file__).parents[1]
LAID = "Written by `make docs` from the models in `wire/config/`; edit those. `groundstation keys-of` searches it.\n"
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


def files() -> dict[Path, str]:
    """Every generated file and its text."""
    everything = key_reference.tables("experiment")
    in_controller = [t for t in everything if t.name.partition(".")[0] == "controller"]
    in_sim = [t for t in everything if t.name.partition(".")[0] == "sim"]
    others = [t for t in everything if t not in in_controller and t not in in_sim]
    vehicle = key_reference.tables("vehicle")
    folder = ROOT / "docs" / "reference"
    return {
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
