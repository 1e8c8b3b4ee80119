"""The experiment file: every key in turn is given a wrong type, an impossible value, a misspelling, or is left out."""

import contextlib
import copy
import math
import tomllib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomli_w

from shoal.config.experiment import EXPERIMENTS, Experiment, dump_experiment, experiment_path, load_experiment
from shoal.config.loader import apply_setting, check
from shoal.config.vehicle import Vehicle
from shoal.errors import ConfigError
from shoal.messages.messages import required

Key = tuple[str | int, ...]

# The pool's keys, and those that it leaves alone because they have no default.
OPTIONAL = (
    "robots.0.start=[0.0, 0.0, 0.3, 0.0]",
    "robots.0.marker_id=7",
    "sim.plant.thruster_lag_s=0.2",
    "limits.rms_m=0.1",
    "limits.rms_after_20s_m=0.03",
    "limits.rms_yaw_after_20s_rad=0.02",
    "limits.max_after_20s_m=0.08",
    "limits.pose_rms_m=0.005",
    "article.0.rms_yaw_rad=0.1",
)

# Keys whose value may have either sign; any other number must refuse to be hugely negative.
SIGNED = {
    "article.max_m",
    "article.rms_m",
    "article.rms_yaw_rad",
    "camera.centre_px",
    "camera.distortion",
    "camera.position_m",
    "camera.rotation_rad",
    "robots.node_m",
    "robots.start",
    "robots.start_offset",
    "sim.plant.buoyancy_n",
    "sim.plant.current_mps",
    "sim.plant.current_shear_per_s",
    "sim.plant.waves.direction_rad",
    "vehicle.legs.position_m",
    "vehicle.thruster.curve",
}

# Values that no other could stand for alone: others refer to them, or they are zero by definition.
TIED = {
    "controller.estimator.kind",
    "path.kind",
    "robots.0.id",
    "robots.0.neighbours.0",
    "robots.1.id",
    "robots.1.neighbours.0",
    "vehicle.thruster.curve.5.1",
    "vehicle.thruster.curve.6.1",
}


def _full() -> dict[str, Any]:
    table: dict[str, Any] = tomllib.loads(dump_experiment(load_experiment("pool")))
    for setting in OPTIONAL:
        apply_setting(table, setting)
    return table


FULL = _full()


def _items(node: Any, key: Key = ()) -> Iterator[tuple[Key, Any]]:
    """Every key of a table, at any depth, with its value."""
    pairs: list[tuple[str | int, Any]] = []
    if isinstance(node, dict):
        pairs = list(node.items())
    elif isinstance(node, list):
        pairs = list(enumerate(node))
    for part, value in pairs:
        yield (*key, part), value
        yield from _items(value, (*key, part))


def _dotted(key: Key) -> str:
    return ".".join(map(str, key))


LEAVES = [(key, value) for key, value in _items(FULL) if not isinstance(value, dict | list)]
KIND: Key = ("path", "kind")  # tells which keys the path has: with another kind they would not be looked at
TABLES: list[Key] = [(), *(key for key, value in _items(FULL) if isinstance(value, dict))]
by_section = pytest.mark.parametrize("section", dict.fromkeys(str(key[0]) for key, _ in LEAVES))  # or a key that stands alone


def _leaves(section: str) -> list[tuple[Key, Any]]:
    return [(key, value) for key, value in LEAVES if key[0] == section]


def _parent(table: dict[str, Any], key: Key) -> Any:
    node: Any = table
    for part in key[:-1]:
        node = node[part]
    return node


def _with(changes: Mapping[Key, object]) -> dict[str, Any]:
    table = copy.deepcopy(FULL)
    for key, value in changes.items():
        _parent(table, key)[key[-1]] = value
    return table


def _complaint(tmp_path: Path, table: dict[str, Any]) -> str:
    """The error message for this table, written to a file."""
    path = tmp_path / "mutant.toml"
    path.write_text(tomli_w.dumps(table), encoding="utf-8")
    with pytest.raises(ConfigError) as caught:
        load_experiment(str(path))
    lines = str(caught.value).splitlines()
    assert all(line.startswith(f"{path}: ") for line in lines), lines
    return "\n".join(line.removeprefix(f"{path}: ") for line in lines)


def test_the_walk_reaches_every_depth() -> None:
    dotted = {_dotted(key) for key, _ in LEAVES}
    assert {"name", "path.lap_s", "robots.1.neighbours.0", "vehicle.thruster.curve.3.1", "sim.plant.current_mps.2"} <= dotted
    assert len(LEAVES) > 200


