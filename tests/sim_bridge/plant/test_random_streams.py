"""Random numbers of one seed: no two uses share theirs."""

import ast
from itertools import product
from pathlib import Path

import numpy as np

import sim_bridge
from sim_bridge.plant.random_streams import Stream, generator

ROBOTS = range(1, 50)
MEMBERS: dict[Stream, list[tuple[int, ...]]] = {
    Stream.SENSORS: [(robot,) for robot in ROBOTS],
    Stream.CAMERA: [(0,), (2,), (3,), *((1, shade) for shade in range(49))],
    Stream.LINK: list(product(ROBOTS, (0, 1))),
    Stream.DRAWS: [(index,) for index in range(100)],
}


def test_no_two_uses_of_a_seed_share_their_numbers() -> None:
    """Also those that differ in zeros at the end only, which numpy pads with."""
    uses = [(stream, member) for stream in Stream for member in MEMBERS.get(stream, [()])]
    drawn = {generator(5, stream, *member).bytes(16) for stream, member in uses}
    assert len(drawn) == len(uses)
    assert generator(5, Stream.CAMERA).bytes(16) == generator(5, Stream.CAMERA, 0).bytes(16), "the reason for this test"


def test_a_generator_is_made_in_one_place() -> None:
    """A stream without a number in the table may share that of another. A search for gains is no flight."""
    made = set()
    for path in Path(sim_bridge.__file__).parent.rglob("*.py"):
        calls = [node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Call)]
        if any(isinstance(call.func, ast.Attribute) and call.func.attr == "default_rng" for call in calls):
            made.add(path.stem)
    assert made == {"random_streams", "gain_tuning"}


def test_most_seeds_fly_as_they_always_did() -> None:
    """Numbers of the table are part of what a seed means."""
    assert {stream.name: stream.value for stream in Stream} == {
        "THRUSTERS": 1, "SENSORS": 2, "CAMERA": 3, "GUSTS": 5, "LINK": 6, "SCATTER": 7, "POSES": 8, "DRAWS": 9,
        "OBSTACLES": 43,
    }  # fmt: skip
    assert np.array_equal(generator(1, Stream.THRUSTERS).random(3), np.random.default_rng([1, 1]).random(3))
