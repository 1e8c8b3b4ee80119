"""SHELL: boards over SSH: ask, pack, send, have the board's script put it in place, and hear what came of it.

Everything goes through the user's own `ssh` (its agent, its configuration, its known hosts); what travels is one tar archive
on its standard input, so no secret is ever part of a command line. Only `sh`, `tar` and Python must be on the board.
"""

import io
import shlex
import subprocess
import tarfile
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

from groundstation.deploy import manifest, wheelhouse
from groundstation.deploy.manifest import Probe, Target
from shoal.bus.endpoint import parse_address
from shoal.bus.key_ring import open_keys
from shoal.bus.network import refuse_open
from shoal.config.experiment import Experiment, dump_experiment
from shoal.errors import ConfigError
from shoal.mavlink.board_address import PORTS_BY_ID, missing_port, number_in_name, parse_link
from shoal.messages.topics import Role, process_name

ANSWER_S = 30.0
INSTALL_S = 900.0  # a small board unpacks and compiles for minutes
AT_ONCE = 4
SCRIPT = Path(__file__).parent / "templates" / "board.sh"
ARMED = Path(__file__).parent / "templates" / "armed.sh"
# Of two deployments to one board at once the second would take the first one's files away, and the board would hold some of
# each. The lock is the shell's, and ends with it. A file system that knows no locks lets everybody in.
ALONE = """exec 9>>{home}/lock; python3 -c '
import errno, fcntl, sys
try:
    fcntl.flock(9, fcntl.LOCK_EX | fcntl.LOCK_NB)
except OSError as error:
    sys.exit(error.errno in (errno.EAGAIN, errno.EACCES))' || {{
echo "another deployment to it is under way: wait until that has ended" >&2; exit 4; }}"""

Files = list[tuple[str, bytes]]


@dataclass(frozen=True)
class DeployRequest:
    """Content and options of a deployment, the same for every board."""

    experiment: Experiment
    station: str
    fleet: str
    link: str
    link_key: str | None  # a file on the board: it never leaves it
    home: str
    ring: Path | None
    insecure: bool = False
    wheels: Path | None = None  # ready-made; else made here
    ssh: tuple[str, ...] = ("ssh",)
    restart: bool = True
    dry_run: bool = False
    force: bool = False  # restart also an agent that is armed


@dataclass(frozen=True)
class TargetResult:
    """Result for one board."""

    target: Target
    changed: tuple[str, ...] = ()
    version: str = ""
    service: str = ""
    trouble: str = ""
    note: str = ""  # what a person should know besides


def check(targets: Sequence[Target], request: DeployRequest) -> None:
    """Check all that can be checked without a board. Raises ConfigError."""
    parse_address(request.station)
    if request.ring is None:
        refuse_open(request.station, request.insecure)
    parse_link(request.link)
    manifest.check_home(request.home)
    if request.wheels is not None:
        _wheel_files(request.wheels)
    for target in targets:
        request.experiment.robot(target.robot)
        if request.ring is not None:
            open_keys(request.ring, process_name(Role.ROBOT, target.robot))


def deploy_all(targets: Sequence[Target], request: DeployRequest) -> Iterable[TargetResult]:
    """All boards, a few at once; one that fails does not keep the others from theirs."""
    with ThreadPoolExecutor(AT_ONCE) as pool:
        yield from pool.map(lambda target: _tried(target, request), targets)


def _tried(target: Target, request: DeployRequest) -> TargetResult:
    """Deploy to one board. An error becomes its result, so that the other boards still get theirs."""
    try:
        return deploy_one(target, request)
    except (ConfigError, OSError) as error:  # a file here that cannot be read is no reason to say nothing of the other boards
        return TargetResult(target, trouble=str(error))


def deploy_one(target: Target, request: DeployRequest) -> TargetResult:
    """Bring one board up to date, and look at its serial ports. Raises ConfigError with the reason where that fails."""
    home = shlex.quote(request.home)
    script = manifest.PROBE.format(home=home, ports=PORTS_BY_ID, device=shlex.quote(_device(request.link) or "/nowhere"))
    probe = manifest.read_probe(target.host, _ssh(request, target, ARMED.read_text(encoding="utf-8") + script, b"", ANSWER_S))
    result = _bring_missing(target, request, probe, home)
    return replace(result, note=_note_of(_device(request.link), probe))


def _device(link: str) -> str:
    """The serial port of a link; empty if it has none."""
    address = parse_link(link)
    return address.where if address.kind == "serial" else ""


def _note_of(device: str, probe: Probe) -> str:
    """Text about a serial port that is not there, or may be another board's; empty for any other, and without one."""
    names = [f"{PORTS_BY_ID}/{name}" for name in probe.ports]
    return "" if not device else number_in_name(device, names) if probe.has_device else missing_port(device, names)