def _wrong_types(key: Key, value: object) -> list[object]:
    wrong: list[object] = [17, 17] if isinstance(value, str) else ["true", 1] if isinstance(value, bool) else ["many", True]
    return [*wrong, 17 if key == ("vehicle",) else {"x": 1}]  # a table is a vehicle


@by_section
@pytest.mark.parametrize("turn", range(3))
def test_a_wrong_type_is_refused_by_name(tmp_path: Path, section: str, turn: int) -> None:
    """All keys of a section are wrong at once, and each is told."""
    wrong = {key: _wrong_types(key, value)[turn] for key, value in _leaves(section) if key != KIND}
    lines = _complaint(tmp_path, _with(wrong)).splitlines()
    for key, mutant in wrong.items():
        shown = f"{_dotted(key)} = {mutant!r}: " if not isinstance(mutant, dict) else _dotted(key)
        assert any(line.startswith(shown) for line in lines), shown


@by_section
@pytest.mark.parametrize("number", [math.nan, math.inf, -math.inf])
def test_no_number_may_be_nan_or_infinite(tmp_path: Path, section: str, number: float) -> None:
    wrong: dict[Key, object] = {key: number for key, value in _leaves(section) if not isinstance(value, bool | str)}
    complaint = _complaint(tmp_path, _with(wrong)) if wrong else ""
    for key in wrong:
        assert f"{_dotted(key)} = {number!r}: " in complaint


@by_section
def test_no_number_may_be_hugely_negative_but_those_that_have_a_sign(tmp_path: Path, section: str) -> None:
    for key, value in _leaves(section):
        name = ".".join(part for part in key if isinstance(part, str))
        if not isinstance(value, bool | str) and name not in SIGNED:
            last = next(part for part in reversed(key) if isinstance(part, str))
            assert last in _complaint(tmp_path, _with({key: -(10**6)})), f"add a range to {name}, or the name to SIGNED"


def test_a_misspelt_key_is_refused_with_the_choice(tmp_path: Path) -> None:
    for key in TABLES:
        complaint = _complaint(tmp_path, _with({(*key, "misspelt"): 1}))
        name = _dotted((*key, "misspelt"))
        siblings = [str(part) for part in _parent(FULL, (*key, "misspelt"))]
        assert complaint.startswith(f"{name}: unknown key (allowed here: ")
        allowed = complaint.removeprefix(f"{name}: unknown key (allowed here: ").removesuffix(")").split(", ")
        assert set(siblings) <= set(allowed)


@by_section
def test_a_missing_key_has_a_default_or_is_asked_for(tmp_path: Path, section: str) -> None:
    path = tmp_path / "mutant.toml"
    for key in [key for key, _ in _items(FULL) if key[0] == section and isinstance(key[-1], str)]:
        table = copy.deepcopy(FULL)
        del _parent(table, key)[key[-1]]
        path.write_text(tomli_w.dumps(table), encoding="utf-8")
        try:
            load_experiment(str(path))
        except ConfigError as error:
            if key == ("vehicle", "legs"):
                assert "vehicle: thrusters: has neither" in str(error)
                continue
            remark = "localizer.uses_camera = true" if key == ("camera",) else "it has no default"
            assert any(line.startswith(f"{path}: {_dotted(key)}: missing, and {remark}") for line in str(error).splitlines())


@pytest.mark.parametrize("key", ["name", "duration_s", "vehicle", "pool", "path", "robots", "camera"])
def test_keys_that_cannot_be_guessed_have_no_default(tmp_path: Path, key: str) -> None:
    table = {name: value for name, value in FULL.items() if name != key}
    assert f"{key}: missing" in _complaint(tmp_path, table)


