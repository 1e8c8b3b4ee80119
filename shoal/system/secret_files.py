"""Files that hold a secret: nobody but their owner may read or write them."""

import stat
from pathlib import Path

from shoal.errors import ConfigError, os_errors_as_config_errors


def refuse_shared(path: Path, what: str) -> None:
    """Raise ConfigError if another user may read or write the file, which holds `what`."""
    with os_errors_as_config_errors(path):
        mode = stat.S_IMODE(path.stat().st_mode)
    if mode & 0o077:
        raise ConfigError(f"{path}: mode {mode:04o} lets others read {what} (allowed: 0600; chmod 600 {path})")
