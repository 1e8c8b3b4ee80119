"""Tests that were skipped, why, and the one command that brings what they lack: the end of `make test`.

python -m tests.skipped FOLDER        of all test processes that had SHOAL_SKIPPED=FOLDER in their environment
"""

import json
import os
import sys
import uuid
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path

FOLDER = "SHOAL_SKIPPED"  # variable of the environment: the folder where test processes note what they skipped
PACKAGES = {  # Debian package, by a word of the reason
    "chromium": "chromium",
    "sshd": "openssh-server",
    "systemd-analyze": "systemd",
    "nft": "nftables",
    "node": "npm",
    "gcc": "gcc libc6-dev",
    "avr-gcc": "gcc-avr avr-libc libsimavr-dev libelf-dev arduino-core-avr",  # all that the simulated Arduino's tests need
    "simavr": "libsimavr-dev libelf-dev",
    "arduino-core-avr": "arduino-core-avr",
}


def note(reasons: Iterable[str]) -> bool:
    """Leave the reasons for `main`, which tells them once for all processes. False if nobody asked for that."""
    folder = os.environ.get(FOLDER)
    if folder is None:
        return False
    (Path(folder) / f"{uuid.uuid4().hex}.json").write_text(json.dumps(list(reasons)), encoding="utf-8")
    return True


def summary(reasons: Iterable[str]) -> Iterator[str]:
    """Yield lines: each reason with its number of tests, and the command that lets them run."""
    counts = Counter(reasons)
    if not counts:
        return
    yield f"{counts.total()} tests were skipped:"
    yield from (f"  {count:3} {reason}" for reason, count in sorted(counts.items()))
    missing = {package: None for reason in sorted(counts) for package in _packages(reason)}
    if missing:
        yield f"What they lack comes with: sudo apt install --no-install-recommends {' '.join(missing)}"


def _packages(reason: str) -> list[str]:
    words = [word.strip(",.;:()").lower() for word in reason.split()]
    return next((PACKAGES[word].split() for word in words if word in PACKAGES), [])


def main(folder: str) -> None:
    """Print the summary of all processes that noted something in the folder."""
    noted = [json.loads(file.read_text(encoding="utf-8")) for file in sorted(Path(folder).glob("*.json"))]
    print(*summary(reason for reasons in noted for reason in reasons), sep="\n")


if __name__ == "__main__":
    main(sys.argv[1])
