"""The station as a program: starts that fail leave nothing behind."""

import socket
import subprocess
import sys
from pathlib import Path

import pytest

from sim_bridge.sil.ports import free_port

pytestmark = pytest.mark.real_time


def test_a_start_with_a_taken_page_address_is_refused_and_leaves_no_folder(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        web = f"127.0.0.1:{taken.getsockname()[1]}"
        listen = f"tcp/127.0.0.1:{free_port()}"
        command = ["run", "pool", "--out", str(tmp_path / "runs"), "--listen", listen, "--web", web]
        done = subprocess.run(
            [sys.executable, "-m", "groundstation", *command], capture_output=True, text=True, check=False, timeout=120
        )
    assert done.returncode == 2
    assert f"--web {web}: Address already in use" in done.stderr
    assert not (tmp_path / "runs").exists()
