"""Loops that accept connections where the process has no file descriptor left for one: they rest, and go on."""

import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.real_time

BEGIN = """
import os, resource, socket, sys, threading, time
from pathlib import Path
accepted, accept = [], socket.socket.accept
def counted(self):
    accepted.append(None)
    return accept(self)
socket.socket.accept = counted
"""
DOOR = """
from groundstation.gate.own_door import OwnDoor
served, client = threading.Event(), socket.socket(socket.AF_UNIX)
door, where = OwnDoor(Path(sys.argv[1]), lambda *told: served.set()), sys.argv[1]
said = bytes(12)
"""
GUARD = """
from groundstation.gate.guard import MOST_LINKS, Guard
served, client, router = threading.Event(), socket.socket(), socket.create_server(("127.0.0.1", 0))
listener = socket.create_server(("127.0.0.1", 0))
where, inner = listener.getsockname(), router.getsockname()[1]
guard = Guard(listener, (inner, inner), lambda told: None, MOST_LINKS)
come = guard._admission.come  # private: that a connection has come is all that is asked here
guard._admission.come = lambda *told: (served.set(), come(*told))[1]
end, ended = socket.socketpair()
guard.watch(ended.fileno())
threading.Thread(target=guard.run, daemon=True).start()
said = b""
"""
END = """
hard = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
spare = []
resource.setrlimit(resource.RLIMIT_NOFILE, (64, hard))
try:
    while True:
        spare.append(os.open("/dev/null", os.O_RDONLY))
except OSError:
    pass
client.connect(where)
client.sendall(said)
time.sleep(1.0)
print(len(accepted), served.is_set())
for one in spare:
    os.close(one)
print(served.wait(10.0), flush=True)
os._exit(0)
"""


@pytest.mark.parametrize("loop", [DOOR, GUARD], ids=["door", "guard"])
def test_a_loop_that_cannot_accept_rests_and_goes_on(loop: str, tmp_path: Path) -> None:
    """The kernel wakes it again at once, as the connection is still there."""
    words = [sys.executable, "-c", BEGIN + loop + END, str(tmp_path / "door")]
    done = subprocess.run(words, capture_output=True, text=True, timeout=60, check=False)
    tried, *rest = done.stdout.split()
    assert rest == ["False", "True"], done
    assert 1 <= int(tried) <= 20
