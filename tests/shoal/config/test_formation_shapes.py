"""Formations by name: the same nodes on every processor, or programs of one fleet would hold different experiments."""

import json
import os
import subprocess
import sys

import pytest

from shoal.config import LARGEST_ROBOT
from shoal.config.formation_shapes import SHAPES, Shape, shape_nodes

NODES = """
import json, sys
from shoal.config.formation_shapes import shape_nodes
print(json.dumps([shape_nodes(sys.argv[1], count, 0.8).tolist() for count in range(1, int(sys.argv[2]) + 1)]))
"""


@pytest.mark.parametrize("shape", SHAPES)
def test_nodes_are_the_same_without_the_processors_fused_arithmetic(shape: Shape) -> None:
    """Its sines and cosines differ in the last bit (glibc on x86; elsewhere the variable says nothing)."""
    older = {**os.environ, "GLIBC_TUNABLES": "glibc.cpu.hwcaps=-FMA,-FMA4,-AVX2,-AVX"}
    words = [sys.executable, "-c", NODES, shape, str(LARGEST_ROBOT)]
    here = [shape_nodes(shape, count, 0.8).tolist() for count in range(1, LARGEST_ROBOT + 1)]
    text = subprocess.run(words, env=older, capture_output=True, text=True, check=True).stdout
    assert text.strip() == json.dumps(here)
    assert "-0.0," not in text and "-0.0]" not in text, "nor has nothing a sign, which would be another text"
