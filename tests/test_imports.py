"""The direction of imports and the purity of the core, read from the source itself (docs/architecture.md says why)."""

import ast
import subprocess
import sys
from collections.abc import Iterable, Iterator
from importlib import metadata

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from tests.source_tree import ROOT, nodes, sources, tree_of

PROGRAMS = {"groundstation", "robot_agent", "localizer"}  # none of them sees another; they meet on the bus
PACKAGES = {*PROGRAMS, "shoal", "sim_bridge"}
# The simulator stands on all others: it steps agents in one process, starts programs, and asks the ground station's judge.
SEES = {"shoal": {"shoal"}, "sim_bridge": PACKAGES} | {program: {program, "shoal"} for program in PROGRAMS}
DOOR = "shoal/__init__.py"  # names functions of other packages for scripts, and loads them only when a script asks

# Flights, pictures and followed objects that tests judge too
HELPERS_OF_BENCHMARKS = ("tests.flights", "tests.localizer.photoreal", "tests.localizer.plain_video")

# `shoal` holds what at least two of the three programs need. These stand there all the same, with the reason.
SHARED_OTHERWISE = {
    "shoal.mavlink": "what a robot's computer and its board must agree on; the simulator has the board",
    "shoal.bus.frame_ring": "pictures between a localizer and whatever makes them on the same machine",
    "shoal.bus.memory_transport": "the bus inside one process: for flights in one process, and for tests",
    "shoal.config.key_reference": "the documentation of the keys stands beside the keys",
    "shoal.kernels.worker": "a program of its own, which kernels/build.py starts",
}

# What each part of a package may import from the same package: a table that reads downwards, so that nothing goes round. Every
# edge is used; a new one is a decision about the architecture (docs/architecture.md).
PARTS: dict[str, dict[str, set[str]]] = {
    "shoal": {
        "frames": set(),
        "errors": set(),
        "system": {"errors"},
        "kernels": {"system"},
        "config": {"errors", "frames", "system"},
        "messages": {"config", "errors", "frames"},
        "bus": {"config", "errors", "messages", "system"},
        "runtime": {"bus", "config", "errors", "messages", "system"},
        "mavlink": {"errors", "messages", "runtime", "system"},
    },
    "localizer": {
        "kernels": set(),
        "camera_model": {"kernels"},
        "detection": {"camera_model", "kernels"},
        "sources": {"detection"},
        "tracking": {"camera_model", "detection", "kernels", "sources"},
        "view": {"camera_model", "detection", "sources", "tracking"},
        "calibration": {"camera_model", "detection", "sources", "view"},
        "node": {"detection", "sources", "tracking", "view"},
        "fusion_node": {"sources", "tracking"},
        "evaluation": {"detection", "node", "sources", "tracking"},
        "setup": {"calibration", "camera_model", "detection", "sources", "view"},
    },
    "robot_agent": {
        "host": set(),
        "inputs": set(),
        "vehicle": set(),
        "guidance": {"inputs"},
        "step_record": {"inputs"},
        "control": {"guidance", "vehicle"},
        "safety": {"control", "guidance", "inputs", "vehicle"},
        "agent": {"control", "guidance", "inputs", "safety", "vehicle"},
        "preflight": {"agent", "host", "inputs", "safety"},
        "commands": {"host", "preflight"},
        "node": {"agent", "control", "host", "safety", "step_record"},
    },
    "groundstation": {
        "deploy": set(),
        "gate": set(),
        "fleet_time": set(),
        "logs": set(),
        "formation_clock": set(),
        "analysis": {"formation_clock", "logs"},
        "palette": set(),
        "export": {"analysis", "formation_clock", "logs", "palette"},
        "planning": set(),
        "report": {"analysis", "logs", "palette"},
        "telemetry": set(),
        "mission": {"formation_clock", "planning", "telemetry"},
        "web": {"analysis", "fleet_time", "formation_clock", "logs", "mission", "planning", "telemetry"},
        "station": {"export", "gate", "logs", "mission", "planning", "telemetry", "web"},
        "client": {"fleet_time", "gate", "mission", "station"},
        "scripting": {"client", "export", "fleet_time", "logs", "mission", "report"},
        "cli": {"client", "deploy", "export", "gate", "logs", "mission", "planning", "report", "station", "web"},
    },
    "sim_bridge": {
        "fault_schedule": set(),
        "lockstep": set(),
        "replay": set(),
        "plant": {"fault_schedule"},
        "camera": {"plant"},
        "sil": {"fault_schedule"},
        "thruster_board": {"plant"},
        "board_conformance": {"thruster_board"},
        "world": {"fault_schedule", "plant", "thruster_board"},
        "node": {"camera", "fault_schedule", "lockstep", "plant", "thruster_board", "world"},
        "in_process": {"fault_schedule", "lockstep", "node", "plant", "replay", "sil"},
        "scripting": {"in_process", "sil"},
        "studies": {"fault_schedule", "in_process", "plant", "sil"},
        "cli": {"fault_schedule", "in_process", "node", "replay", "sil", "studies", "thruster_board"},
    },
}