@pytest.mark.parametrize(
    ("setting", "complaint"),
    [
        ("robots.1.id=1", "robots: id 1 is used twice"),
        ("robots.1.marker_id=1", "robots: marker_id 1 is used twice"),
        ("robots.0.neighbours=[1]", "neighbours of robot 1: 1 is not allowed"),
        ("robots.0.neighbours=[3]", "neighbours of robot 1: 3 is not allowed .once each: 2."),
        ("robots.0.neighbours=[2, 2]", "neighbours of robot 1: 2 is not allowed"),
        ("robots.0.marker_id=50", "robots.0.marker_id = 50"),
        ("robots.0.id=0", "robots.0.id = 0"),
        ("controller.mpc.blocks=[30, 30]", "controller.mpc: blocks sum to 60 steps, more than horizon = 50"),
        ("controller.mpc.blocks=[]", "controller.mpc.blocks = .*at least 1"),
        ("controller.estimator.kind=luenberger", "controller.estimator.kind = 'luenberger': .*'eso' or 'kalman'"),
        ("camera.position_m=[0, 0, 1]", "camera: position_m z = 1.0: the camera must hang above the water"),
        ("safety.pose_neutral_s=0.1", "safety: pose_neutral_s = 0.1 must be more than pose_hold_s = 0.19"),
        ("safety.pose_neutral_s=1", "safety.pose_neutral_s = 1: .*less than 1"),
        ("safety.station_disarm_s=61", "safety.station_disarm_s = 61: .*less than or equal to 60"),
        ("safety.plan_max_age_s=6", "safety.plan_max_age_s = 6: .*less than or equal to 5"),
        ("controller.period_s=0.126", "controller.period_s = 0.126: .*less than or equal to 0.125"),
        ("safety.station_disarm_s=2", "station_disarm_s = 2.0 must be more than station_neutral_s = 3.0"),
        ("name=Pool 1", "name = 'Pool 1'"),
        ("name=" + "a" * 65, "name = 'aaaaaaaa"),
        ("seed=-1", "seed = -1"),
        ("path.kind=17", "path.kind = 17: must be one of 'circle', 'waypoints'"),
        ("path.kind=square", "path.kind = 'square': must be one of 'circle', 'waypoints'"),
        ('path={kind="waypoints", points_m=[[0, 0]], speed_mps=1}', "path.points_m = .*at least 2"),
        ('path={kind="waypoints", points_m=[[0, 0], [1, 0]], speed_mps=1, start_index=2}', "start_index = 2: .*0 to 1"),
        ("vehicle.battery.warn_v=13", "vehicle.battery: must fall in this order"),
        ("vehicle.legs.position_m=[[0.1,-0.1],[0.1,0.1],[-0.1,-0.1],[-0.2,0.1]]", r"legs: position_m = .*of a rectangle"),
        ("vehicle.legs.position_m=[[0.1,0],[0.1,0],[-0.1,0],[-0.1,0]]", r"legs: position_m = .*of a rectangle"),
        ("vehicle.legs.ankle_us=[2000,1000]", r"vehicle.legs: ankle_us = \[2000, 1000\]: must rise"),
        ("vehicle.thruster.neutral_us=1600", "vehicle.thruster: neutral_us = 1600 must lie in the curve's dead zone"),
        ("vehicle=submarine", "vehicle = 'submarine': no such vehicle .allowed: .*spherical"),
    ],
)
def test_values_that_do_not_go_together(setting: str, complaint: str) -> None:
    with pytest.raises(ConfigError, match=complaint) as caught:
        load_experiment("pool", [setting])
    assert str(EXPERIMENTS / "pool.toml") in str(caught.value) or f"--set {setting}: " in str(caught.value)


WAY = 'path={{kind="waypoints", points_m=[{}], speed_mps=1, {}}}'
SHORT, LONG = ", ".join(30 * ["[0, 0]"]), ", ".join(31 * ["[0, 0]"])
CORNERS = ("[1, 1, 0]", "[1, 0, 0]", "[0, 1, 0]", "[0, 0, {}]")


def _landmarks(*places: str, ids: tuple[int, ...] = (40, 41, 42, 43), depth: str = "0") -> str:
    marks = [f"{{id={number}, position_m={place.format(depth)}}}" for number, place in zip(ids, places, strict=False)]
    return f"landmarks=[{', '.join(marks)}]"


def _changes(*at_s: float) -> str:
    return f"formation.changes=[{', '.join(f'{{at_s={each}, over_s=5.0}}' for each in at_s)}]"


