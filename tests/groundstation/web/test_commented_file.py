"""Files that people read say the same as the experiments that they are written from."""

import json
import tomllib
from pathlib import Path
from urllib.parse import urlparse
from urllib.request import url2pathname

import jsonschema
import pytest

from groundstation.web.commented_file import commented
from shoal.config.experiment import EXPERIMENTS, load_experiment

NAMES = sorted(path.stem for path in EXPERIMENTS.glob("*.toml"))


@pytest.mark.parametrize("name", NAMES)
def test_a_written_file_is_the_same_experiment(name: str, tmp_path: Path) -> None:
    experiment = load_experiment(name)
    file = tmp_path / "again.toml"
    text = commented(experiment)
    file.write_text(text, encoding="utf-8")
    again = load_experiment(str(file))
    assert again.model_dump() == experiment.model_dump()
    assert again.hash == experiment.hash
    schema = Path(url2pathname(urlparse(text.partition("\n")[0].removeprefix("#:schema ")).path))
    jsonschema.validate(tomllib.loads(text), json.loads(schema.read_text(encoding="utf-8")))


def test_a_written_file_has_meanings_shapes_and_no_defaults() -> None:
    experiment = load_experiment(
        "pool",
        ["formation.shape=line", "formation.spacing_m=0.9", "robots.0.node_m=[-0.45,0,0]", "robots.1.node_m=[0.45,0,0]"],
    )
    text = commented(experiment)
    assert 'vehicle = "spherical"' in text
    assert 'shape = "line"' in text
    assert "node_m = " not in text
    assert "diameter_m = 0.45  # Diameter of the formation centre's circle." in text
    assert text.count("# Start, from the first reference") == 1
    assert "[controller" not in text
