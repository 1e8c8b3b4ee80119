"""SSH servers of a test's own: boards to deploy to, with keys that live as long as the test."""

import os
import shutil
import socket
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

import pytest

from groundstation.deploy import wheelhouse
from tests.waiting import eventually

SSHD = shutil.which("sshd", path=f"{os.environ.get('PATH', '')}:/usr/sbin")
BOARD_PATH = {"PATH": f"{Path(sys.base_prefix) / 'bin'}:/usr/local/bin:/usr/bin:/bin"}
WITH_PACKAGES = {  # environment of a board that has the packages already: the test needs no 80 MB of wheels
    "PIP_NO_DEPS": "1",
    "PIP_IGNORE_INSTALLED": "1",
    "PYTHONPATH": ":".join(path for path in sys.path if path.endswith("site-packages")),
}


def ssh_command(folder: Path, port: int) -> str:
    """The `ssh` that reaches the servers of this folder. Makes their keys; skips the test where there is no server."""
    if SSHD is None:
        pytest.skip("no sshd here (Debian: apt install openssh-server)")
    for name in ("host", "user"):
        subprocess.run(["ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-f", str(folder / name)], check=True)
    return f"ssh -F none -p {port} -i {folder / 'user'} -o UserKnownHostsFile={folder / 'known_hosts'} -o IdentitiesOnly=yes"


@contextmanager
def ssh_server(
    folder: Path, host: str, port: int, environment: Mapping[str, str], inside: Sequence[str] = ()
) -> Iterator[None]:
    """An sshd at this address until the context ends. `inside` is the command that runs it, before its own words."""
    if os.geteuid() == 0:
        Path("/run/sshd").mkdir(mode=0o755, exist_ok=True)  # what an sshd of root wants to find
    settings = {
        "Port": port,
        "ListenAddress": socket.gethostbyname(host),
        "HostKey": folder / "host",
        "AuthorizedKeysFile": folder / "user.pub",
        "PidFile": "none",
        "UsePAM": "no",
        "StrictModes": "no",
        "PasswordAuthentication": "no",
        "SetEnv": " ".join(f"{key}={value}" for key, value in {**BOARD_PATH, **environment}.items()),
    }
    config = folder / f"sshd_config-{host}"
    config.write_text("".join(f"{key} {value}\n" for key, value in settings.items()))
    name = host if port == 22 else f"[{host}]:{port}"
    with (folder / "known_hosts").open("a") as hosts:
        hosts.write(f"{name} {(folder / 'host.pub').read_text()}")
    server = subprocess.Popen([*inside, str(SSHD), "-D", "-e", "-f", str(config)], stderr=subprocess.DEVNULL)

    def answers() -> bool:
        with socket.socket() as probe:
            return probe.connect_ex((host, port)) == 0

    try:
        assert eventually(answers, 30.0), f"no sshd at {host}:{port}"
        yield
    finally:
        server.terminate()
        server.wait()


def own_wheel(folder: Path) -> Path:
    """A wheelhouse with nothing but this project's wheel."""
    # the public functions also collect the wheels of all other packages, which takes minutes; without isolation pip takes the
    # setuptools that is here and fetches none
    wheelhouse._pip("wheel", "--no-deps", "--no-build-isolation", "--wheel-dir", str(folder), str(wheelhouse.ROOT))
    return folder
