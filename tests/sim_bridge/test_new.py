"""`sim-bridge new` writes a file that loads, and writes over none."""

import json
import tomllib
from pathlib import Path
from urllib.parse import urlparse
from urllib.request import url2pathname

import jsonschema
import pytest
from typer.testing import CliRunner

from shoal.config.experiment import NO_CAMERA, load_experiment
from shoal.errors import ConfigError
from sim_bridge.__main__ import cli


def test_a_new_experiment_loads_and_keeps_the_schema_that_it_names(tmp_path: Path) -> None:
    assert CliRunner().invoke(cli, ["new", "lab-2", "--out", str(tmp_path)]).exit_code == 0
    file = tmp_path / "lab-2.toml"
    text = file.read_text(encoding="utf-8")
    loaded = load_experiment(str(file), [NO_CAMERA])
    assert (loaded.name, loaded.robot_ids) == ("lab-2", (1, 2, 3))
    schema = json.loads(
        Path(url2pathname(urlparse(text.partition("\n")[0].removeprefix("#:schema ")).path)).read_text(encoding="utf-8")
    )
    jsonschema.validate(tomllib.loads(text), schema)


def test_a_file_that_is_there_stays_as_it_is(tmp_path: Path) -> None:
    (tmp_path / "lab.toml").write_text("mine")
    refused = CliRunner().invoke(cli, ["new", "lab", "--out", str(tmp_path)]).exception
    assert isinstance(refused, ConfigError) and "lab.toml: is there already" in str(refused)
    assert (tmp_path / "lab.toml").read_text() == "mine"


@pytest.mark.parametrize("name", ["Lab", "a/b", "", "x" * 65, "lab.toml"])
def test_a_name_that_no_experiment_may_have_is_refused(name: str, tmp_path: Path) -> None:
    done = CliRunner().invoke(cli, ["new", name, "--out", str(tmp_path)])
    assert done.exit_code == 2 and list(tmp_path.iterdir()) == []


def test_a_folder_that_is_not_there_is_named(tmp_path: Path) -> None:
    refused = CliRunner().invoke(cli, ["new", "lab", "--out", str(tmp_path / "nowhere")]).exception
    assert isinstance(refused, ConfigError) and "nowhere" in str(refused)
