"""SHELL: what simulated boards keep without power: a folder with robot-N.json, and robot-N.key where links are signed."""

import json
from collections.abc import Callable
from pathlib import Path

from sim_bridge.thruster_board.board import Board, Kept
from wire.config.experiment import Experiment
from wire.mavlink.signing_key import load_key, write_key
from wire.toml_loader import ConfigError, os_errors_as_config_errors

MakeBoard = Callable[[Experiment, int, int], Board]  # of an experiment, for a robot, with a seed


def boards_in(folder: Path) -> MakeBoard:
    """Boards with their memory in a folder, which is made if it is not there. Raises ConfigError."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"{folder}: no folder for what boards keep: {error.strerror}") from None

    def make(experiment: Experiment, robot: int, seed: int) -> Board:
        key, memory = folder / f"robot-{robot}.key", folder / f"robot-{robot}.json"
        signing = load_key(key) if key.exists() else None
        return Board(experiment, robot, seed, signing, _read(memory), lambda kept: _write(memory, key, kept))

    return make


def _read(memory: Path) -> Kept:
    if not memory.exists():
        return Kept()
    try:
        found = json.loads(memory.read_text(encoding="utf-8"))
        parameters = {str(name): float(value) for name, value in found["parameters"].items()}
        return Kept(parameters, int(found["heard"]), int(found["sent"]))
    except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
        raise ConfigError(f"{memory}: not what a board keeps: {error} (delete it for a board as new)") from None


def _write(memory: Path, key: Path, kept: Kept) -> None:
    new, told = memory.with_suffix(".new"), {"parameters": dict(kept.parameters), "heard": kept.heard, "sent": kept.sent}
    with os_errors_as_config_errors(memory):
        new.write_text(json.dumps(told, indent=1) + "\n", encoding="utf-8")
        new.replace(memory)
        if kept.key is not None and not (key.exists() and load_key(key).secret == kept.key.secret):
            write_key(key, kept.key)
