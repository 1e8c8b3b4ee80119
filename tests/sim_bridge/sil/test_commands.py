"""What can keep a run from being one."""

import pytest

from sim_bridge.sil.commands import Way, check
from wire.config.experiment import load_experiment
from wire.toml_loader import ConfigError


@pytest.mark.parametrize(
    ("name", "settings", "complaint"),
    [
        ("islands", (), "camera.position_m.2 = -32: from there markers are 3 pixels wide"),
        ("numeric-disturbed", (), "localizer.uses_camera = false: no camera locates these robots"),
    ],
)
def test_who_cannot_be_seen_flies_without_the_camera_or_not_at_all(
    name: str, settings: tuple[str, ...], complaint: str
) -> None:
    experiment = load_experiment(name, settings)
    check(experiment, Way(poses=True))
    with pytest.raises(ConfigError, match=f"{complaint}.*--poses"):
        check(experiment, Way())
