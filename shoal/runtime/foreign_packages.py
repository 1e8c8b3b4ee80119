"""SHELL: packages of another installation that PYTHONPATH puts before this program's own, as ROS's setup files do."""

import os
import sys
import sysconfig
import traceback
from pathlib import Path


def foreign_package(error: BaseException) -> str:
    """Text about a package from PYTHONPATH that this installation has as well, and that is loaded or has failed to with this
    error; empty if there is none."""
    variable = os.environ.get("PYTHONPATH", "")
    folders = [Path(entry).resolve() for entry in variable.split(os.pathsep) if entry]
    own = [Path(sysconfig.get_path(kind)).resolve() for kind in ("purelib", "platlib")]
    failed = [frame.f_globals for frame, _ in traceback.walk_tb(error.__traceback__)]
    files = {name: getattr(module, "__file__", None) for name, module in sorted(sys.modules.items())}
    files |= {str(module.get("__name__")): module.get("__file__") for module in failed}
    for name, file in files.items():
        if file is None or "." in name or _is_in(file, own) or not _is_in(file, folders):
            continue
        if any((folder / name).is_dir() or any(folder.glob(f"{name}.*")) for folder in own):
            return f"PYTHONPATH={variable}: puts {file} before this program's own {name} (remedy: env -u PYTHONPATH ...)"
    return ""


def _is_in(file: str, folders: list[Path]) -> bool:
    """True if a file lies in one of the folders, or below it."""
    return any(Path(file).resolve().is_relative_to(folder) for folder in folders)