def _bring_missing(target: Target, request: DeployRequest, probe: Probe, home: str) -> TargetResult:
    """Bring what is not on a board yet."""
    parts = _parts(target, request, probe)
    digests = {part: manifest.digest(files) for part, files in parts.items()}
    travels = manifest.changed(digests, probe.manifest)
    if not travels and not (probe.restart_due and request.restart):
        return TargetResult(target, travels, service="to be restarted" if probe.restart_due else "not touched")
    if request.restart and not request.force:
        manifest.refuse_to_restart(target, probe)
    if request.dry_run:
        return TargetResult(target, travels, service="not touched")
    files = [file for part in travels for file in parts[part]]
    archive = _tar(
        [*files, ("manifest", manifest.write_manifest(digests)), ("board.sh", ARMED.read_bytes() + SCRIPT.read_bytes())]
    )
    restart = "no" if not request.restart else "force" if request.force else "yes"
    command = (
        f"set -e; umask 077; mkdir -p {home}; {ALONE.format(home=home)}; rm -rf {home}/incoming; mkdir {home}/incoming; "
        f"tar -xf - -C {home}/incoming; sh {home}/incoming/board.sh {home} {restart}"
    )
    report = manifest.read_report(_ssh(request, target, command, archive, INSTALL_S))
    version, service = report.get("version", ""), report.get("service", "")
    return TargetResult(target, travels, version, service, _trouble_of(service) if request.restart else "")


def _trouble_of(service: str) -> str:
    """Reason for which a restarted service does not run; empty if it runs, or the board has none."""
    if service not in ("failed", "activating", "deactivating", "inactive"):
        return ""
    return f"its service is {service} after the restart: journalctl -u shoal-agent.service on the board says why"


def _parts(target: Target, request: DeployRequest, probe: Probe) -> dict[str, Files]:
    """Files to send to a board, by the part of its installation."""
    wheel_files = _wheel_files(request.wheels if request.wheels is not None else wheelhouse.wheels(probe))
    parts: dict[str, Files] = {
        "software": [(f"software/{path.name}", path.read_bytes()) for path in wheel_files],
        "experiment": [("experiment.toml", dump_experiment(request.experiment).encode())],
        "settings": [("init.args", "".join(f"{line}\n" for line in _init(target, request)).encode())],
    }
    if request.ring is not None:
        process = process_name(Role.ROBOT, target.robot)
        keys = open_keys(request.ring, process)
        secret = (keys.ca, keys.certificate, keys.private_key)
        parts["keys"] = [(f"keys/{process}/{path.name}", path.read_bytes()) for path in secret]
    return parts


def _wheel_files(wheels: Path) -> list[Path]:
    """The wheels in a folder. Raises ConfigError where ours is not among them."""
    files = sorted(wheels.glob("*.whl"))
    if not any(path.name.startswith("shoal-") for path in files):
        raise ConfigError(f"{wheels}: holds no wheel of shoal")
    return files


def _init(target: Target, request: DeployRequest) -> list[str]:
    """Arguments of `robot-agent init` on the board."""
    arguments = ["--force", "--robot", str(target.robot), "--station", request.station, "--fleet", request.fleet]
    arguments += ["--link", request.link, "--experiment", "experiment.toml"]
    arguments += ["--link-key", request.link_key] if request.link_key is not None else []
    return arguments + (["--keys", "keys"] if request.ring is not None else ["--insecure"] if request.insecure else [])


def _tar(files: Files) -> bytes:
    """A tar archive of files, given by name and content."""
    packed = io.BytesIO()
    with tarfile.open(fileobj=packed, mode="w") as archive:
        for name, content in files:
            entry = tarfile.TarInfo(name)
            entry.size, entry.mode = len(content), 0o600
            archive.addfile(entry, io.BytesIO(content))
    return packed.getvalue()


def _ssh(request: DeployRequest, target: Target, command: str, data: bytes, timeout_s: float) -> str:
    """Run a command on a board. Raises ConfigError with what ssh or the board says."""
    full = [*request.ssh, "-o", "BatchMode=yes", "-o", "ConnectTimeout=10", "--", target.host, f"sh -c {shlex.quote(command)}"]
    try:
        result = subprocess.run(full, input=data, capture_output=True, timeout=timeout_s, check=False)
    except subprocess.TimeoutExpired:
        raise ConfigError(f"{target.host}: no answer within {timeout_s:g} s") from None
    except OSError as error:
        raise ConfigError(f"{request.ssh[0]}: {error.strerror}") from None
    if result.returncode != 0:
        lines = result.stderr.decode(errors="replace").strip().splitlines()
        why = "; ".join(lines[-3:]) or f"exit code {result.returncode}"
        raise ConfigError(f"{target.host}: {why}")
    return result.stdout.decode(errors="replace")
