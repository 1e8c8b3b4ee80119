"""SHELL: packages of another installation that PYTHONPATH puts before this program's own, as ROS's setup files do."""

import os
import sys
import sysconfig
from pathlib import Path


def foreign_package() -> str:
    """Text about a loaded package from PYTHONPATH that this installation has as well; empty if there is none."""
    variable = os.environ.get("PYTHONPATH", "")
    folders = [Path(entry).resolve() for entry in variable.split(os.pathsep) if entry]
    own = [Path(sysconfig.get_path(kind)).resolve() for kind in ("purelib", "platlib")]
    for name, module in sorted(sys.modules.items()):
        file = getattr(module, "__file__", None)
        if file is None or "." in name or not any(Path(file).resolve().is_relative_to(folder) for folder in folders):
            continue
        if any((folder / name).is_dir() or any(folder.glob(f"{name}.*")) for folder in own):
            return f"PYTHONPATH={variable}: puts {file} before this program's own {name} (remedy: env -u PYTHONPATH ...)"
    return ""
