"""Keys are found by their names and by what they mean."""

import json
from typing import Any

import pytest
from typer.testing import CliRunner

from groundstation.__main__ import cli
from shoal.config.experiment import load_experiment


def found(*arguments: str) -> list[dict[str, Any]]:
    entries: list[dict[str, Any]] = json.loads(CliRunner().invoke(cli, ["keys-of", *arguments, "--json"]).stdout)
    return entries


@pytest.mark.parametrize(
    ("pattern", "key"),
    [
        ("horizon", "controller.mpc.horizon"),
        ("move blocking", "controller.mpc.blocks"),
        (r"^sim\.plant\.gust", "sim.plant.gust_s"),
        ("ANKLE", "vehicle.legs.ankle_rate_radps"),
    ],
)
def test_a_word_of_the_name_or_the_meaning_finds_a_key(pattern: str, key: str) -> None:
    entries = {entry["name"]: entry for entry in found(pattern)}
    assert key in entries
    load_experiment("pool", [entries[key]["example"]])


def test_without_a_pattern_every_key_is_told_with_its_range_and_default() -> None:
    entries = {entry["name"]: entry for entry in found()}
    assert len(entries) > 200
    horizon = entries["controller.mpc.horizon"]
    assert (horizon["allowed"], horizon["default"], horizon["live"]) == (">= 2 and <= 200", "50", False)
    assert (entries["pool.size_m"]["type"], entries["pool.size_m"]["allowed"]) == ("list of 3 numbers", "each > 0")
    text = CliRunner().invoke(cli, ["keys-of", r"mpc\.q$"]).stdout
    assert "controller.mpc.q  (live)" in text and "--set controller.mpc.q=[" in text


def test_a_word_that_no_key_has_and_a_broken_pattern_are_told() -> None:
    nothing = CliRunner().invoke(cli, ["keys-of", "submarine"])
    assert nothing.exit_code == 1 and "submarine: no key" in nothing.output
    assert CliRunner().invoke(cli, ["keys-of", "("]).exit_code == 2