# What only a file that says "SHELL:" may touch: the network, clocks, threads, processes, files, chance.
SHELL_MODULES = {
    "asyncio", "concurrent", "http", "multiprocessing", "os", "queue", "random", "resource", "secrets", "select", "selectors",
    "serial", "shutil", "signal", "socket", "subprocess", "tempfile", "threading", "time", "urllib", "uuid", "zenoh",
}  # fmt: skip
SHELL_METHODS = {
    "exists", "glob", "imread", "imwrite", "is_dir", "is_file", "iterdir", "mkdir", "now", "open", "read_bytes", "read_text",
    "rename", "rglob", "rmdir", "symlink_to", "unlink", "utcnow", "VideoCapture", "write_bytes", "write_text",
}  # fmt: skip
SHELL_FUNCTIONS = {"open", "input", "print"}


def _imports(tree: ast.Module, package: str) -> Iterator[str]:
    """Full names of all modules that a file imports, also inside functions and under TYPE_CHECKING."""
    for node in nodes(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield node.module or "" if node.level == 0 else f"{package}.{node.module or ''}"


def _impure(tree: ast.Module) -> Iterator[str]:
    """The parts of a file that only a shell file may have."""
    yield from (name for name in _imports(tree, "") if name.partition(".")[0] in SHELL_MODULES)
    for node in nodes(tree):
        if not isinstance(node, ast.Call):
            continue
        if isinstance(node.func, ast.Name) and node.func.id in SHELL_FUNCTIONS:
            yield f"{node.func.id}() in line {node.lineno}"
        if isinstance(node.func, ast.Attribute) and node.func.attr in SHELL_METHODS:
            yield f".{node.func.attr}() in line {node.lineno}"


def _unseeded(tree: ast.Module) -> Iterator[str]:
    """Uses of numpy's global generator, and generators without a seed."""
    for node in nodes(tree):
        if not (isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute)):
            continue
        owner, name = ast.unparse(node.func.value), node.func.attr
        if owner in ("np.random", "numpy.random") and ((name[0].islower() and name != "default_rng") or not node.args):
            yield f"{owner}.{name} in line {node.lineno}"


def _reached_on_disk(tree: ast.Module) -> Iterator[str]:
    """Packages whose files a file names: `folder / "localizer"`, `Path("localizer/...")`, `resources.files("localizer")`."""
    for node in nodes(tree):
        named: list[ast.expr] = []
        if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Div):
            named = [node.left, node.right]
        elif isinstance(node, ast.Call) and ast.unparse(node.func).rpartition(".")[2] in ("Path", "files", "joinpath"):
            named = list(node.args)
        for one in named:
            if isinstance(one, ast.Constant) and isinstance(one.value, str):
                yield one.value.partition("/")[0].partition(".")[0]


def _is_shell(tree: ast.Module) -> bool:
    return "SHELL:" in (ast.get_docstring(tree) or "")


def test_the_rules_notice_offenders() -> None:
    """The checks below are only worth something if they bite."""
    offender = ast.parse("def f(p):\n    import time\n    from os.path import join\n    p.write_text('x')\n    open('y')\n")
    assert len(list(_impure(offender))) == 4
    assert list(_imports(ast.parse("from robot_agent.control.mpc import Mpc\nimport sim_bridge.world"), "shoal")) == [
        "robot_agent.control.mpc",
        "sim_bridge.world",
    ]
    assert list(_imports(ast.parse("from . import mpc"), "robot_agent")) == ["robot_agent."]
    reaching = "p / 'sim_bridge' / 'x'\nPath('localizer/y')\nresources.files('robot_agent')\nstart('groundstation')\n"
    assert set(_reached_on_disk(ast.parse(reaching))) >= {"sim_bridge", "localizer", "robot_agent"}
    assert "groundstation" not in set(_reached_on_disk(ast.parse(reaching)))
    unseeded = ast.parse("import numpy as np\nnp.random.normal(3)\nnp.random.default_rng()\nnp.random.default_rng(1)\n")
    assert len(list(_unseeded(unseeded))) == 2


