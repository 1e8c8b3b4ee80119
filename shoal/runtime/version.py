"""SHELL: which code this is: the project's version and the commit of git, for logs, results and `--version`.

Two runs can be compared only if one knows what flew them. From a work tree git says it, with a mark and a digest of what was
changed since; in an installed package the build has written it down (setup.py); else, and where git could not be asked in
time, it is "unknown", which is neither the same code as another nor different code. Imports the standard library only: the
build runs this file by itself.
"""

import hashlib
import os
import subprocess
from dataclasses import dataclass
from functools import cache
from importlib import metadata
from pathlib import Path

ROOT = Path(__file__).parents[2]
PACKAGES = ("shoal", "groundstation", "robot_agent", "localizer", "sim_bridge")
RECORDED = "commit.txt"  # in shoal/, in an installed package
UNKNOWN = "unknown"
PATIENCE_S = 10.0  # for git on a slow disk; without an answer the commit is unknown


@dataclass(frozen=True)
class Code:
    """The version and the commit of the running code."""

    version: str  # of the project
    commit: str  # 40 hex digits, "+changed." and a digest where files differ from it; or "unknown"

    def __str__(self) -> str:
        return f"shoal {self.version}, commit {self.commit}"

    @property
    def short(self) -> str:
        """Version and commit in few characters, for messages."""
        head, mark, changes = self.commit.partition("+")
        return f"{self.version} {head[:8]}{mark}{changes}"


def are_known(*codes: str) -> bool:
    """True if all of these commits, or texts of Code.short, say which code they are of; only then they can be compared."""
    return not any(one.endswith(UNKNOWN) for one in codes)


@cache
def code() -> Code:
    """The code of this process. Asks git once."""
    try:
        version = metadata.version("shoal")
    except metadata.PackageNotFoundError:
        version = UNKNOWN
    return Code(version, commit(ROOT))


def commit(root: Path) -> str:
    """The commit of the packages in a folder. Where git has one and cannot say it now, as on a disk that takes too long, it is
    unknown: what a build has left there may be of other code."""
    try:
        return (_work_tree_commit(root) if _is_work_tree(root) else _recorded(root)) or UNKNOWN
    except (OSError, subprocess.SubprocessError, UnicodeDecodeError):
        return UNKNOWN


def _is_work_tree(root: Path) -> bool:
    """True if git has the packages in a folder (an environment may lie within somebody else's work tree). Raises
    SubprocessError or OSError if it does not say."""
    try:
        _git(root, "ls-files", "--error-unmatch", "--", "shoal/runtime/version.py")
    except FileNotFoundError:  # no git here
        return False
    except subprocess.CalledProcessError as error:
        if error.returncode < 0:  # killed before it could say
            raise
        return False
    return True


def _work_tree_commit(root: Path) -> str:
    """Commit as git has it, with a mark where files differ from it. Raises SubprocessError or OSError if it does not say."""
    head = _git(root, "rev-parse", "--verify", "HEAD").decode("ascii").strip()
    changes = hashlib.sha256(_git(root, "diff", "HEAD", "--no-ext-diff", "--no-textconv", "--binary", "--", *PACKAGES))
    unchanged = changes.hexdigest() == hashlib.sha256().hexdigest()
    new = _git(root, "ls-files", "-z", "--others", "--exclude-standard", "--", *PACKAGES).split(b"\0")
    for name in sorted(filter(None, new)):
        changes.update(name + b"\0" + (root / os.fsdecode(name)).read_bytes())
        unchanged = False
    return head if unchanged else f"{head}+changed.{changes.hexdigest()[:8]}"


def _recorded(root: Path) -> str:
    """The commit that was recorded when this code was packed; empty if there is none."""
    try:
        return (root / "shoal" / RECORDED).read_text(encoding="ascii").strip()
    except (OSError, UnicodeDecodeError):
        return ""


def _git(root: Path, *arguments: str) -> bytes:
    """The output of git. Raises SubprocessError or OSError."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith("GIT_")}
    return subprocess.run(
        ["git", *arguments],
        cwd=root,
        env={**environment, "GIT_OPTIONAL_LOCKS": "0"},
        stdin=subprocess.DEVNULL,
        capture_output=True,
        timeout=PATIENCE_S,
        check=True,
    ).stdout
