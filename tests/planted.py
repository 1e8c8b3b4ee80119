"""A working folder with other people's files in it, named like modules that the project's programs import."""

import sys
from pathlib import Path

NAMES = ("numpy", "serial", "selectors", "queue", "random", "groundstation", "sim_bridge")
MARK = "EXECUTED"


def plant(folder: Path) -> Path:
    """Make such a folder. A module that is imported from it leaves a mark, and ends its process."""
    folder.mkdir(exist_ok=True)
    for name in NAMES:
        code = f"open({str(folder / MARK)!r}, 'a').write({name + ' '!r})\nraise SystemExit(7)\n"
        (folder / f"{name}.py").write_text(code)
    return folder


def executed(folder: Path) -> str:
    """Names of modules that were imported from such a folder."""
    mark = folder / MARK
    return mark.read_text() if mark.exists() else ""


def installed(program: str) -> str:
    """The path of an installed program, as a person starts it: `python -m` would itself look in the working folder."""
    return str(Path(sys.executable).with_name(program))
