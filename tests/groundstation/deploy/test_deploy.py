"""Deployment: what is decided, and the whole of it over a real SSH server."""

import json
import os
import re
import shutil
import stat
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from typer.testing import CliRunner, Result

from groundstation.__main__ import cli
from groundstation.deploy import key_ring, manifest, wheelhouse
from groundstation.deploy import ssh as deploy_shell
from groundstation.deploy.manifest import Probe, Target
from groundstation.deploy.ssh import DeployRequest, deploy_one
from shoal.config.experiment import load_experiment
from shoal.errors import ConfigError
from shoal.kernels import cache as kernel_cache
from shoal.kernels.build import ensure_compiled
from shoal.runtime.version import PACKAGES
from sim_bridge.sil.ports import free_port
from tests.ssh_server import WITH_PACKAGES, own_wheel, ssh_command, ssh_server

pytestmark = pytest.mark.real_time

HERE = Probe(os.uname().machine, f"{sys.version_info.major}.{sys.version_info.minor}", {})


# --- what is decided


def test_a_board_is_named_with_its_robot() -> None:
    assert manifest.parse_target("pi@192.168.1.21=3") == Target("pi@192.168.1.21", 3)
    assert manifest.parse_target("robot-1.local=1") == Target("robot-1.local", 1)


@pytest.mark.parametrize("text", ["", "pi@host", "=1", "host=0", "host=x", "-oProxyCommand=x=1", "a b=1", "host;rm=1"])
def test_text_that_names_no_board_is_refused(text: str) -> None:
    with pytest.raises(ConfigError, match="not a board"):
        manifest.parse_target(text)


def test_no_robot_and_no_board_twice() -> None:
    for texts, says in ((["a=1", "b=1"], "robot 1 is named twice"), (["a=1", "a=2"], "board a is named twice")):
        with pytest.raises(ConfigError, match=says):
            manifest.parse_targets(texts)


def test_a_board_that_cannot_run_the_agent_says_what_it_lacks() -> None:
    assert manifest.read_probe("pi", "aarch64\n3.11\nsoftware ab\nkeys cd\n") == Probe(
        "aarch64", "3.11", {"software": "ab", "keys": "cd"}
    )
    for printout, says in (
        ("armv7l\n3.11\n", "armv7l"),
        ("x86_64\nnone\n", "python3-venv"),
        ("x86_64\n3.9\n", "3.11 or newer"),
        ("", "silent"),
    ):
        with pytest.raises(ConfigError, match=says):
            manifest.read_probe("pi", printout)


@pytest.mark.parametrize(
    ("does", "says"),
    [
        ("TRACKING", "pi: robot 3 is TRACKING, and a restart would disarm it at once: disarm it first"),
        ("unknown", "pi: the agent of robot 3 runs, and does not say whether it is armed"),
    ],
)
def test_an_agent_that_is_not_surely_disarmed_is_not_restarted(does: str, says: str) -> None:
    probe = manifest.read_probe("pi", f"aarch64\n3.11\nagent {does}\nsoftware ab\n")
    assert (probe.agent, dict(probe.manifest)) == (does, {"software": "ab"})
    with pytest.raises(ConfigError, match=re.escape(says)):
        manifest.refuse_to_restart(Target("pi", 3), probe)
    manifest.refuse_to_restart(Target("pi", 3), manifest.read_probe("pi", "aarch64\n3.11\n"))


def test_only_parts_that_differ_are_deployed() -> None:
    wanted = {"software": "a", "experiment": "b", "settings": "c"}
    assert manifest.changed(wanted, {}) == ("software", "experiment", "settings")
    assert manifest.changed(wanted, {**wanted, "experiment": "x"}) == ("experiment",)
    assert manifest.changed(wanted, wanted) == ()
    probe = manifest.read_probe("pi", "x86_64\n3.11\n" + manifest.write_manifest(wanted).decode())
    assert dict(probe.manifest) == wanted