@pytest.mark.parametrize("package", sorted(PARTS))
def test_packages_import_only_what_they_may_see(package: str) -> None:
    offences = []
    for source in sources(package):
        names = _roots(_imports(tree_of(source), package))
        allowed = PACKAGES if source == DOOR else SEES[package]
        offences += [f"{source} imports {other}" for other in names & (PACKAGES | {"tests", "benchmarks"}) - allowed]
    assert not offences, f"{'; '.join(sorted(offences))}: what programs share belongs in shoal/"


@pytest.mark.parametrize("package", sorted(PARTS))
def test_packages_do_not_reach_into_one_another_on_disk(package: str) -> None:
    others = (PACKAGES | {"tests", "benchmarks"}) - SEES[package]
    names = [f"{s} names files of {other}" for s in sources(package) for other in others & set(_reached_on_disk(tree_of(s)))]
    assert not names, f"{'; '.join(sorted(names))}: what programs share belongs in shoal/"


def test_benchmarks_stand_on_the_flights_of_tests_and_no_test_on_a_benchmark() -> None:
    """Flights that both need stand in tests/flights. The benchmarks' own tests may import what they test."""
    own = "tests/benchmarks/"
    offences = [s for s in sources("tests") if not s.startswith(own) and "benchmarks" in _roots(_imports(tree_of(s), "tests"))]
    assert not offences, f"{', '.join(offences)}: import from benchmarks; what tests need of it belongs in tests/flights"
    names = {name for source in sources("benchmarks") for name in _imports(tree_of(source), "benchmarks")}
    others = {name for name in names if name.startswith("tests.") and not name.startswith(HELPERS_OF_BENCHMARKS)}
    assert not others, f"benchmarks import {sorted(others)}; of tests they may see {' and '.join(HELPERS_OF_BENCHMARKS)}"


def _roots(names: Iterable[str]) -> set[str]:
    """The packages at the top level of full names."""
    return {name.partition(".")[0] for name in names}


def test_shoal_holds_what_two_programs_need() -> None:
    """Every module of it is imported by two of the three programs, directly or by another module of shoal."""
    modules = {s.removesuffix(".py").removesuffix("/__init__").replace("/", "."): s for s in sources("shoal") if s != DOOR}
    users: dict[str, set[str]] = {module: set() for module in modules}
    for program in PROGRAMS:
        pending = [name for source in sources(program) for name in _own_imports(source, "shoal")]
        while pending:
            name = pending.pop()
            if name in modules and program not in users[name]:
                users[name].add(program)
                pending += _own_imports(modules[name], "shoal")
    lonely = {m for m, programs in users.items() if len(programs) < 2 and not modules[m].endswith("__init__.py")}
    excepted = {m for m in lonely if any(m == e or m.startswith(f"{e}.") for e in SHARED_OTHERWISE)}
    assert lonely == excepted, f"{sorted(lonely - excepted)}: used by {[users[m] for m in sorted(lonely - excepted)]} alone"
    needless = [e for e in SHARED_OTHERWISE if not any(m == e or m.startswith(f"{e}.") for m in lonely)]
    assert not needless, f"no longer exceptions: {needless}"


def _part(module: str) -> str:
    """The subpackage, or the module beside the subpackages, that a full name belongs to."""
    return module.split(".")[1] if "." in module else ""


def _own_imports(source: str, package: str) -> set[str]:
    """Modules of a package that a file imports; `from a.b import c` counts as a.b and as a.b.c."""
    modules = set()
    for node in nodes(tree_of(source)):
        if isinstance(node, ast.ImportFrom) and node.level == 0:
            modules |= {str(node.module), *(f"{node.module}.{alias.name}" for alias in node.names)}
        elif isinstance(node, ast.Import):
            modules |= {alias.name for alias in node.names}
    return {name for name in modules if name.startswith(f"{package}.")}


