"""Content of a robot's board, and the part of it that has changed. Pure: bytes and answers are arguments.

A board's software, keys, experiment and settings are four parts, each with a digest of its content. The board keeps the list
of the digests that it has; what is the same does not travel, so a second deployment changes nothing and restarts nothing.
"""

import hashlib
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from shoal.errors import ConfigError

PARTS = ("software", "keys", "experiment", "settings")
PLATFORMS = {  # of wheels that run there, newest last; 2.28 is Debian 10 and later
    "x86_64": ("manylinux_2_17", "manylinux2014", "manylinux_2_24", "manylinux_2_27", "manylinux_2_28"),
    "aarch64": ("manylinux_2_17", "manylinux2014", "manylinux_2_24", "manylinux_2_27", "manylinux_2_28"),
}
OLDEST_PYTHON = (3, 11)


@dataclass(frozen=True)
class Target:
    """One board: how ssh calls it, and which robot it is."""

    host: str
    robot: int


@dataclass(frozen=True)
class Probe:
    """Answers of a board about itself."""

    machine: str
    python: str  # 3.11
    manifest: Mapping[str, str]
    agent: str = ""  # what the agent does, if it runs and is not disarmed: a mode's name, or "unknown"
    restart_due: bool = False  # what came last was installed without a restart
    ports: tuple[str, ...] = ()  # serial ports, by the names that stay with a device
    has_device: bool = False  # the link's serial port is there

    @property
    def platforms(self) -> tuple[str, ...]:
        """Wheel platforms, as pip calls them."""
        return tuple(f"{name}_{self.machine}" for name in PLATFORMS[self.machine])


def parse_target(text: str) -> Target:
    """Parse a board's address and robot, [USER@]HOST=ROBOT. Raises ConfigError."""
    host, equals, robot = text.rpartition("=")
    # A host that begins with a dash would be an option to ssh.
    if not equals or not re.fullmatch(r"[A-Za-z0-9_][\w.@:-]*", host) or not robot.isdecimal() or not 0 < int(robot) < 1000:
        raise ConfigError(f"{text!r}: not a board (write [USER@]HOST=ROBOT, for example pi@192.0.2.21=1)")
    return Target(host, int(robot))


def parse_targets(texts: Sequence[str]) -> tuple[Target, ...]:
    """Parse several boards, each [USER@]HOST=ROBOT. Raises ConfigError if a robot or a board is named twice."""
    targets = tuple(map(parse_target, texts))
    for values, what in (([str(t.robot) for t in targets], "robot"), ([t.host for t in targets], "board")):
        doubled = [v for v in values if values.count(v) > 1]
        if doubled:
            raise ConfigError(f"{what} {doubled[0]} is named twice")
    return targets


def check_home(home: str) -> None:
    """Refuse a folder that cannot be a board's home. Raises ConfigError."""
    if not re.fullmatch(r"/[\w./-]+", home, re.ASCII):
        raise ConfigError(f"--home {home!r}: no folder for a board (allowed: an absolute path of letters, digits, . _ - /)")


PROBE = (  # behind templates/armed.sh; {ports} is a folder, {device} the link's serial port
    "uname -m; python3 -c 'import sys, venv, ensurepip; print(\"%d.%d\" % sys.version_info[:2])' 2>/dev/null || echo none; "
    "armed | sed 's/^/agent /'; ls {ports} 2>/dev/null | sed 's/^/port /'; [ ! -e {device} ] || echo device there; "
    "there={home}; while [ ! -e $there ]; do there=$(dirname $there); done; "
    "[ -d $there ] && [ -w $there ] || echo closed {home} $(id -un); "
    "cat {home}/manifest 2>/dev/null || true"
)


def read_probe(host: str, answer: str) -> Probe:
    """A board's answer to PROBE. Raises ConfigError for a board that cannot run the agent, saying what it lacks."""
    machine, python, *manifest = [*answer.splitlines(), "", ""]
    if machine not in PLATFORMS:
        raise ConfigError(f"{host}: is a {machine or 'silent machine'} (the packages exist for {', '.join(PLATFORMS)})")
    if not re.fullmatch(r"\d+\.\d+", python):
        raise ConfigError(f"{host}: no Python with venv (Debian: apt install python3-venv)")
    if tuple(map(int, python.split("."))) < OLDEST_PYTHON:
        raise ConfigError(f"{host}: Python {python}, needs {'.'.join(map(str, OLDEST_PYTHON))} or newer")
    facts = dict(line.split(" ", 1) for line in manifest if " " in line)
    if "closed" in facts:
        home, _, user = facts["closed"].partition(" ")
        raise ConfigError(
            f"{host}: {user} may not write {home} there (allowed: another --home; "
            f"or once, on the board: sudo install -d -o {user} -m 755 {home})"
        )
    parts = {part: facts[part] for part in PARTS if part in facts}
    ports = tuple(line.removeprefix("port ") for line in manifest if line.startswith("port "))
    return Probe(machine, python, parts, facts.get("agent", ""), "restart" in facts, ports, "device" in facts)


def refuse_to_restart(target: Target, probe: Probe) -> None:
    """Raises ConfigError for a board whose agent is not surely disarmed: a restart would disarm a robot in flight."""
    if probe.agent == "unknown":
        raise ConfigError(
            f"{target.host}: the agent of robot {target.robot} runs, and does not say whether it is armed (an older version): "
            "see that it rests, then --force; or --no-restart"
        )
    if probe.agent:
        raise ConfigError(
            f"{target.host}: robot {target.robot} is {probe.agent}, and a restart would disarm it at once: "
            "disarm it first (groundstation mission disarm); or --no-restart, or --force"
        )


def digest(files: Iterable[tuple[str, bytes]]) -> str:
    """Digest of files' names and contents, in any order: 16 hex digits."""
    total = hashlib.sha256()
    for name, content in sorted(files):
        total.update(f"{name}\0{hashlib.sha256(content).hexdigest()}\n".encode())
    return total.hexdigest()[:16]


def changed(wanted: Mapping[str, str], there: Mapping[str, str]) -> tuple[str, ...]:
    """Parts that must travel."""
    return tuple(part for part in PARTS if part in wanted and wanted[part] != there.get(part))


def write_manifest(wanted: Mapping[str, str]) -> bytes:
    """The manifest as the board keeps it: a part and its digest per line."""
    return "".join(f"{part} {wanted[part]}\n" for part in PARTS if part in wanted).encode()


def read_report(output: str) -> dict[str, str]:
    """The key=value lines that the board's script prints."""
    return dict(line.split("=", 1) for line in output.splitlines() if re.match(r"[a-z]+=", line))