@pytest.mark.parametrize(
    ("allowed", "refused", "complaint"),
    [
        ("safety.pose_neutral_s=0.191", "safety.pose_neutral_s=0.19", "must be more than pose_hold_s = 0.19"),
        ("safety.station_neutral_s=1.01", "safety.station_neutral_s=1.0", "must be more than station_hold_s = 1.0"),
        ("safety.station_disarm_s=3.01", "safety.station_disarm_s=3.0", "must be more than station_neutral_s = 3.0"),
        ("formation.leader=2", "formation.leader=3", r"formation.leader = 3: no such robot \(allowed: 1, 2\)"),
        (_changes(1.0, 6.0), _changes(1.0, 5.9), r"at_s = 5.9: the one before ends at 6 s \(allowed: that or later\)"),
        (
            "formation.changes=[{at_s=1.0, order=[2, 1]}]",
            "formation.changes=[{at_s=1.0, order=[2, 2]}]",
            r"order = \[2, 2\]: \(allowed: each of 1, 2 once",
        ),
        (
            "sim.plant.disturbance_hz=[0.1, 0.2]",
            "sim.plant.disturbance_hz=[0.1, 0.2, 0.3]",
            r"disturbance_hz: 3 values for 2 robots",
        ),
        ("robots.0.neighbours=[2]", "robots.0.neighbours=[1]", "neighbours of robot 1: 1 is not allowed"),
        ("mission.wait_from_m=0.49", "mission.wait_from_m=0.5", "wait_at_m = 0.5 must be more than wait_from_m = 0.5"),
        ("controller.law=my.module:Law_2", "controller.law=my.module", "must be one of 'nmpc', .* or a law of your own"),
        ("controller.law=m:L", "controller.law=1:L", "must be one of 'nmpc', .* or a law of your own"),
        ("controller.estimator.kind=kalman", "controller.estimator.kind=eso", 'the law nmpc needs "kalman"'),
        (
            WAY.format("[0, 0], [1, 0]", "start_index=1"),
            WAY.format("[0, 0], [1, 0]", "start_index=2"),
            r"start_index = 2: no such waypoint \(allowed: 0 to 1\)",
        ),
        (
            WAY.format("[0, 0], [1, 0]", 'corner="stop"'),
            WAY.format("[0, 0], [1, 0]", 'corner="stop", dive_mps=0.01'),
            "dive_mps = 0.01: a path that stops at its corners is level",
        ),
        (WAY.format(SHORT, "laps=1000"), WAY.format(LONG, "laps=1000"), "31 waypoints so often are more than 30000"),
        (_landmarks(*CORNERS), _landmarks(*CORNERS[:3]), "landmarks: 3 cannot place a camera"),
        (_landmarks(*CORNERS), _landmarks(*CORNERS, ids=(40, 41, 42, 40)), "landmarks: id 40 is used twice"),
        (_landmarks(*CORNERS), _landmarks(*CORNERS, ids=(2, 41, 42, 43)), r"id 2 is the marker of robot 2 \(free: 0, 3, 4"),
        (_landmarks(*CORNERS, depth="1.0"), _landmarks(*CORNERS, depth="1.1"), r"id 43 at z = 1.1 lies below the floor"),
    ],
)
def test_a_rule_between_keys_allows_its_edge_and_nothing_beyond(allowed: str, refused: str, complaint: str) -> None:
    size = "pool.size_m.2=1.0"
    load_experiment("pool", [size, allowed])
    with pytest.raises(ConfigError, match=complaint):
        load_experiment("pool", [size, refused])


def test_landmarks_and_check_marks_stand_alone() -> None:
    marks = _landmarks(*CORNERS)
    load_experiment("pool", [marks.replace("landmarks", "check_marks")])
    with pytest.raises(ConfigError, match="check_marks: they check a fixed camera"):
        load_experiment("pool", [marks, "check_marks=[{id=44, position_m=[0, 0, 0]}]"])


def test_the_plant_keeps_step_with_control_or_is_refused() -> None:
    assert load_experiment("pool", ["sim.plant.step_s=0.005"]).plant_steps == 10
    with pytest.raises(ConfigError, match=r"plant.step_s = 0.003: must go into controller.period_s = 0.05 without a rest"):
        assert load_experiment("pool", ["sim.plant.step_s=0.003"]).plant_steps


@pytest.mark.parametrize("formation", ["formation.shape=line", "formation.shape=circle"])
def test_a_formation_by_name_of_no_robots_is_refused_for_the_robots(formation: str) -> None:
    with pytest.raises(ConfigError, match=r"robots = .*at least 1"):
        load_experiment("pool", [formation, "robots=[]"])


def test_a_mistake_in_a_setting_is_told_of_the_setting_and_not_of_the_file() -> None:
    with pytest.raises(ConfigError) as caught:
        load_experiment("pool", ["seed=1", "duration=5", "path.lap_s=-1"])
    lines = str(caught.value).splitlines()
    assert len(lines) == 2
    assert any(line.startswith("--set duration=5: duration: unknown key") for line in lines)
    assert any(line.startswith("--set path.lap_s=-1: path.lap_s = -1") for line in lines)


