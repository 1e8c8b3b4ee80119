"""Reference of keys and faults, the editors' schemas, and the table of gains in docs/control.md."""

import json
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path

from groundstation.mission import state_machine as mission_states
from robot_agent.control.nonlinear.tuning import formulas
from robot_agent.vehicle import kalman
from shoal.config import key_reference
from shoal.config.fault_injection import KINDS, OF_PROCESSES, Break
from shoal.config.key_reference import KeyEntry, KeyTable
from shoal.config.vehicle import Vehicle, load_vehicle
from sim_bridge.fault_schedule import NUMERIC, is_among

ROOT = Path(__file__).parents[1]
LAID = "Written by `make docs` from the models in `shoal/config/`; `groundstation keys-of` prints examples.\n"
COPIES = 4  # keys that two sections share: the second one is a copy of the first
AGAIN = 4  # words of a meaning that is not printed twice on a page
HOW_TO_READ = """A name ends with its unit ([units](../frames-and-units.md#units)). A value without a kind is a number. A key
without default may be left out: its meaning says what holds then. Ranges: `groundstation keys-of`, the editor's schema, or
the error message.
"""
AS_THERE = "How to read the list: [experiment.md](experiment.md).\n"


def _row(entry: KeyEntry, prefix: str) -> str:
    """`key=default` kind: meaning."""
    default = "" if entry.default in ("", "required") else f"={entry.default}"
    boolean = "" if default else "true/false"
    kind = entry.type.replace("list of ", "").replace("true or false", boolean).replace('" or "', '", "')
    marks = [mark for mark, is_set in (("required", entry.default == "required"), ("live", entry.live)) if is_set]
    about = ", ".join(part for part in ("" if kind == "number" else kind, *marks) if part)
    return f"* `{entry.name.removeprefix(prefix)}{default}`{about and f' {about}'}: {entry.meaning}"


def _table(table: KeyTable) -> Iterator[str]:
    when = next((f', kind "{entry.when}"' for entry in table.entries if entry.when), "")
    repeated = any(f"{table.name}.N." in entry.name for entry in table.entries)
    yield f"\n## {f'[[{table.name}]]' if repeated else f'[{table.name}]' if table.name else 'Top of the file'}{when}\n"
    yield f"{table.meaning}\n"
    if table.entries:
        prefix = f"{table.name}.{'N.' if repeated else ''}" if table.name else ""
        yield from (
            _row(entry, prefix) for entry in table.entries if not (table.entries[0].when and entry.name.endswith(".kind"))
        )


def _without_copies(tables: Iterable[KeyTable]) -> Iterator[KeyTable]:
    """The tables. One whose keys are those of an earlier table, as [[cameras]] has those of [camera], lists its other keys; so
    does a further kind of a section."""
    earlier: dict[str, set[tuple[str, ...]]] = {}
    meanings: set[str] = set()
    of_kind: dict[str, set[tuple[str, ...]]] = {}  # rows of a section that has several kinds, as the paths
    for table in tables:
        rows = {entry: (entry.name, entry.type, entry.default, entry.meaning) for entry in table.entries}
        earlier_rows = of_kind.setdefault(table.name, set())
        again = [f"`{entry.name.rpartition('.')[2]}`" for entry, row in rows.items() if row in earlier_rows]
        if again:
            fresh = tuple(entry for entry, row in rows.items() if row not in earlier_rows)
            table = replace(table, meaning=f"{table.meaning} As above: {', '.join(again)}.", entries=fresh)
        earlier_rows |= set(rows.values())
        keys = {entry: (entry.name.rpartition(".")[2], entry.type, entry.meaning) for entry in table.entries}
        first = next((name for name, other_keys in earlier.items() if len(other_keys & set(keys.values())) >= COPIES), "")
        if first:
            others = tuple(entry for entry, key in keys.items() if key not in earlier[first])
            about = "" if table.meaning in meanings else f"{table.meaning} "
            yield replace(table, meaning=f"{about}The keys of [{first}]{', and:' if others else '.'}", entries=others)
        else:
            earlier[table.name] = set(keys.values())
            meanings.add(table.meaning)
            yield table


def _once(tables: Iterable[KeyTable]) -> Iterator[KeyTable]:
    """The tables, with "as above" for a meaning that an earlier key of the same name has."""
    explained: set[tuple[str, str]] = set()
    for table in tables:
        leaves = [(entry.name.rpartition(".")[2], entry.meaning) for entry in table.entries]
        entries = tuple(
            replace(entry, meaning="as above.") if leaf in explained and len(leaf[1].split()) > AGAIN else entry
            for entry, leaf in zip(table.entries, leaves, strict=True)
        )
        explained.update(leaves)
        yield replace(table, entries=entries)