def test_a_digest_is_of_names_and_contents_in_any_order() -> None:
    files = [("a", b"1"), ("b", b"2")]
    assert manifest.digest(files) == manifest.digest(files[::-1])
    assert (
        len({manifest.digest(f) for f in (files, [("a", b"2"), ("b", b"1")], [("a", b"1")], [("a", b"12"), ("b", b"")])}) == 4
    )


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (["--station", "nowhere"], "'nowhere': not a place where a station can be"),
        (["--link", "usb"], "--link 'usb': not an address of a thruster board (allowed: "),
        (["--home", "shoal"], "--home 'shoal': no folder for a board (allowed: an absolute path"),
        (["--home", "/opt/my shoal"], "no folder for a board"),
        (["--ssh", ""], "--ssh '': no command"),
        (["--ssh", 'ssh "x'], "no command: No closing quotation"),
        (["--wheelhouse", "nowhere"], "nowhere: holds no wheel of shoal"),
        (["--set", "robots=[]"], "robots"),
        (["--keys", "nowhere"], "nowhere/agent-1/ca.pem is missing"),
        (["--experiment", "puddle"], "no such experiment"),
    ],
)
def test_local_errors_are_reported_before_a_board_is_contacted(options: list[str], says: str, tmp_path: Path) -> None:
    key_ring.init(tmp_path / "keys", [], "shoal", datetime.now(UTC))
    key_ring.add(tmp_path / "keys", "robot", 1, datetime.now(UTC))
    sound = ["--station", "tls/127.0.0.1:7999", "--keys", str(tmp_path / "keys"), "--ssh", "false"]
    result = CliRunner().invoke(cli, ["deploy", "localhost=1", *sound, *options])
    assert isinstance(result.exception, ConfigError) and says in str(result.exception)
    robot_9 = CliRunner().invoke(cli, ["deploy", "localhost=9", *sound]).exception
    assert str(robot_9) == "robot 9: not in experiment 'pool' (allowed: 1, 2)"


def test_without_keys_a_board_is_not_sent_where_others_are(tmp_path: Path) -> None:
    for station, says in (("tcp/10.0.0.1:7447", "other machines could command"), ("tls/10.0.0.1:7447", "TLS needs --keys")):
        refused = CliRunner().invoke(cli, ["deploy", "localhost=1", "--station", station, "--ssh", "false"]).exception
        assert isinstance(refused, ConfigError) and says in str(refused)


# --- the whole

# A board that has the kernels, too: robot-agent compiles them in a minute (tests/shoal/kernels/test_build.py).
WITH_KERNELS = {**WITH_PACKAGES, "NUMBA_CACHE_DIR": "{tmp}/kernels"}


@dataclass
class SshBoard:
    """A board that is really this machine: its own home, its own sshd."""

    home: Path
    ssh: str
    port: int

    def run(self, command: str) -> str:
        done = subprocess.run(
            [*self.ssh.split(), "localhost", command], capture_output=True, text=True, check=False, stdin=subprocess.DEVNULL
        )
        assert done.returncode == 0, done.stderr
        return done.stdout


