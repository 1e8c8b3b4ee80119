"""What pyproject.toml cannot say: a built package knows the commit that it was built from (shoal/runtime/version.py)."""

import runpy
from pathlib import Path

from setuptools import setup
from setuptools.command.build_py import build_py
from setuptools.command.sdist import sdist

HERE = Path(__file__).parent
VERSION = runpy.run_path(str(HERE / "shoal" / "runtime" / "version.py"))


def _write_down(folder: Path) -> None:
    (folder / "shoal" / VERSION["RECORDED"]).write_text(VERSION["commit"](HERE) + "\n", encoding="ascii")


class _BuildPy(build_py):
    def run(self) -> None:
        super().run()
        if not self.editable_mode:  # there git is asked
            _write_down(Path(self.build_lib))


class _Sdist(sdist):
    def make_release_tree(self, base_dir: str, files: list[str]) -> None:
        super().make_release_tree(base_dir, files)
        _write_down(Path(base_dir))


setup(cmdclass={"build_py": _BuildPy, "sdist": _Sdist})
