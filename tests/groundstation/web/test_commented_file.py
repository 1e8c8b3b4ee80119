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


ARTICLE = "controller.law=eso-mpc-article"


@pytest.mark.parametrize(
    ("name", "settings"),
    [
        *((name, ()) for name in NAMES),
        ("pool", (ARTICLE,)),
        ("pool", (ARTICLE, "controller.estimator.kind=kalman", "controller.estimator.sway=true", "controller.mpc.horizon=50")),
        ("pool", (ARTICLE, "controller.mpc.r=[0.05,0.05,8.0]", "controller.mpc.blocks=[1,1,2,3,4,4]")),
        ("pool", ("controller.period_s=0.1", "controller.mpc.horizon=50")),
        ("pool", ("vehicle.battery.cells=4", "sim.plant.battery.curve_v=12.0", "sim.sensors.battery_v=12.4")),
        ("pool", ("vehicle.righting.moment_nm=3.0", "sim.plant.tilt.righting_nm=1.9", "formation.shape=line")),
    ],
)
def test_a_written_file_is_the_same_experiment(name: str, settings: tuple[str, ...], tmp_path: Path) -> None:
    """Also where a key has the usual value, and a file without it would have another."""
    experiment = load_experiment(name, settings)
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
