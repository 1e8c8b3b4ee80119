"""SHELL: a program whose role was not installed says so. The base installation has all four commands, and what one needs."""

import sys
from collections.abc import Callable

OURS = ("shoal", "groundstation", "robot_agent", "localizer", "sim_bridge")


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