# --- the hash


def test_a_copy_with_another_value_has_another_hash_and_what_else_follows_from_its_values() -> None:
    pool = load_experiment("pool")
    before = pool.hash, pool.vehicle.inertia.tolist()
    slower = pool.model_copy(update={"duration_s": pool.duration_s - 1.0})
    assert slower.hash == check(Experiment, slower.model_dump(mode="json"), "slower").hash != pool.hash
    assert pool.model_copy(update={}).hash == pool.hash
    heavier = pool.vehicle.mass.model_copy(update={"surge_kg": 2.0 * pool.vehicle.mass.surge_kg})
    assert pool.vehicle.model_copy(update={"mass": heavier}).inertia[0] == 2.0 * before[1][0]
    assert (pool.hash, pool.vehicle.inertia.tolist()) == before


def _mutants(value: object) -> Iterator[object]:
    """Other values of the same type, from near to far."""
    if isinstance(value, bool):
        yield not value
    elif isinstance(value, int):
        yield from (value + 1, value - 1, value + 40, value - 40)
    elif isinstance(value, float):
        yield from (value + 1e-6, value - 1e-6, value * 1.001)
    else:
        yield from ("rotate", "translate", "leader-follower", "virtual-structure", "eso", "pid", "eso-mpc")
        yield from ("point", "trajectory", "start", "end", "h264", "2-1", "go-on", "warn", "apriltag_36h11", "kalman", "other")


def _hash(table: dict[str, Any]) -> str:
    return check(Experiment, table, "mutant.toml").hash


def _accepted(key: Key, value: object) -> str:
    """The hash with another value of a key that the file may have."""
    for mutant in _mutants(value):
        with contextlib.suppress(ConfigError):
            if mutant != value:
                return _hash(_with({key: mutant}))
    pytest.fail(f"no other value of {_dotted(key)} was accepted; give _mutants one")


@by_section
def test_every_value_is_in_the_hash(section: str) -> None:
    before = _hash(FULL)
    for key, value in _leaves(section):
        assert _dotted(key) in TIED or _accepted(key, value) != before, _dotted(key)


@pytest.mark.parametrize(
    "settings",
    [
        ['path={kind="waypoints", points_m=[[0, 0], [1, 0]], speed_mps=0.1}'],
        ["robots.0.id=5", "robots.1.neighbours=[5]"],
        ["robots.1.neighbours=[]"],
        ["controller.law=pid", "controller.estimator.kind=kalman"],
    ],
)
def test_values_tied_together_are_in_the_hash_too(settings: list[str]) -> None:
    assert load_experiment("pool", settings).hash != load_experiment("pool").hash


def _reordered(node: Any) -> Any:
    if isinstance(node, dict):
        return {key: _reordered(node[key]) for key in reversed(node)}
    return [_reordered(item) for item in node] if isinstance(node, list) else node


def _integers(node: Any) -> Any:
    """Whole numbers written without a decimal point."""
    if isinstance(node, dict):
        return {key: _integers(value) for key, value in node.items()}
    if isinstance(node, list):
        return [_integers(item) for item in node]
    return int(node) if isinstance(node, float) and node.is_integer() else node


def test_layout_is_not_in_the_hash(tmp_path: Path) -> None:
    """Order of keys, comments, spelled-out defaults, 3 for 3.0: the same experiment."""
    pool = load_experiment("pool")
    dumped = tomllib.loads(dump_experiment(pool))
    for number, table in enumerate((dumped, _reordered(dumped), _integers(dumped))):
        path = tmp_path / f"pool{number}.toml"
        path.write_text("# the same\n" + tomli_w.dumps(table, indent=number), encoding="utf-8")
        assert load_experiment(str(path)).hash == pool.hash


def test_the_hash_does_not_depend_on_the_process() -> None:
    """A fixed table, a fixed hash: no `hash()`, no set order, nothing of this run."""
    assert load_experiment("pool").hash == load_experiment("pool").hash
    assert len(bytes.fromhex(load_experiment("pool").hash)) == 32


