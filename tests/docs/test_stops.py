"""docs/stops.md names every reason for which a robot holds or stops, and every remedy that an alarm gives."""

import ast
import inspect
from collections.abc import Iterator
from pathlib import Path

import pytest

from groundstation import telemetry
from robot_agent.safety.modes import REACTIONS

PAGE = " ".join((Path(__file__).parents[2] / "docs" / "stops.md").read_text(encoding="utf-8").split())
MEANT_FOR_ITSELF = {"emergency stop", "station lost"}  # their own sections, and a robot that is only disarmed


def remedies() -> Iterator[str]:
    """Constant remedies of alarms: the fifth value of each finding, or a variable of that name."""
    for node in ast.walk(ast.parse(inspect.getsource(telemetry))):
        value = None
        if isinstance(node, ast.Yield) and isinstance(node.value, ast.Tuple) and len(node.value.elts) == 5:
            value = node.value.elts[4]
        elif isinstance(node, ast.Assign) and getattr(node.targets[0], "id", "") in ("remedy", "DEPLOY"):
            value = node.value
        if isinstance(value, ast.Constant) and value.value:
            yield str(value.value)


@pytest.mark.parametrize("reason", [r.reason for r in REACTIONS if r.reason not in MEANT_FOR_ITSELF])
def test_each_reason_of_a_robot_is_explained(reason: str) -> None:
    assert reason in PAGE


@pytest.mark.parametrize("remedy", sorted(set(remedies())))
def test_each_remedy_of_an_alarm_is_on_the_page(remedy: str) -> None:
    assert remedy in PAGE
