"""Tuning as a command: gains come back as a section of an experiment file that can be flown."""

import tomllib
from typing import get_args

import numpy as np
import pytest

from sim_bridge.studies.gain_tuning import Tuned, values, with_gains
from wire.config.baseline_controllers import LawName
from wire.config.experiment import load_experiment

FEEDBACK = [law.replace("-", "_") for law in get_args(LawName) if law != "eso-mpc"]
CONTROLLER = load_experiment("pool").controller


@pytest.mark.parametrize("name", FEEDBACK)
def test_gains_go_out_and_come_back_in_the_order_of_the_section(name: str) -> None:
    section = getattr(CONTROLLER, name)
    gains = np.array(values(section))
    assert with_gains(section, gains) == section and np.all(gains > 0.0)
    changed = with_gains(section, gains * np.arange(1, len(gains) + 1))
    np.testing.assert_allclose(values(changed), gains * np.arange(1, len(gains) + 1))
    assert type(changed) is type(section) and changed.guidance_per_s2 == section.guidance_per_s2


@pytest.mark.parametrize("name", FEEDBACK)
def test_what_is_printed_is_a_section_of_an_experiment_file(name: str) -> None:
    section = getattr(CONTROLLER, name)
    changed = with_gains(section, 1.5 * np.array(values(section)))
    table = tomllib.loads(Tuned(name.replace("_", "-"), 0.0, 0.0, changed.model_dump()).toml())
    assert list(table) == ["controller"] and list(table["controller"]) == [name]
    flown = load_experiment("pool", [f"controller.{name}.{key}={value}" for key, value in table["controller"][name].items()])
    assert getattr(flown.controller, name) == changed
