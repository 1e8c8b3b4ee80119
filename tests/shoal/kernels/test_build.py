"""Kernels are compiled once for a machine: by real programs, in a small installation with five kernels of its own."""

import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest

from shoal.kernels.stamp import stamp_of
from tests.waiting import eventually

pytestmark = [pytest.mark.real_time, pytest.mark.skipif("NUMBA_DISABLE_JIT" in os.environ, reason="nothing is compiled")]

ROOT = Path(__file__).parents[3]
NAMES = "abcde"

KERNELS = """
from robot_agent.numbers import FACTOR
from shoal.kernels.decorator import kernel
"""
KERNEL = '''
@kernel
def {name}(x: float) -> float:
    """Times a number."""
    return {place}.0 * FACTOR * x
'''
PROGRAM = "from robot_agent.small import a, b, c, d, e; print(a(2.0), b(2.0), c(2.0), d(2.0), e(2.0))"
RIGHT = "2.0 4.0 6.0 8.0 10.0"
ENSURE = """
import sys
from shoal.kernels.build import ensure_compiled
print(*ensure_compiled(("robot_agent",)), "numba" in sys.modules)
"""


LITTLE_MEMORY = """
from shoal.kernels import build as kernel_build
kernel_build.free_memory_mb = lambda: 1.0
kernel_build.ensure_compiled(("robot_agent",))
"""


@pytest.fixture
def installation(tmp_path: Path) -> Path:
    """Folder of an installation whose kernels nobody has compiled."""
    folder = tmp_path / "installed"
    (folder / "robot_agent").mkdir(parents=True)
    for part in ("kernels", "system"):
        (folder / "shoal" / part).mkdir(parents=True)
        for source in (ROOT / "shoal" / part).glob("*.py"):
            shutil.copy(source, folder / "shoal" / part)
    for package in ("shoal", "robot_agent"):
        (folder / package / "__init__.py").touch()
    (folder / "robot_agent" / "numbers.py").write_text("FACTOR = 1.0\n", encoding="utf-8")
    text = KERNELS + "".join(KERNEL.format(name=name, place=i + 1) for i, name in enumerate(NAMES))
    (folder / "robot_agent" / "small.py").write_text(text, encoding="utf-8")
    return folder