@pytest.mark.parametrize("package", sorted(PARTS))
def test_parts_of_a_package_import_downwards_and_as_the_table_says(package: str) -> None:
    edges: dict[str, set[str]] = {}
    for source in sources(package):
        own = _part(source.removesuffix(".py").replace("/", "."))
        if own not in ("__init__", "__main__"):
            edges.setdefault(own, set()).update({_part(name) for name in _own_imports(source, package)} - {own})
    assert edges == PARTS[package]
    parts = list(PARTS[package])
    for i, part in enumerate(parts):
        assert PARTS[package][part] <= set(parts[:i]), f"{package}/{part} imports what stands below it in the table"


@pytest.mark.parametrize("package", sorted(PARTS))
def test_only_shell_files_touch_the_world(package: str) -> None:
    pure = [source for source in sources(package) if not _is_shell(tree_of(source))]
    offences = [f"{source}: {what}" for source in pure for what in sorted(set(_impure(tree_of(source))))]
    assert not offences, f"{'; '.join(offences)}: pass it in as an argument, or move it to a file marked SHELL:"


@pytest.mark.parametrize("package", sorted(PARTS))
def test_files_marked_shell_are_shells(package: str) -> None:
    shells = [(source, tree_of(source)) for source in sources(package) if _is_shell(tree_of(source))]
    idle = [s for s, tree in shells if not any(_impure(tree)) and not any(_reaches_shell(n) for n in _imports(tree, package))]
    assert not idle, f"{', '.join(idle)}: marked SHELL: but touch nothing; without the mark they can be trusted to stay pure"


def _reaches_shell(module: str) -> bool:
    path = ROOT / (module.replace(".", "/") + ".py")
    return path.is_file() and _is_shell(tree_of(str(path.relative_to(ROOT))))


@pytest.mark.parametrize("package", sorted(PARTS))
def test_chance_is_seeded(package: str) -> None:
    offences = [f"{source}: {what}" for source in sources(package) for what in _unseeded(tree_of(source))]
    assert not offences, f"{'; '.join(offences)}: a run must be repeatable; take a seeded Generator as an argument"


def _base_install() -> set[str]:
    """The distributions that come with a plain `pip install shoal`, as a robot's board has it, by their canonical names."""
    distributions: set[str] = set()
    pending = [Requirement("shoal")]
    while pending:
        wanted = pending.pop()
        for line in metadata.distribution(wanted.name).requires or []:
            needed = Requirement(line)
            applies = needed.marker is None or any(needed.marker.evaluate({"extra": e}) for e in wanted.extras or {""})
            if applies and canonicalize_name(needed.name) not in distributions:
                distributions.add(canonicalize_name(needed.name))
                pending.append(needed)
    return distributions


@pytest.mark.long
def test_the_agent_runs_on_the_base_install() -> None:
    """Import all of the agent in a fresh interpreter: nothing that only the other roles install may come along."""
    base = _base_install() | {"shoal", "setuptools", "pip"}
    base |= {"pyyaml"}  # Numba imports it where it is installed
    assert "numpy" in base and "opencv-python-headless" not in base and "mcap" not in base
    modules = [
        s.removesuffix(".py").replace("/", ".") for s in sources(*sorted(PARTS)) if s.startswith(("robot_agent/", "shoal/"))
    ]
    script = f"import sys; {'; '.join(f'import {m}' for m in modules)}; print(*{{m.partition('.')[0] for m in sys.modules}})"
    done = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    owners = metadata.packages_distributions()
    for module in sorted(set(done.stdout.split())):
        distributions = {canonicalize_name(name) for name in owners.get(module, ())}
        extra = f"importing the robot's software also imports {module}, which its board does not have"
        assert not distributions or distributions & base, extra


@pytest.mark.long
@pytest.mark.parametrize(
    ("package", "allowed"),
    [("groundstation", {"numpy", "google"}), ("robot_agent", set()), ("localizer", set()), ("sim_bridge", set())],
)
def test_a_command_line_loads_only_what_reads_it(package: str, allowed: set[str]) -> None:
    """A command imports what it needs when it runs: `stop`, `--help` and completion wait for nothing else. The station's
    requests are messages, which are made of numpy and protobuf."""
    heavy = {
        "numpy",
        "google",
        "pydantic",
        "scipy",
        "numba",
        "cv2",
        "matplotlib",
        "zenoh",
        "pymavlink",
        "serial",
        "mcap",
        "rich",
    }
    script = f"import sys; import {package}.__main__; print(*{{m.partition('.')[0] for m in sys.modules}})"
    done = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, check=True)
    assert heavy & set(done.stdout.split()) <= allowed