def test_the_vehicle_is_part_of_the_experiment(tmp_path: Path) -> None:
    """The same experiment file beside another vehicle file is another experiment."""
    vehicle = copy.deepcopy(FULL["vehicle"])
    text = (EXPERIMENTS / "pool.toml").read_text().replace('"spherical"', '"mine.toml"')
    (tmp_path / "pool.toml").write_text(text)
    hashes = []
    for mass_kg in (12.0, 12.5):
        vehicle["mass"]["surge_kg"] = mass_kg
        (tmp_path / "mine.toml").write_text(tomli_w.dumps(vehicle))
        hashes.append(load_experiment(str(tmp_path / "pool.toml")).hash)
    assert hashes[0] == load_experiment("pool").hash
    assert hashes[1] != hashes[0]
    (tmp_path / "mine.toml").write_text("name = 3")
    with pytest.raises(ConfigError, match=r"pool\.toml: .*mine\.toml: name = 3"):
        load_experiment(str(tmp_path / "pool.toml"))


def test_the_camera_may_lie_in_a_file_of_its_own(tmp_path: Path) -> None:
    """As `localizer calibrate` writes it: the experiment is the one that has its table, hash and dump included."""
    camera = FULL["camera"]
    written = tomllib.loads((EXPERIMENTS / "pool.toml").read_text(encoding="utf-8"))
    (tmp_path / "pool.toml").write_text(tomli_w.dumps(written | {"camera": "lab.toml"}), encoding="utf-8")
    (tmp_path / "lab.toml").write_text(tomli_w.dumps({"camera": camera}), encoding="utf-8")
    loaded = load_experiment(str(tmp_path / "pool.toml"))
    assert loaded.hash == load_experiment("pool").hash
    (tmp_path / "dump.toml").write_text(dump_experiment(loaded), encoding="utf-8")
    (tmp_path / "other.toml").write_text(
        tomli_w.dumps({"camera": camera | {"position_m": [0.0, 0.0, -2.9]}}), encoding="utf-8"
    )
    moved = load_experiment(str(tmp_path / "pool.toml"), ["camera=other.toml"])
    assert moved.camera.position_m == (0.0, 0.0, -2.9)
    assert moved.hash != loaded.hash
    assert load_experiment(str(tmp_path / "pool.toml"), ["camera.rate_hz=25.0"]).camera.rate_hz == 25.0
    (tmp_path / "lab.toml").unlink()
    assert load_experiment(str(tmp_path / "dump.toml")).hash == loaded.hash


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        (None, r"lab\.toml: no such file"),
        ("camera = 3", r"lab\.toml: camera = 3: must be a table"),
        ("size_px = [640, 480]", r"lab\.toml: camera: missing"),
        ("[camera]\nsize_px = [640, 480]", r"lab\.toml: camera\.position_m: missing"),
        ("[camera]\nfocal = 1", r"lab\.toml: camera\.focal: unknown key"),
    ],
)
def test_a_camera_file_that_cannot_be_used_is_named(tmp_path: Path, content: str | None, complaint: str) -> None:
    written = tomllib.loads((EXPERIMENTS / "pool.toml").read_text(encoding="utf-8"))
    (tmp_path / "pool.toml").write_text(tomli_w.dumps(written | {"camera": "lab.toml"}), encoding="utf-8")
    if content is not None:
        (tmp_path / "lab.toml").write_text(content, encoding="utf-8")
    with pytest.raises(ConfigError, match=rf"pool\.toml: [^\n]*{complaint}"):
        load_experiment(str(tmp_path / "pool.toml"))


