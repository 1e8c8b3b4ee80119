"""Secrets of a simulation: they do not outlast it for long, however it ends."""

import os
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from sim_bridge.sil import launcher


@pytest.mark.long
def test_keys_of_a_launcher_that_was_killed_go_with_the_next_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    script = """
import os, signal
from sim_bridge.sil import launcher
folder = launcher._secret_folder()
launcher._link_keys(launcher.Path(folder.name), (1, 2))
os.kill(os.getpid(), signal.SIGKILL)
"""  # private: a whole run takes half a minute
    around = {**os.environ, "TMPDIR": str(tmp_path)}
    assert subprocess.run([sys.executable, "-c", script], env=around, check=False).returncode == -9
    (left,) = tmp_path.iterdir()
    assert {key.name for key in left.iterdir()} == {"robot-1.key", "robot-2.key"}
    others = tmp_path / f"{launcher.SECRETS}{os.getppid()}-x"  # of one that runs
    others.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    with launcher._secret_folder() as mine:  # private, as above
        assert {path.name for path in tmp_path.iterdir()} == {others.name, Path(mine).name}
        assert Path(mine).stat().st_mode & 0o077 == 0
    assert list(tmp_path.iterdir()) == [others]
