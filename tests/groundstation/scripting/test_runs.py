"""Tables of a flown run for scripts: a wrong name or robot is refused with what there is, never answered by an empty table."""

from pathlib import Path

import pytest

from groundstation.scripting.runs import FlownRun, open_run
from shoal.errors import ConfigError
from tests.groundstation.synthetic import write_run


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> FlownRun:
    folder = tmp_path_factory.mktemp("run")
    write_run(folder)
    return open_run(folder)


def test_tables_of_robots_and_of_all_have_rows(run: FlownRun) -> None:
    assert len(run.table("state", robot=2)["time_s"]) > 100
    assert len(run.table("sim/truth")["time_s"]) > 100


@pytest.mark.parametrize(
    ("topic", "robot", "text"),
    [
        ("state", 0, r"no such robot 0 \(allowed: 1, 2\)"),
        ("state", 3, r"no such robot 3 \(allowed: 1, 2\)"),
        ("sim/truth", 1, r"no such robot 1 \(it is one table for all"),
        ("states", 1, "no such recorded topic"),
    ],
)
def test_a_table_that_there_is_not_is_refused(run: FlownRun, topic: str, robot: int, text: str) -> None:
    with pytest.raises(ConfigError, match=text):
        run.table(topic, robot)


def test_a_folder_without_a_log_is_no_run(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"no run\.mcap there"):
        open_run(tmp_path)


def test_a_table_of_a_cut_log_warns(run: FlownRun, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    whole = (run.folder / "run.mcap").read_bytes()
    (tmp_path / "run.mcap").write_bytes(whole[: whole.index(b"recorder") - 20])
    (tmp_path / "experiment.toml").write_bytes((run.folder / "experiment.toml").read_bytes())
    assert len(open_run(tmp_path).table("state", robot=2)["time_s"]) > 100
    assert "Cut log: run.mcap ends before its run does" in caplog.text