def test_a_file_that_a_setting_names_is_looked_for_where_the_person_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`sim-bridge numeric numeric --set vehicle=mine.toml`: not beside the scene's file, where no person puts one."""
    own = load_experiment("pool").vehicle.model_dump(mode="json", exclude_none=True) | {"name": "mine"}
    (tmp_path / "mine.toml").write_text(tomli_w.dumps(own), encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    assert load_experiment("numeric", ["vehicle=mine.toml"]).vehicle.name == "mine"
    heavy = load_experiment("pool", ['vehicle={like="mine.toml", mass={surge_kg=13.0}}']).vehicle
    assert heavy.name == "mine" and heavy.mass.surge_kg == 13.0


def test_a_file_that_a_setting_names_may_lie_beside_the_experiment_where_the_person_has_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    vehicle = load_experiment("pool").vehicle.model_dump(mode="json", exclude_none=True)
    for folder in ("here", "beside"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "mine.toml").write_text(tomli_w.dumps(vehicle | {"name": folder}), encoding="utf-8")
    scene = tmp_path / "beside" / "scene.toml"
    scene.write_text(dump_experiment(load_experiment("numeric").model_copy(update={"name": "scene"})), encoding="utf-8")
    monkeypatch.chdir(tmp_path / "here")
    assert load_experiment(str(scene), ["vehicle=mine.toml"]).vehicle.name == "here"
    (tmp_path / "here" / "mine.toml").unlink()
    assert load_experiment(str(scene), ["vehicle=mine.toml"]).vehicle.name == "beside"


def test_a_camera_has_no_shipped_names() -> None:
    with pytest.raises(ConfigError, match=r"--set camera=lab: camera = 'lab': must be a table, or a path ending in \.toml"):
        load_experiment("pool", ["camera=lab"])


def test_a_vehicle_may_be_like_another() -> None:
    """As in numeric.toml: the file's vehicle with what stands in the table; everything else as it is, settings on top."""
    like = load_experiment("numeric").vehicle
    base = load_experiment("pool").vehicle
    assert (like.thruster.lag_s, like.thruster.dead_time_s, required(like.legs).ankle_dead_time_s) == (0.0, 0.0, 0.0)
    assert (like.thruster.curve, like.mass, required(like.legs).position_m) == (
        base.thruster.curve,
        base.mass,
        required(base.legs).position_m,
    )
    assert load_experiment("numeric", ["vehicle.mass.surge_kg=13"]).vehicle.mass.surge_kg == 13.0
    assert load_experiment("numeric", ["vehicle=spherical"]).vehicle.model_dump() == base.model_dump()
    heavy = load_experiment("pool", ['vehicle={like="spherical", mass={surge_kg=13.0}}']).vehicle
    assert heavy.model_dump() == base.model_dump() | {"mass": base.mass.model_dump() | {"surge_kg": 13.0}}
    with pytest.raises(ConfigError, match=r"vehicle\.mass\.surge: unknown key"):
        load_experiment("pool", ['vehicle={like="spherical", mass={surge=13.0}}'])
    with pytest.raises(ConfigError, match=r"vehicle = 'submarine': no such vehicle"):
        load_experiment("pool", ['vehicle={like="submarine"}'])


# --- settings and names


def test_settings_lie_over_the_file_in_their_order() -> None:
    pool = load_experiment("pool", ["seed=7", "sim.plant.current_mps=[0.014, 0, 0]", "seed=8", "vehicle.mass.surge_kg=13"])
    assert (pool.seed, pool.sim.plant.current_mps, pool.vehicle.mass.surge_kg) == (8, (0.014, 0.0, 0.0), 13.0)
    again = load_experiment("pool", ["vehicle.mass.surge_kg=13", "vehicle=spherical"])
    assert again.vehicle.mass.surge_kg == 12.0


def test_names_and_paths() -> None:
    assert experiment_path("pool") == EXPERIMENTS / "pool.toml"
    assert experiment_path("somewhere/mine.toml") == Path("somewhere/mine.toml")
    complaint = r"experiment 'pol': no such experiment; did you mean pool\? \(allowed: .*pool.*, or a path"
    with pytest.raises(ConfigError, match=complaint):
        load_experiment("pol")


@pytest.mark.parametrize("path", sorted(EXPERIMENTS.glob("*.toml")), ids=lambda path: path.stem)
def test_every_shipped_experiment_loads(path: Path) -> None:
    experiment = load_experiment(path.stem)
    assert experiment.name == path.stem
    assert isinstance(experiment.vehicle, Vehicle)
    assert experiment.robot(experiment.robot_ids[0]).id == experiment.robot_ids[0]
    assert experiment.nodes_m().shape == (len(experiment.robots), 3)


def test_an_unknown_robot_is_refused_by_name() -> None:
    with pytest.raises(ConfigError, match=r"robot 5: not in experiment 'pool' \(allowed: 1, 2\)"):
        load_experiment("pool").robot(5)


def test_a_marker_is_the_robots_number_unless_told_otherwise() -> None:
    robots = load_experiment("pool", ["robots.0.marker_id=9", "formation.scale=2"])
    assert [robot.marker for robot in robots.robots] == [9, 2]
    assert robots.nodes_m().tolist() == [[0.8, 0.0, 0.0], [-0.8, 0.0, 0.0]]


def test_the_shipped_rates_are_the_articles_steps_to_the_last_bit() -> None:
    assert load_experiment("pool").wrench_step == (0.3, 0.3, 0.1)


FEW = "controller.mpc.blocks=[1,2,3]"


def test_horizon_and_blocks_that_nobody_gives_are_the_same_in_time_at_every_rate() -> None:
    usual = load_experiment("pool").controller
    for period_s in (0.1, 0.04, 0.02, 0.0125):
        mpc = load_experiment("pool", [f"controller.period_s={period_s}", "sim.plant.step_s=0.0025"]).controller.mpc
        assert mpc.horizon * period_s == pytest.approx(usual.mpc.horizon * usual.period_s, abs=period_s)
        ends_s = period_s * np.cumsum(mpc.blocks)
        assert len(set(ends_s)) >= 5
        for end_s in usual.period_s * np.cumsum(usual.mpc.blocks):
            assert np.abs(ends_s - end_s).min() <= 0.5 * period_s + 1e-9
    given = load_experiment("pool", ["controller.period_s=0.1", "controller.mpc.horizon=30", FEW]).controller.mpc
    assert (given.horizon, given.blocks) == (30, (1, 2, 3))
    recorded = dump_experiment(load_experiment("pool", ["controller.period_s=0.1", "controller.mpc.horizon=50"]))
    assert tomllib.loads(recorded)["controller"]["mpc"]["horizon"] == 50


@pytest.mark.parametrize(
    ("period_s", "horizon", "blocks"),
    [(0.02, 30, (2, 3, 5, 8, 10, 2)), (0.05, 10, (1, 1, 2, 3, 3)), (0.05, 4, (1, 1, 2)), (0.05, 15, (1, 1, 2, 3, 4, 4))],
)
def test_blocks_that_nobody_gives_end_with_a_given_horizon(period_s: float, horizon: int, blocks: tuple[int, ...]) -> None:
    mpc = load_experiment("pool", [f"controller.period_s={period_s}", f"controller.mpc.horizon={horizon}"]).controller.mpc
    assert (mpc.horizon, mpc.blocks) == (horizon, blocks)


def test_a_step_may_fail_to_come_without_the_board_disarming() -> None:
    load_experiment("pool", ["controller.period_s=0.04", "sim.board.neutral_after_s=0.08"])
    with pytest.raises(ConfigError, match=r"controller.period_s = 0.05: .*neutral_after_s = 0.08 s .*allowed: up to 0.04"):
        load_experiment("pool", ["sim.board.neutral_after_s=0.08"])


def test_a_safety_distance_smaller_than_the_hull_is_refused() -> None:
    """Whichever of the two was changed: plans, right of way and reports all count from safety.radius_m."""
    assert load_experiment("pool", ["safety.radius_m=0.15"]).vehicle.radius_m == 0.15
    for setting, wrong in (
        ("safety.radius_m=0.149", r"0.149: .* within 0.298 m .*0.15"),
        ("vehicle.radius_m=0.35", "0.3: .*0.35"),
    ):
        with pytest.raises(ConfigError, match=rf"safety.radius_m = {wrong} touch at .*allowed: from"):
            load_experiment("pool", [setting])


def test_a_neighbours_plan_does_not_count_when_all_of_it_is_past() -> None:
    """While it counts, a silent neighbour has no bubble that grows, and is taken to yield."""
    load_experiment("pool", ["safety.plan_max_age_s=2.5"])
    load_experiment("pool", ["controller.mpc.horizon=5", "controller.mpc.blocks=[1,4]"])  # as runs were flown
    for settings in (["safety.plan_max_age_s=2.6"], ["safety.plan_max_age_s=1.3", "controller.law=eso-mpc-article"]):
        with pytest.raises(
            ConfigError, match=r"safety.plan_max_age_s = (2.6|1.3): a plan reaches .*allowed: up to (2.5|1.25)"
        ):
            load_experiment("pool", settings)


def test_a_slip_of_the_pen_is_answered_once_with_what_was_meant(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A key, a shipped experiment, a file without its ending; and a fault of the command line is not the file's."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "lab.toml").write_text("", encoding="utf-8")
    for name, settings, faults, answer in (
        ("poool", [], [], "no such experiment; did you mean pool?"),
        ("lab", [], [], "no such experiment; did you mean lab.toml?"),
        ("pool", ["duraton_s=3"], [], "duraton_s: unknown key; did you mean duration_s?"),
        ("pool", [], ["t=3 thruser dead"], "--fault 't=3 thruser dead': sim.faults.0: what = 'thruser dead'"),
    ):
        with pytest.raises(ConfigError) as refused:
            load_experiment(name, settings, faults)
        assert answer in str(refused.value) and str(EXPERIMENTS) not in str(refused.value)
    with pytest.raises(ConfigError) as shapeless:
        load_experiment("numeric", ["formation.shape=trinagle"])
    assert str(shapeless.value).count("\n") == 0 and "'triangle'" in str(shapeless.value)
