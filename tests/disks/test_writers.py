"""Files are written whole, by shoal/runtime/output_files.py alone: the source has no other place that a person would miss."""

import ast
from collections.abc import Iterator

import pytest

from tests.source_tree import nodes, sources, tree_of

PACKAGES = ("shoal", "groundstation", "robot_agent", "localizer", "sim_bridge", "benchmarks")
WRITERS = {"write_text", "write_bytes", "imwrite", "savez", "savez_compressed", "VideoWriter"}

# Modules that write in place, and why nothing is lost.
IN_PLACE = {
    "shoal/runtime/output_files.py": "it is the one",
    "shoal/kernels/build.py": "a lock and a record of a cache, which is made again",
    "shoal/kernels/cache.py": "a cache, which is made again",
    "groundstation/station/discovery.py": "a file of a running station, which must be locked before it has its name",
    "groundstation/deploy/ssh.py": "an archive in memory",
    "groundstation/export/film.py": "PyAV writes into what `replacing` has opened",
    "groundstation/logs/recorder.py": "a log that grows, in a new folder",
    "groundstation/report/report.py": "a temporary file",
    "localizer/evaluation/offline.py": "a table that grows: what is there stays there, and --resume goes on behind it",
    "localizer/sources/log_film.py": "a temporary file",
    "localizer/sources/recording.py": "a recording that grows, in a new folder",
    "sim_bridge/studies/campaign_runner.py": "a journal that grows: what is there stays there",
    "sim_bridge/in_process/executor.py": "logs of programs",
    "sim_bridge/sil/processes.py": "logs of programs",
    "sim_bridge/sil/after_run.py": "a temporary file",
    "sim_bridge/sil/fault_injector.py": "a temporary file",
    "benchmarks/groundstation/recorder.py": "a temporary file",
    "benchmarks/harness.py": "a stamp of a build",
    "benchmarks/simulation.py": "a temporary file",
}


def _writes(node: ast.AST) -> bool:
    """True for a call that writes into a file's place, or a flag that makes a file."""
    if isinstance(node, ast.Attribute) and node.attr == "O_CREAT":
        return True
    if not isinstance(node, ast.Call):
        return False
    name = node.func.attr if isinstance(node.func, ast.Attribute) else node.func.id if isinstance(node.func, ast.Name) else ""
    if name == "open":
        modes = [*node.args[:2], *(keyword.value for keyword in node.keywords if keyword.arg == "mode")]
        texts = [mode.value for mode in modes if isinstance(mode, ast.Constant) and isinstance(mode.value, str)]
        return any(set(text) & set("wxa+") and len(text) <= 3 for text in texts)
    return name in WRITERS


def _found(package: str) -> Iterator[str]:
    for source in sources(package):
        if any(_writes(node) for node in nodes(tree_of(source))):
            yield str(source)


@pytest.mark.parametrize("package", PACKAGES)
def test_no_module_writes_a_file_in_its_place_without_a_reason(package: str) -> None:
    """Use `replacing`, `replace_text` or `replacing_together`, or write the reason into IN_PLACE."""
    assert sorted(_found(package)) == sorted(name for name in IN_PLACE if name.startswith(f"{package}/"))