def _start(installation: Path, program: str = PROGRAM, user_cache: Path | None = None) -> subprocess.Popen[str]:
    cache = str(user_cache or installation / "user")
    environment = {**os.environ, "PYTHONPATH": str(installation), "XDG_CACHE_HOME": cache, "HOME": cache}
    environment.pop("NUMBA_CACHE_DIR", None)
    command = [sys.executable, "-c", program]
    return subprocess.Popen(
        command, env=environment, cwd=installation, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


def _run(installation: Path, program: str = PROGRAM, user_cache: Path | None = None) -> tuple[str, str]:
    """Run a program to its good end. Returns its output and its lines on stderr."""
    started = _start(installation, program, user_cache)
    output, complaints = started.communicate(timeout=300)
    assert started.returncode == 0, complaints
    return output.strip(), complaints


def _files(installation: Path) -> list[Path]:
    return sorted(installation.rglob("*.kernel"))


def test_programs_that_start_together_compile_once_and_the_next_one_nothing(installation: Path) -> None:
    together = [_start(installation) for _ in range(3)]
    results = [program.communicate(timeout=300) for program in together]
    assert [output.strip() for output, _ in results] == [RIGHT] * 3
    assert "".join(complaints for _, complaints in results).count("5 kernels compiled in") == 1
    assert _run(installation) == (RIGHT, "")
    # the next program is told at once, without the compiler
    assert _run(installation, ENSURE)[0] == "0 True False"
    _run(installation, "from shoal.kernels import cache as kernel_cache; kernel_cache.clear()")
    assert _files(installation) == [], "as before the package is removed"


def test_changed_constant_of_another_module_is_noticed(installation: Path) -> None:
    assert _run(installation, ENSURE)[0] == "5 True False"
    (installation / "robot_agent" / "numbers.py").write_text("FACTOR = 10.0\n", encoding="utf-8")
    output, complaints = _run(installation)
    assert output == "20.0 40.0 60.0 80.0 100.0"
    assert "5 kernels compiled in" in complaints


def test_damaged_files_count_as_missing(installation: Path) -> None:
    _run(installation, ENSURE)
    files = _files(installation)
    whole = [file.read_bytes() for file in files]
    middle = len(whole[3]) // 2
    damaged = [
        b"",
        whole[1][: len(whole[1]) // 2],
        bytes(len(whole[2])),
        whole[3][:middle] + bytes([whole[3][middle] ^ 4]) + whole[3][middle + 1 :],
    ]
    for file, content in zip(files, damaged, strict=False):
        file.write_bytes(content)
    output, complaints = _run(installation)
    assert output == RIGHT
    assert complaints.count("is damaged: that kernel is compiled again") == 4
    assert "4 kernels compiled in" in complaints
    files[4].unlink()
    assert _run(installation, ENSURE)[0] == "1 True False"  # the record of the compilation is not believed


def test_whole_file_that_cannot_be_loaded_counts_as_missing(installation: Path) -> None:
    _run(installation, ENSURE)
    write = "from shoal.kernels import cache as kernel_cache; import sys; kernel_cache.write('{}', b'of another compiler')"
    _run(installation, write.format(_files(installation)[0].name))
    output, complaints = _run(installation)
    assert output == RIGHT
    assert "cannot be loaded" in complaints


def test_installation_that_cannot_be_written_uses_the_users_cache(installation: Path) -> None:
    (installation / "shoal" / "__pycache__").touch()  # no folder can be made there, even by root
    assert _run(installation, ENSURE)[0] == "5 True False"
    assert {file.parents[2] for file in _files(installation)} == {installation / "user"}
    assert _run(installation) == (RIGHT, "")


def test_without_a_folder_every_start_compiles_and_the_log_says_so_once(installation: Path) -> None:
    (installation / "shoal" / "__pycache__").touch()
    for _ in range(2):
        output, complaints = _run(installation, user_cache=Path("/proc/none"))
        assert output == RIGHT
        assert complaints.count("no folder to keep compiled kernels in") == 1
    assert not _files(installation)


def test_with_little_memory_each_module_has_a_process_of_its_own(installation: Path) -> None:
    text = "from robot_agent.small import a, b\nfrom shoal.kernels.decorator import kernel\n"
    text += KERNEL.format(name="later", place=6).replace("FACTOR", "1.0")
    (installation / "robot_agent" / "another.py").write_text(text, encoding="utf-8")
    assert "6 kernels compiled in" in _run(installation, LITTLE_MEMORY)[1]
    progress = next(installation.rglob("lock")).read_text(encoding="utf-8")
    assert progress == "6 of 6 kernels compiled, about 0 s left, only this time"


def test_next_program_takes_over_from_one_that_is_killed(installation: Path) -> None:
    killed = _start(installation)
    while not _files(installation):  # in the middle: one is there
        assert killed.poll() is None
        time.sleep(0.01)
    killed.send_signal(signal.SIGKILL)
    assert _run(installation)[0] == RIGHT
    assert len(_files(installation)) == 5
    assert _run(installation, ENSURE)[0].endswith("True False")
    killed.communicate()


def test_the_workers_end_with_a_program_that_is_killed(installation: Path) -> None:
    """However long the compiler takes until it says something again. The lock is free then."""
    begun = installation / "begun"
    text = f"import pathlib, time; pathlib.Path({str(begun)!r}).touch(); time.sleep(3600)\n"
    text += KERNELS + KERNEL.format(name="later", place=6)
    (installation / "robot_agent" / "wait.py").write_text(text, encoding="utf-8")
    program = _start(installation, ENSURE)
    while not begun.exists():
        assert program.poll() is None
        time.sleep(0.01)
    workers = psutil.Process(program.pid).children()
    program.send_signal(signal.SIGKILL)
    program.wait()
    assert eventually(lambda: not any(map(_runs, workers)))
    program.communicate()


def _runs(process: psutil.Process) -> bool:
    return process.is_running() and process.status() != psutil.STATUS_ZOMBIE


def test_stamp_is_that_of_the_content() -> None:
    def stamp(source: str, stamps: dict[object, str] | None = None, **used: object) -> str:
        space: dict[str, object] = dict(used)
        exec(source, space)
        return stamp_of(space["f"], "f8(f8)", stamps or {})  # type: ignore[arg-type]

    plain = "def f(x):\n    'Doc.'\n    return A * x\n"
    assert stamp(plain, A=2.0) == stamp("\n\n" + plain.replace("Doc", "Another"), A=2.0)
    assert stamp(plain, A=2.0) != stamp(plain, A=3.0)
    assert stamp(plain, A=2.0) != stamp(plain.replace("*", "+"), A=2.0)
    with pytest.raises(TypeError, match="uses A, a function that is no kernel"):
        stamp(plain, A=lambda: 2.0)
