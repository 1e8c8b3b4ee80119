"""SHELL: a program whose role was not installed says so. The base installation has all four commands, and what one needs."""

import sys
from collections.abc import Callable
from importlib.util import find_spec

OURS = ("shoal", "groundstation", "robot_agent", "localizer", "sim_bridge")


def require(*packages: str) -> None:
    """Raises ModuleNotFoundError for a package that is not installed. Loads none: what is needed after a flight is missed
    before it, and a start does not wait for it."""
    for package in packages:
        if find_spec(package) is None:
            raise ModuleNotFoundError(name=package)


def run_role(run: Callable[[], None], extra: str) -> None:
    """Run a program; exit code 2 where a package is missing that `shoal[extra]` brings."""
    try:
        run()
    except ModuleNotFoundError as error:
        missing = (error.name or "").partition(".")[0]
        if missing in OURS:
            raise
        print(
            f"the package {missing} is not installed; what this needs comes with: pip install 'shoal[{extra}]'",
            file=sys.stderr,
        )
        sys.exit(2)
