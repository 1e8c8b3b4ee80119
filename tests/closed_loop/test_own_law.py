"""A control law from outside the project, by the example of docs/baselines.md."""

import re
from pathlib import Path

import numpy as np
import pytest

from shoal.config.experiment import Experiment, load_experiment
from shoal.errors import ConfigError
from tests.flights.scene_flights import flown

PAGE = Path(__file__).parents[2] / "docs" / "baselines.md"


def own(law: str, *settings: str) -> Experiment:
    return load_experiment("numeric", ["duration_s=25", f"controller.law={law}", *settings])


@pytest.fixture
def ownlaw(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (code,) = re.findall(r"```python\n(class Pd.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    (tmp_path / "ownlaw.py").write_text(code + "\n\nnumber = 3\n", encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)


@pytest.mark.long
@pytest.mark.usefixtures("ownlaw")
def test_the_example_of_the_docs_flies_by_its_own_numbers() -> None:
    worst_m = []
    for numbers in ("[2.0,6.0]", "[0.5,6.0]"):
        flight = flown(own("ownlaw:Pd", f"controller.own={numbers}"))
        worst_m.append(float(np.abs(flight.error[400:, :, :2]).max()))
    assert worst_m[0] < 0.05 and worst_m[1] > 0.2, worst_m


@pytest.mark.usefixtures("ownlaw")
@pytest.mark.parametrize(
    ("law", "complaint"),
    [
        ("nowhere:Pd", "controller.law = 'nowhere:Pd': No module named 'nowhere' .install its package where the agent runs"),
        ("ownlaw:Pid", "controller.law = 'ownlaw:Pid': module 'ownlaw' has no attribute 'Pid'"),
        ("ownlaw:number", "controller.law = 'ownlaw:number': must name a class or a function"),
        ("own law", "controller.law = 'own law': must be one of 'nmpc', .*or a law of your own: MODULE:NAME"),
    ],
)
def test_a_law_that_is_not_there_is_refused_by_name(law: str, complaint: str) -> None:
    with pytest.raises(ConfigError, match=complaint):
        flown(own(law))