@pytest.fixture
def board(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[SshBoard]:
    """An sshd of one's own on a high port."""
    port = free_port()
    ssh = ssh_command(tmp_path, port)
    environment = {key: value.format(tmp=tmp_path) for key, value in getattr(request, "param", {}).items()}
    if "NUMBA_CACHE_DIR" in environment:
        ensure_compiled(("robot_agent",))
        shutil.copytree(kernel_cache.folder(), Path(environment["NUMBA_CACHE_DIR"]) / "shoal-kernels")
    with ssh_server(tmp_path, "localhost", port, environment):
        yield SshBoard(tmp_path / "opt" / "shoal", ssh, port)


def deployed(board: SshBoard, ring: Path, wheels: Path, *more: str) -> Result:
    options = ["--station", "tls/127.0.0.1:7999", "--keys", str(ring), "--home", str(board.home), "--link", "udp:127.0.0.1:9"]
    command = ["deploy", "localhost=1", *options, "--wheelhouse", str(wheels), "--ssh", board.ssh, *more]
    return CliRunner().invoke(cli, command, env={"COLUMNS": "300"})


def row(result: Result) -> list[str]:
    line = next(line for line in result.output.splitlines() if line.startswith("│ localhost"))
    return [cell.strip() for cell in line.strip("│").split("│")]


@pytest.fixture(scope="module")
def wheels(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return own_wheel(tmp_path_factory.mktemp("wheels"))


@pytest.fixture
def ring(tmp_path: Path) -> Path:
    key_ring.init(tmp_path / "keys", [], "shoal", datetime.now(UTC))
    key_ring.add(tmp_path / "keys", "robot", 1, datetime.now(UTC))
    return tmp_path / "keys"


@pytest.mark.parametrize("board", [WITH_KERNELS], indirect=True)
def test_a_bare_board_is_brought_up_to_date_and_then_left_alone(board: SshBoard, ring: Path, wheels: Path) -> None:
    would = deployed(board, ring, wheels, "--dry-run")
    assert row(would)[2:] == ["software, keys, experiment, settings", "", "not touched"]
    assert not board.home.exists()

    first = deployed(board, ring, wheels)
    assert first.exit_code == 0, first.output
    assert row(first)[2] == "software, keys, experiment, settings"
    assert row(first)[3] == metadata.version("shoal")
    key = board.home / "keys" / "agent-1" / "key.pem"
    assert key.read_bytes() == (ring / "agent-1" / "key.pem").read_bytes()
    assert stat.S_IMODE(key.stat().st_mode) == 0o600
    assert sorted(path.name for path in (board.home / "keys").iterdir()) == ["agent-1"]  # nobody else's
    assert load_experiment(str(board.home / "experiment.toml")).hash == load_experiment("pool").hash
    assert not (board.home / "incoming").exists()
    assert "--config agent.toml`" in (board.home / "agent.toml").read_text(), "it names the file that it is"
    output = board.run(f"{board.home}/venv/bin/robot-agent check --config {board.home}/agent.toml --json || true")
    checks = {finding["what"]: finding["verdict"] for finding in json.loads(output[output.index("[") :])}
    assert (checks["experiment"], checks["certificate"], checks["station"]) == ("ok", "ok", "fail")  # there is no station

    before = {path: path.stat().st_mtime_ns for path in board.home.rglob("*.toml")}
    assert row(deployed(board, ring, wheels))[2:] == ["nothing", "", "not touched"]
    assert {path: path.stat().st_mtime_ns for path in board.home.rglob("*.toml")} == before

    changed = deployed(board, ring, wheels, "--set", "duration_s=33")
    assert row(changed)[2] == "experiment"
    assert load_experiment(str(board.home / "experiment.toml")).duration_s == 33
    assert "PRIVATE KEY" not in first.output


@pytest.mark.parametrize("board", [{**WITH_PACKAGES, "RUNTIME_DIRECTORY": "{tmp}/run"}], indirect=True)
def test_a_robot_that_flies_is_left_alone(board: SshBoard, ring: Path, wheels: Path) -> None:
    status = board.home.parents[1] / "run" / "status"
    status.parent.mkdir()
    status.write_text(f"TRACKING {os.getpid()}\n")  # an agent that runs: this test's process
    refused = deployed(board, ring, wheels)
    assert refused.exit_code == 1
    assert row(refused)[2].startswith("localhost: robot 1 is TRACKING, and a restart would disarm it at once")
    assert not board.home.exists()
    archive = board.home / "incoming"  # as if it had been armed while the software was being installed
    archive.mkdir(parents=True)
    script = (deploy_shell.ARMED.read_text() + deploy_shell.SCRIPT.read_text()).encode()
    late = subprocess.run(
        [*board.ssh.split(), "localhost", f"sh -s {board.home} yes"], input=script, capture_output=True, check=False
    )
    assert late.returncode == 3 and b"its agent is TRACKING now: the service was not restarted" in late.stderr
    assert row(deployed(board, ring, wheels, "--force", "--dry-run"))[4] == "not touched"
    for rests in (f"DISARMED {os.getpid()}", "TRACKING 4194305"):  # the second has ended: no process has such a number
        status.write_text(f"{rests}\n")
        armed = board.run(f"{deploy_shell.ARMED.read_text()}armed")
        assert armed == ""


def test_a_board_that_does_not_answer_is_named_and_the_others_get_theirs(ring: Path, wheels: Path, board: SshBoard) -> None:
    wrong = SshBoard(board.home, board.ssh.replace(str(board.port), str(free_port())), 0)
    result = deployed(wrong, ring, wheels)
    assert result.exit_code == 1
    assert re.search(r"localhost.*refused", result.output)
    unknown = SshBoard(board.home, re.sub(r"-i \S+", "-i /nowhere", board.ssh), 0)
    assert "Permission denied" in deployed(unknown, ring, wheels).output


def test_boards_of_one_kind_share_the_wheels_that_are_made_for_the_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Four boards are brought up to date at once, and none of them finds the wheels there already."""
    made = []

    def build(probe: Probe, folder: Path) -> None:
        made.append(folder)
        time.sleep(0.2)
        folder.mkdir()
        (folder / "shoal-1-py3-none-any.whl").write_bytes(b"")

    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(wheelhouse, "_build", build)
    with ThreadPoolExecutor(4) as boards:
        folders = set(boards.map(wheelhouse.wheels, [Probe("aarch64", "3.11", {})] * 4))
    assert len(folders) == len(made) == 1
    assert [path.name for path in folders.pop().iterdir()] == ["shoal-1-py3-none-any.whl"]


def test_wheels_that_another_program_makes_meanwhile_serve_this_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two people deploy at once. Making wheels takes minutes: here each makes an empty file."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    made: list[Path] = []

    def build(probe: Probe, folder: Path) -> None:
        there = folder.parent.parent / "theirs"
        there.mkdir()
        (there / "a.whl").touch()
        folder.mkdir()
        (folder / "b.whl").touch()
        made.append(there.rename(there.with_name(wheels_of(probe))))

    def wheels_of(probe: Probe) -> str:
        return f"{probe.machine}-{probe.python}-{wheelhouse._source_digest(wheelhouse.checkout())}"  # as `wheels` names it

    monkeypatch.setattr(wheelhouse, "_build", build)
    assert [wheelhouse.wheels(Probe("aarch64", "3.11", {}))] == made
    assert [path.name for path in made[0].iterdir()] == ["a.whl"]


def test_an_open_network_must_be_asked_for(wheels: Path) -> None:
    result = CliRunner().invoke(
        cli, ["deploy", "localhost=1", "--station", "tcp/192.168.1.10:7447", "--wheelhouse", str(wheels)]
    )
    assert isinstance(result.exception, ConfigError)
    assert "--insecure" in str(result.exception)


@pytest.mark.slow
def test_with_the_real_wheelhouse_the_agent_needs_nothing_of_ours_on_the_board(
    board: SshBoard, ring: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    wheels = wheelhouse.wheels(HERE)
    assert wheelhouse.wheels(HERE) == wheels  # made once
    assert deployed(board, ring, wheels).exit_code == 0
    packages = board.run(f"{board.home}/venv/bin/python -m pip list --format=freeze").lower()
    assert "eclipse-zenoh" in packages
    assert "opencv" not in packages and "mcap" not in packages and "starlette" not in packages
    output = board.run(f"{board.home}/venv/bin/robot-agent check --config {board.home}/agent.toml --json || true")
    verdicts = {finding["what"]: finding["verdict"] for finding in json.loads(output[output.index("[") :])}
    assert verdicts["experiment"] == "ok"
    assert "control step" in verdicts


@pytest.mark.slow
def test_wheels_exist_for_the_boards_of_today(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    for python in ("3.11", "3.13"):  # Raspberry Pi OS of 2023 and of 2025
        names = [path.name for path in wheelhouse.wheels(Probe("aarch64", python, {})).iterdir()]
        assert any(name.startswith("eclipse_zenoh") and "aarch64" in name for name in names)


def test_an_installed_program_takes_the_checkout_that_one_stands_in(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """After `pip install .`, without `-e`: the program is not in the checkout."""
    installed, clone = tmp_path / "site-packages", tmp_path / "shoal"
    for folder in (installed, clone):
        for package in PACKAGES:
            (folder / package).mkdir(parents=True)
            (folder / package / "__init__.py").write_text(f'"""{package}."""\n')
    for name in ("pyproject.toml", "constraints.txt"):
        (clone / name).write_text("")
    monkeypatch.setattr(wheelhouse, "ROOT", installed)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigError, match="in no checkout"):
        wheelhouse.checkout()
    monkeypatch.chdir(clone / "shoal")
    assert wheelhouse.checkout() == clone
    (clone / "shoal" / "__init__.py").write_text("newer = 1\n")
    with pytest.raises(ConfigError, match="holds other sources than this program runs"):
        wheelhouse.checkout()


def test_old_wheels_leave_the_cache(tmp_path: Path) -> None:
    """The newest stay, and what is not of wheels."""
    for k in range(wheelhouse.KEPT + 3):
        (tmp_path / f"aarch64-3.11-{k}").mkdir()
        os.utime(tmp_path / f"aarch64-3.11-{k}", (k, k))
    (tmp_path / "notes").mkdir()
    wheelhouse._clean(tmp_path / "aarch64-3.11-0")  # private: building wheels takes minutes; this one is new
    left = {folder.name for folder in tmp_path.iterdir()}
    assert left == {"notes", "aarch64-3.11-0", *(f"aarch64-3.11-{k + 4}" for k in range(wheelhouse.KEPT - 1))}


# --- a board's manifest alone, behind a stand-in for ssh


@pytest.fixture
def kept_manifest(tmp_path: Path) -> DeployRequest:
    """A board that keeps its manifest, and writes what its script was asked; `service` says how its service is then."""
    (tmp_path / "shoal-9-py3-none-any.whl").write_bytes(b"new software")
    (tmp_path / "service").write_text("active")
    stand_in = tmp_path / "ssh.py"
    stand_in.write_text(
        f"""import io, pathlib, sys, tarfile
board, command = pathlib.Path({str(tmp_path)!r}), sys.argv[-1]
if "uname" in command:
    ports = (board / "ports").read_text() if (board / "ports").exists() else ""
    print("x86_64", "3.11", ports + ((board / "manifest").read_text() if (board / "manifest").exists() else ""), sep="\\n")
else:
    restart = command.split()[-1].strip("'")
    manifest = tarfile.open(fileobj=io.BytesIO(sys.stdin.buffer.read())).extractfile("manifest").read().decode()
    (board / "manifest").write_text(manifest + ("restart due\\n" if restart == "no" else ""))
    with (board / "asked").open("a") as asked: asked.write(restart + " ")
    print("version=9", "service=" + (board / "service").read_text(), sep="\\n")
"""
    )
    return DeployRequest(
        load_experiment("pool"), "tcp/127.0.0.1:7447", "shoal", "udp:127.0.0.1:9", None, "/opt/shoal", None, True, tmp_path,
        (sys.executable, str(stand_in)),
    )  # fmt: skip


def test_the_next_deployment_starts_a_board_that_was_left_running(kept_manifest: DeployRequest, tmp_path: Path) -> None:
    without = replace(kept_manifest, restart=False)
    board = Target("board", 1)
    assert deploy_one(board, without).changed
    again = deploy_one(board, without)
    assert (again.changed, again.service) == ((), "to be restarted")
    assert deploy_one(board, kept_manifest).service == "active"
    assert deploy_one(board, kept_manifest).service == "not touched"
    assert (tmp_path / "asked").read_text().split() == ["no", "yes"]


def test_a_second_deployment_is_refused_while_one_is_under_way(kept_manifest: DeployRequest, tmp_path: Path) -> None:
    ssh, home = tmp_path / "ssh.sh", tmp_path / "board"
    ssh.write_text("""for last; do :; done
case "$last" in *uname*) printf 'x86_64\\n3.11\\n' ;; *) exec sh -c "$last" ;; esac
""")
    request = replace(kept_manifest, home=str(home), ssh=("sh", str(ssh)))
    files = home / "incoming" / "software"  # of the first one, whose script installs them
    files.mkdir(parents=True)
    alone = deploy_shell.ALONE.format(home=home)
    first = subprocess.Popen(
        ["sh", "-c", f"{alone}; echo alone; read end"],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE,
    )  # fmt: skip
    with first:
        assert first.stdout is not None and first.stdout.readline() == b"alone\n"
        with pytest.raises(ConfigError, match="another deployment to it is under way"):
            deploy_one(Target("board", 1), request)
        assert files.is_dir()
        first.communicate(b"\n")
    again = subprocess.run(
        ["sh", "-c", f"{deploy_shell.ALONE.format(home=home)}; echo alone"], capture_output=True, check=True
    )
    assert again.stdout == b"alone\n"


@pytest.mark.parametrize("service", ["activating", "failed"])
def test_a_service_that_does_not_come_up_is_trouble(kept_manifest: DeployRequest, tmp_path: Path, service: str) -> None:
    (tmp_path / "service").write_text(service)
    outcome = deploy_one(Target("board", 1), kept_manifest)
    assert f"its service is {service} after the restart" in outcome.trouble


def test_a_probe_finds_the_serial_ports_of_a_board(tmp_path: Path) -> None:
    """In the shell of this machine, with a folder in the place of /dev/serial/by-id."""
    ports = tmp_path / "by-id"
    ports.mkdir()
    (ports / "usb-2-if00").touch()
    (ports / "usb-1-if00").touch()

    def probed(folder: Path, device: Path) -> Probe:
        command = manifest.PROBE.format(home=tmp_path, ports=folder, device=device)
        script = deploy_shell.ARMED.read_text(encoding="utf-8") + command
        done = subprocess.run(["sh", "-c", script], capture_output=True, text=True, check=True)
        return manifest.read_probe("pi", done.stdout)

    probe = probed(ports, ports / "usb-1-if00")
    assert (probe.ports, probe.has_device) == (("usb-1-if00", "usb-2-if00"), True)
    probe = probed(tmp_path / "none", tmp_path / "none")
    assert (probe.ports, probe.has_device) == ((), False)


@pytest.mark.skipif(os.geteuid() == 0 and shutil.which("setpriv") is None, reason="root may write everywhere")
def test_a_probe_finds_a_home_that_the_user_cannot_write(tmp_path: Path) -> None:
    """In the shell of this machine. A dry run must say so too, and what to do."""

    def probed(home: Path) -> Probe:
        command = manifest.PROBE.format(home=home, ports=tmp_path, device=tmp_path)
        nobody = ["setpriv", "--reuid", "65534", "--regid", "65534", "--clear-groups"] if os.geteuid() == 0 else []
        script = deploy_shell.ARMED.read_text(encoding="utf-8") + command
        done = subprocess.run([*nobody, "sh", "-c", script], capture_output=True, text=True, check=True)
        return manifest.read_probe("pi", done.stdout)

    with TemporaryDirectory() as name:
        folder = Path(name)
        folder.chmod(0o777)
        assert probed(folder / "new" / "shoal").manifest == {}
        folder.chmod(0o555)
        for home in (folder, folder / "new" / "shoal"):
            with pytest.raises(ConfigError, match=f"pi: .* may not write {home} there .*sudo install -d -o .* -m 755 {home}"):
                probed(home)
        folder.chmod(0o755)


@pytest.mark.parametrize(
    ("ports", "link", "says"),
    [
        ("port usb-1\nport usb-2\n", "serial:/dev/ttyACM0", "not there; is the board plugged in, and powered?; there are "),
        ("port usb-1\nport usb-2\ndevice there\n", "serial:/dev/ttyACM0", "may be another board's after a reboot"),
        ("port usb-1\nport usb-2\ndevice there\n", "serial:/dev/serial/by-id/usb-1", ""),
        ("port usb-1\ndevice there\n", "serial:/dev/ttyACM0", ""),
        ("port usb-1\nport usb-2\n", "udp:127.0.0.1:9", ""),
    ],
)
def test_a_serial_port_that_is_not_there_or_may_be_another_boards_is_told(
    ports: str, link: str, says: str, kept_manifest: DeployRequest, tmp_path: Path
) -> None:
    (tmp_path / "ports").write_text(ports)
    outcome = deploy_one(Target("board", 1), replace(kept_manifest, link=link))
    assert (says in outcome.note) if says else outcome.note == ""
    if says:
        assert "/dev/serial/by-id/usb-1, /dev/serial/by-id/usb-2" in outcome.note
