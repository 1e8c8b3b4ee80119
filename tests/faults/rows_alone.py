"""SHELL: faults that need no flying lab: crossings before the localizer, a bad link in lockstep, configurations."""

import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import tomli_w

from shoal.config.experiment import Experiment, load_experiment
from shoal.config.loader import check
from shoal.errors import ConfigError
from tests.faults import targets
from tests.faults.row import Random, Sample
from tests.localizer.encounters import check_encounter

MODULES = ("groundstation", "robot_agent", "localizer", "sim_bridge")
NO_VALUES: tuple[Any, ...] = ("nonsense", -1e9, True, [], {}, float("nan"), float("inf"), 10**30)
LOSSY_S = 60


def identity_swap(rig: None, random: Random) -> Sample:
    try:
        check_encounter(int(random.integers(1 << 30)))
    except AssertionError:
        return {"undetected swaps": 1.0}
    return {"undetected swaps": 0.0}


def not_finite(rig: None, random: Random) -> Sample:
    try:
        targets.agent(random.bytes(600))
    except AssertionError:
        return {"bad pulses, or beliefs": 1.0}
    return {"bad pulses, or beliefs": 0.0}


def stranger(rig: None, random: Random) -> Sample:
    return {"let in, heard or obeyed": _failed("tests/shoal/transport/test_guarded.py")}


def old_traffic(rig: None, random: Random) -> Sample:
    return {
        "obeyed": _failed("tests/shoal/transport/test_replay.py")
        + _failed("tests/shoal/transport/test_command_deduplication.py")
    }


def _failed(tests: str) -> float:
    """The number of these tests that fail. They use real sessions, certificates and processes."""
    ran = subprocess.run([sys.executable, "-m", "pytest", "-q", tests], capture_output=True, text=True, check=False)
    if ran.returncode not in (0, 1):
        raise RuntimeError(f"{tests}: {ran.stdout[-500:]}{ran.stderr[-500:]}")
    return float(ran.stdout.count("FAILED ") + ran.stdout.count("ERROR ")) if ran.returncode else 0.0


# --- a bad link


def lossy_network(rig: None, random: Random) -> Sample:
    seed = int(random.integers(1 << 30))
    faults = [f"t=0 link {robot} noisy 0.1" for robot in load_experiment("pool").robot_ids]
    return {"RMS error over that without": _rms_m(seed, faults) / _rms_m(seed, [])}


def _rms_m(seed: int, faults: list[str]) -> float:
    """The worst robot's and axis' RMS error after 20 s, of a lockstep run."""
    with tempfile.TemporaryDirectory() as out:
        command = ["sil", "pool", "--no-web", "--lockstep", "--seed", str(seed), "--duration", str(LOSSY_S), "--out", out]
        for fault in faults:
            command += ["--fault", fault]
        subprocess.run([sys.executable, "-m", "sim_bridge", *command], capture_output=True, check=False)
        (result,) = Path(out).glob("*/result.json")
        robots = json.loads(result.read_text(encoding="utf-8"))["robots"]
    return max(float(value) for row in robots.values() for value in row["rms_after_20s_m"][:2])


# --- a bad configuration


def bad_configuration(rig: None, random: Random) -> Sample:
    """One value somewhere in the whole file becomes one that cannot be, or a key is misspelt."""
    table = load_experiment("pool").model_dump(mode="json", exclude_none=True)
    path = spoil(table, random)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "spoilt.toml"
        file.write_text(tomli_w.dumps(table), encoding="utf-8")
        module = str(random.choice(MODULES))
        arguments = {"robot_agent": ["run", str(file), "--robot", "1"], "sim_bridge": ["pool", str(file)]}
        begin_s = time.monotonic()
        try:
            ran = subprocess.run(
                [sys.executable, "-m", module, *arguments.get(module, ["run", str(file)])],
                capture_output=True, text=True, timeout=10, check=False, cwd=folder,
                env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
            )  # fmt: skip
        except subprocess.TimeoutExpired:
            return {"started, or not explained": 1.0}
        explained = ran.returncode == 2 and str(file) in ran.stderr and path in ran.stderr and "Traceback" not in ran.stderr
        return {"refused after": time.monotonic() - begin_s, "started, or not explained": float(not explained)}


def spoil(table: dict[str, Any], random: Random) -> str:
    """Spoil one leaf of a table, in place; returns what the complaint must name. Draws until it has a leaf that may not be
    anything (a text may be)."""
    while True:
        node: Any = table
        path: list[str] = []
        while isinstance(node, dict | list) and node:
            parent = node
            keys: list[Any] = list(node) if isinstance(node, dict) else list(range(len(node)))
            key = keys[int(random.integers(len(keys)))]
            path.append(str(key))
            node = node[key]
        if isinstance(node, str):
            continue
        kept = [value for value in NO_VALUES if type(value) is not type(node) or isinstance(value, int | float)]
        parent[key] = kept[int(random.integers(len(kept)))]
        if _still_valid(table):
            parent[key] = node
            continue
        return path[0]


def _still_valid(table: dict[str, Any]) -> bool:
    """-1e9 is a fine coordinate, and True a fine switch."""
    try:
        check(Experiment, table, "spoilt")
    except ConfigError:
        return False
    return True
