"""SHELL: the systemd unit, with a board's paths and user in it."""

import re
from importlib import resources

from wire.toml_loader import ConfigError

NAME = "shoal-agent.service"


def unit(home: str, user: str) -> str:
    """The unit of an agent that lives in `home` and runs as `user`. Raises ConfigError for what systemd would misread."""
    if not re.fullmatch(r"/[\w./-]+", home):
        raise ConfigError(f"{home!r}: not a folder for a unit file (allowed: an absolute path of letters, digits, . _ - /)")
    if not re.fullmatch(r"[a-z_][\w-]*", user):
        raise ConfigError(f"{user!r}: not a user's name")
    text = (resources.files("robot_agent.host") / "templates" / NAME).read_text(encoding="utf-8")
    return text.replace("@HOME@", home.rstrip("/")).replace("@USER@", user)
