"""SHELL: a recorded run for scripts: its result, and its messages as tables of named columns."""

import json
from functools import cached_property
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from groundstation.export import tables
from groundstation.logs.run_folders import MOST_JSON_BYTES
from shoal.config.experiment import Experiment, load_experiment
from shoal.errors import ConfigError
from shoal.messages.topics import TOPICS, Topic
from shoal.system.regular_files import read_regular


class FlownRun:
    """The folder of a run."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    @cached_property
    def experiment(self) -> Experiment:
        """The experiment as it was flown."""
        return load_experiment(str(self.folder / "experiment.toml"))

    @cached_property
    def result(self) -> dict[str, Any]:
        """The content of result.json (groundstation/analysis/results.py names its keys); evaluated if it is not there."""
        file = self.folder / "result.json"
        if not file.exists():
            from groundstation.report.report import write_report  # brings matplotlib

            write_report(self.folder)
        content: dict[str, Any] = json.loads(read_regular(file, MOST_JSON_BYTES))
        return content

    @property
    def passed(self) -> bool:
        """True if every limit of the experiment held."""
        return bool(self.result["passed"])

    def table(self, topic: str, robot: int = 0) -> dict[str, NDArray[Any]]:
        """All messages of a topic as columns, named as `groundstation log export` names them. `time_s` is 0 where the report's
        is. Missing numbers are NaN. `pandas.DataFrame` takes it as it is. Topics of a robot go by their last part:
        `table("state", robot=2)`. Raises ConfigError for an unknown topic, a robot that the experiment lacks, or an
        empty log."""
        recorded = _topic(topic)
        of_robots = "{robot}" in recorded.name
        robots = self.experiment.robot_ids if of_robots else (0,)
        if robot not in robots:
            allowed = f"allowed: {', '.join(map(str, robots))}" if of_robots else "it is one table for all: leave `robot` out"
            raise ConfigError(f"table({topic!r}): no such robot {robot} ({allowed})")
        return tables.table(self.folder / "run.mcap", recorded, robot)


def _topic(name: str) -> Topic:
    topics_by_name = {topic.name.removeprefix("robot/{robot}/"): topic for topic in TOPICS if topic.recorded}
    if name not in topics_by_name:
        raise ConfigError(f"topic {name!r}: no such recorded topic (allowed: {', '.join(topics_by_name)})")
    return topics_by_name[name]


def open_run(folder: str | Path) -> FlownRun:
    """Open the folder of a run. Raises ConfigError if it holds no log."""
    place = Path(folder)
    if not (place / "run.mcap").is_file():
        raise ConfigError(f"{place}: no run.mcap there")
    return FlownRun(place)
