"""SHELL: configuration of one robot's computer: the robot's number, its devices, the address of its station.

The experiment is the same on every robot; this file holds the differences between robots.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Self

import tomli_w
from pydantic import AfterValidator, Field, model_validator

from shoal.config import LARGEST_ROBOT
from shoal.config.loader import Section, check, read_toml
from shoal.errors import ConfigError
from shoal.mavlink.board_address import DEFAULT_LINK, PORTS_BY_ID
from shoal.mavlink.board_port import Link, open_link
from shoal.mavlink.signing_key import Signing
from shoal.runtime.cli_options import DEFAULT_FLEET, DEFAULT_STATION, fleet_name

TEMPLATE = """\
# What this board is, for `robot-agent run --config {name}`, `robot-agent check` and the systemd unit.
# Paths may be relative to this file.

# Its number in the experiment.
robot = {robot}
# What is flown: a shipped experiment or a path. It must be the station's, key by key.
{experiment}
# Where the ground station's Zenoh router listens, and the fleet's name: fleets of different names ignore each other.
{station}
{fleet}
# The thruster board: serial:DEVICE[:BAUD] or udp:HOST:PORT. Names in {ports} stay with a board; /dev/ttyACM0 is the
# first one that is found, and may be another board's after a reboot.
{link}
# A key that signs this link (`robot-agent link-key FILE`; the board has the same). UDP to another machine needs one, or
# link_insecure = true:
{link_key}

# The key ring, with this robot's folder (agent-{robot}) in it. Off this machine a fleet needs keys; without them the network
# is open to everybody who is on it, and that must be said (insecure = true):
{keys}
{insecure}

[realtime]
# What the operating system allows is done, and the rest is told in the log. The systemd unit allows all of it.
# SCHED_FIFO priority of the control loop, 1 to 99; 0 leaves it to the ordinary scheduler.
priority = 20
# Pin the process, with all its threads, to these CPU cores, for example [3]; empty: any.
cores = []
# Keep what it uses out of swap.
lock_memory = true
"""


class RealtimeConfig(Section):
    """Requests to the operating system."""

    priority: Annotated[int, Field(ge=0, le=99)] = 0
    cores: tuple[Annotated[int, Field(ge=0)], ...] = ()
    lock_memory: bool = False


class AgentConfig(Section):
    """The whole file."""

    robot: Annotated[int, Field(ge=1, le=LARGEST_ROBOT)]
    experiment: str
    station: str
    fleet: Annotated[str, AfterValidator(fleet_name)] = DEFAULT_FLEET
    link: str = DEFAULT_LINK
    link_key: str | None = None
    link_insecure: bool = False
    keys: str | None = None
    insecure: bool = False
    settings: tuple[str, ...] = ()
    realtime: RealtimeConfig = RealtimeConfig()

    @model_validator(mode="after")
    def _keys_or_not(self) -> Self:
        if self.insecure and self.keys is not None:
            raise ValueError("insecure = true beside keys: with keys the network is not open; leave one of them out")
        return self


def load_agent_config(path: Path) -> AgentConfig:
    """Load and check the file, with its paths made absolute. Raises ConfigError."""
    config = check(AgentConfig, read_toml(path), str(path))
    beside = path.resolve().parent
    changes = {}
    if config.keys is not None:
        changes["keys"] = str(beside / config.keys)
    if config.link_key is not None:
        changes["link_key"] = str(beside / config.link_key)
    if config.experiment.endswith(".toml"):
        changes["experiment"] = str(beside / config.experiment)
    return config.model_copy(update=changes)


def merge_config(given: Mapping[str, Any], config: Path | None) -> AgentConfig:
    """Configuration of a command line: values `given` (not None) go before the file, the file before the defaults."""
    table: dict[str, Any] = {"station": DEFAULT_STATION}
    if config is not None:
        table |= load_agent_config(config).model_dump()
    table |= {key: value for key, value in given.items() if value is not None}
    for key, how in (("experiment", "name it"), ("robot", "--robot N")):
        if key not in table:
            raise ConfigError(f"which {key}? {how}, or --config FILE (`robot-agent init` writes one)")
    return check(AgentConfig, table, "command line" if config is None else f"command line and {config}")


def open_board_link(config: AgentConfig) -> tuple[Link, Signing | None]:
    """Open the link to the thruster board, with its signing key if there is one. Raises ConfigError."""
    signing = Signing.of(Path(config.link_key), "agent") if config.link_key is not None else None
    return open_link(config.link, secured=signing is not None or config.link_insecure), signing


def template(name: str, config: AgentConfig) -> str:
    """Commented configuration file, as `init` writes it."""
    given = config.model_dump(include={"experiment", "station", "fleet", "link", "link_key", "keys"}, exclude_none=True)
    written = {key: tomli_w.dumps({key: value}).rstrip() for key, value in given.items()}
    left_out = {"link_key": '# link_key = "link.key"', "keys": '# keys = "keys"'}
    insecure = "insecure = true" if config.insecure else "# insecure = true"
    return TEMPLATE.format(name=name, robot=config.robot, insecure=insecure, ports=PORTS_BY_ID, **{**left_out, **written})
