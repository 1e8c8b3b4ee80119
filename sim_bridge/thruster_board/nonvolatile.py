"""SHELL: nonvolatile memory of simulated boards: a folder with robot-N.json, and robot-N.key for a signed link."""

import json
import math
from collections.abc import Callable
from dataclasses import astuple
from pathlib import Path

from shoal.config.experiment import Experiment
from shoal.errors import ConfigError, os_errors_as_config_errors
from shoal.mavlink.signing_key import load_key, write_key
from shoal.runtime.output_files import replace_text
from shoal.system.regular_files import read_regular
from sim_bridge.thruster_board.board import NonvolatileState, ThrusterBoard
from sim_bridge.thruster_board.sensor_zero import Zeros

MOST_BYTES = 1_000_000  # of a board's memory

BoardFactory = Callable[[Experiment, int, int], ThrusterBoard]  # of an experiment, for a robot, with a seed


def boards_in(folder: Path) -> BoardFactory:
    """A factory of boards with their memory in a folder, which is made if it does not exist. Raises ConfigError."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"{folder}: no folder for what boards keep: {error.strerror}") from None

    def make(experiment: Experiment, robot: int, seed: int) -> ThrusterBoard:
        key, memory = folder / f"robot-{robot}.key", folder / f"robot-{robot}.json"
        signing = load_key(key) if key.exists() else None
        return ThrusterBoard(experiment, robot, seed, signing, _read(memory), lambda stored: _write(memory, key, stored))

    return make


def _read(memory: Path) -> NonvolatileState:
    """The state that a board has kept in its file; a new board's if there is none. Raises ConfigError."""
    if not memory.exists():
        return NonvolatileState()
    try:
        fields = json.loads(read_regular(memory, MOST_BYTES))
        parameters = {str(name): float(value) for name, value in fields["parameters"].items()}
        if not all(map(math.isfinite, parameters.values())):
            raise ValueError("a parameter is no finite number")
        zeros = Zeros(*map(float, fields["zeros"])) if fields.get("zeros") else None
        return NonvolatileState(parameters, int(fields["heard"]), int(fields["sent"]), zeros=zeros)
    except (OSError, ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        raise ConfigError(f"{memory}: not what a board keeps: {error} (delete it for a board as new)") from None


def _write(memory: Path, key: Path, stored: NonvolatileState) -> None:
    """Write a board's memory, and its key if that is a new one. Raises ConfigError."""
    zeros = None if stored.zeros is None else list(astuple(stored.zeros))
    fields = {"parameters": dict(stored.parameters), "heard": stored.heard, "sent": stored.sent, "zeros": zeros}
    with os_errors_as_config_errors(memory):
        replace_text(memory, json.dumps(fields, indent=1, allow_nan=False) + "\n", durable=False)
        if stored.key is not None and not (key.exists() and load_key(key).secret == stored.key.secret):
            write_key(key, stored.key)
