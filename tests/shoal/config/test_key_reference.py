"""The reference of keys and the editors' schemas say what the loader does, and know every key."""

import copy
import json
import tomllib
from pathlib import Path
from typing import Any

import jsonschema
import pytest

from shoal.config.experiment import EXPERIMENTS, Experiment, load_experiment
from shoal.config.key_reference import ROOTS, SCHEMAS, KeyEntry, schema, tables
from shoal.config.loader import apply_setting
from shoal.config.vehicle import VEHICLES, load_vehicle
from shoal.errors import ConfigError

pytestmark = pytest.mark.long
ENTRIES = {kind: [entry for table in tables(kind) for entry in table.entries] for kind in ROOTS}
PATHS = {
    "circle": 'path={kind="circle", diameter_m=0.45, lap_s=100.0, depth_m=0.3}',
    "waypoints": 'path={kind="waypoints", points_m=[[0, 0], [1, 0], [1, 1]], speed_mps=0.1}',
    "route": 'path={kind="route", via_m=[[0, 0], [1, 0]], speed_mps=0.1}',
}
TABLES = {  # tables of lists that the pool has none of
    "islands": "islands=[{position_m=[1.0, 0.5], radius_m=0.1}]",
    "landmarks": "landmarks=[{id=40, position_m=[1, 1, 0]}, {id=41, position_m=[1, 0, 0]}, {id=42, position_m=[0, 1, 0]},"
    " {id=43, position_m=[0, 0, 0]}]",
    "check_marks": "check_marks=[{id=40, position_m=[1, 1, 0]}]",
    "formation": "formation.changes=[{at_s=1.0}]",
    "thrusters": "vehicle=vectored",
    "sim": 'sim={faults=[{at_s=1.0, what="camera dark"}], drifters=[{start_m=[0, 0, 0]}]}',
}


def leaves(table: Any, prefix: str = "") -> set[str]:
    """Dotted names of a table's values, as the reference names them."""
    if isinstance(table, dict):
        return {name for key, value in table.items() for name in leaves(value, f"{prefix}.{key}".lstrip("."))}
    if isinstance(table, list) and table and isinstance(table[0], dict):
        return {name for item in table for name in leaves(item, f"{prefix}.N")}
    return {prefix}


@pytest.mark.parametrize("kind", ENTRIES)
def test_every_key_has_a_meaning_in_a_sentence_and_an_example(kind: str) -> None:
    for entry in ENTRIES[kind]:
        assert entry.meaning.endswith(".") and entry.type and entry.example, entry.name
        assert len(entry.meaning) <= 160, entry.name


@pytest.mark.parametrize("kind", ENTRIES)
def test_the_loader_takes_every_example(kind: str) -> None:
    for entry in ENTRIES[kind]:
        load_experiment("two-cameras" if entry.name.startswith("cameras") else "pool", _example(kind, entry))


def _example(kind: str, entry: KeyEntry) -> list[str]:
    """The example of a key, with what has to be there beside it."""
    settings = [TABLES[entry.name.partition(".")[0]]] if entry.name.partition(".")[0] in TABLES else []
    settings += [PATHS[entry.when]] if entry.when else []
    if entry.name == "safety.plan_max_age_s":
        settings += ["controller.mpc.horizon=200"]
    return [*settings, f"{'vehicle.' if kind == 'vehicle' else ''}{entry.example}"]


@pytest.mark.parametrize("name", sorted(path.stem for path in EXPERIMENTS.glob("*.toml")))
def test_the_reference_knows_every_key_of_a_loaded_experiment(name: str) -> None:
    loaded = load_experiment(name).model_dump(mode="json", exclude_none=True)
    names = {e.name for e in ENTRIES["experiment"]} | {f"vehicle.{e.name}" for e in ENTRIES["vehicle"]}
    whole = {key for key in names if f"{key}.N" not in names}
    own_path = {key for key in leaves(loaded) if key.startswith("robots.N.path.")}  # the same section as [path]
    empty = {
        "vehicle.thrusters",
        "cameras",
        "islands",
        "landmarks",
        "check_marks",
        "article",
        "formation.changes",
        "sim.faults",
        "sim.drifters",
    }
    assert leaves(loaded) - own_path - empty <= whole


def test_a_range_of_the_reference_is_the_loaders() -> None:
    bounds = {entry.name: entry.allowed for entry in ENTRIES["experiment"]}
    for key, good, bad in (("controller.mpc.horizon", 200, 201), ("sim.latency_s", 0.5, 0.51), ("seed", 0, -1)):
        load_experiment("pool", [f"{key}={good}"])
        with pytest.raises(ConfigError):
            load_experiment("pool", [f"{key}={bad}"])
        assert f"= {good}" in bounds[key]


@pytest.mark.parametrize("path", [*EXPERIMENTS.glob("*.toml"), *VEHICLES.glob("*.toml")], ids=lambda path: path.stem)
def test_a_shipped_file_names_its_schema_and_keeps_it_by_another_validator(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    named = text.partition("\n")[0].removeprefix("#:schema ")
    rules = json.loads((path.parent / named).read_text(encoding="utf-8"))
    jsonschema.Draft202012Validator.check_schema(rules)
    jsonschema.validate(tomllib.loads(text), rules)


@pytest.mark.parametrize(
    "setting", ["controller.mpc.horizon=1", "pool.size_m=[1.0, 2.0]", "path.kind=5", "pol.walls=true", "seed=1.5"]
)
def test_the_schema_refuses_what_the_loader_refuses(setting: str) -> None:
    table = tomllib.loads((EXPERIMENTS / "pool.toml").read_text(encoding="utf-8"))
    rules = schema("experiment")
    jsonschema.validate(table, rules)
    wrong = copy.deepcopy(table)
    apply_setting(wrong, setting)
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(wrong, rules)
    with pytest.raises(ConfigError):
        load_experiment("pool", [setting])


def test_the_schemas_describe_every_key_for_an_editor() -> None:
    for kind in ROOTS:
        rules = json.loads((SCHEMAS / f"{kind}.schema.json").read_text(encoding="utf-8"))
        for section in (rules, *rules["$defs"].values()):
            assert all(key["description"] for key in section["properties"].values())


def test_loaded_vehicle_keys_are_those_of_the_reference() -> None:
    """Of both kinds: with legs, and with thrusters that do not turn."""
    kinds = [load_vehicle(name).model_dump(mode="json", exclude_none=True) for name in ("spherical", "vectored")]
    loaded = {key for kind in kinds for key in leaves(kind)}
    assert loaded - {"thrusters"} == {entry.name for entry in ENTRIES["vehicle"]}


def test_no_camera_is_needed_where_nothing_looks(tmp_path: Path) -> None:
    text = (EXPERIMENTS / "pool.toml").read_text(encoding="utf-8")
    before, _, rest = text.partition("[camera]")
    file = tmp_path / "mine.toml"
    file.write_text(before + rest[rest.index("[limits]") :].replace("pose_rms_m = 0.005\n", ""))
    with pytest.raises(ConfigError, match=r"camera: missing.*sil --poses"):
        load_experiment(str(file))
    blind = load_experiment(str(file), ["localizer.uses_camera=false"])
    assert isinstance(blind, Experiment) and not blind.watches_obstacles