def _page(title: str, intro: str, tables: Iterable[KeyTable], how: str = AS_THERE) -> str:
    sections = (line for table in _once(_without_copies(tables)) for line in _table(table))
    return "\n".join([f"# {title}\n\n{LAID}\n{intro}\n{how}".rstrip(), *sections]) + "\n"


def _faults() -> Iterator[str]:
    yield f"# Faults that can be injected\n\n{LAID}"
    yield "Each is a line after `--fault` or a table `[[sim.faults]]` ([simulation.md](simulation.md)), as in"
    yield "`--fault 't=20 for=5 thruster 2/3 weak 0.5'`: at 20 s, for 5 s, thruster 3 of robot 2. A value may be left out."
    yield "*In*: 1 `sil --real-time`, 2 `sil`, 3 `numeric`.\n"
    yield "| Fault | What happens | Value | In |\n|---|---|---|---|"
    for kind, (target, effects) in KINDS.items():
        for name, effect in effects.items():
            words = " ".join(word for word in (kind, target, name) if word)
            value = (
                f"{effect.meaning}: {effect.low:g} to {effect.high:g}, default {effect.default:g}" if effect.meaning else ""
            )
            first, last = 2 if kind == "radio" else 1, 3 if is_among(Break(kind, name), NUMERIC) else 2
            where = "1" if kind in OF_PROCESSES else f"{first}-{last}"
            yield f"| {' | '.join((f'`{words}`', effect.happens, value, where))} |"


GAINS = "<!-- gains of the nonlinear MPC: written by `make docs` -->\n"
SHIPPED = ("spherical", "vectored")
PERIOD_S = 0.05


def _observer(vehicle: Vehicle) -> list[tuple[str, str, str]]:
    """Quantity, formula and value of the observer's noise."""
    noise, largest_mps = kalman.vehicle_noise(vehicle), vehicle.limits.speed_mps
    hand_mps2 = vehicle.limits.wrench[0] / vehicle.mass.surge_kg
    shares = f"{100.0 * kalman.SHARE:g} %; {100.0 * kalman.LASTING_SHARE:g} %"
    ratios = f"{100.0 * kalman.DRAG_LOG:g} %; {100.0 * kalman.MASS_LOG:g} %"
    return [
        ("idle force that lasts, surge", "hypot(2 x 6 % of the idle thrust, rounding) / m", f"{noise.idle_mps2:.1e} m/s^2"),
        ("the same, yaw", "the same force x arm / I", f"{noise.idle_radps2:.1e} rad/s^2"),
        (
            "rounding of pulses, surge", "thrust of one microsecond at idle thrust x sqrt(thrusters / 12) / m",
            f"{noise.rounding_mps2:.1e} m/s^2",
        ),
        ("force that comes and goes; that lasts", f"of thrust and drag, for {noise.passes_s:g}; {noise.lasts_s:g} s", shares),
        ("hand on a robot without thrust", f"largest thrust / m, for {kalman.HAND_S:g} s", f"{hand_mps2:.2g} m/s^2"),
        ("current at first, standard deviation", "half of the greatest speed", f"{0.5 * min(largest_mps, 1.0):.2f} m/s"),
        ("drag; mass at first", f"relative to the vehicle file, correlation {kalman.ALIKE:g}", ratios),
    ]  # fmt: skip


def _gains() -> str:
    """The table of noise and gains: quantity, formula, and the value for each shipped vehicle."""
    vehicles = [load_vehicle(name) for name in SHIPPED]
    of_each = [[*_observer(vehicle), *formulas(vehicle, PERIOD_S)] for vehicle in vehicles]
    rows = [(name, how, *(column[i][2] for column in of_each)) for i, (name, how, _) in enumerate(of_each[0])]
    head = "| Quantity | Formula | " + " | ".join(f"`{name}`" for name in SHIPPED) + " |\n|---|---|" + "---|" * len(SHIPPED)
    return "\n".join([head, *(f"| {' | '.join(row)} |" for row in rows)]) + "\n"


MISSION_STATES = """# States of a mission

Written by `make docs` from the station's own table; `groundstation mission states` prints it. Explained in
[missions.md](../missions.md). States whose name does not say it all:

"""


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
        folder / "experiment.md": _page(
            "Keys of an experiment",
            "Every key but those of [controller.md](controller.md) and [simulation.md](simulation.md).\n"
            "`--set pool.walls=false` changes one; entries of lists are numbered from 0: `--set robots.0.urgent=true`.\n",
            others,
            HOW_TO_READ,
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
        folder / "mission-states.md": MISSION_STATES + mission_states.markdown(),
        **{
            key_reference.SCHEMAS / f"{kind}.schema.json": json.dumps(key_reference.schema(kind), indent=1) + "\n"
            for kind in key_reference.ROOTS
        },
    }
