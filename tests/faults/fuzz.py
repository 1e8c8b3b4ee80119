"""SHELL: `make fuzz`: a million payloads for each decoder, fewer for what takes longer, without a crash.

    python -m tests.faults.fuzz [--runs 1000000] [--target agent]

With atheris (libFuzzer) where it is installed, which learns from the code's coverage what to try next; else payloads are
random, or damaged good ones. What crashes a target is kept in .fuzz/, and tried again first the next time.
"""

import argparse
import importlib.util
import subprocess
import sys
import time
import traceback
from pathlib import Path

import numpy as np

from tests.faults.targets import TARGETS, seeds
from tests.shoal.strategies import damaged

FOLDER = Path(".fuzz")
MAX_BYTES = 2048
# What a payload takes differs by a factor of a thousand; decoders face strangers, so they get all.
SHARE = {"toml": 0.05, "logs": 0.1, "agent": 0.01, "orders": 0.02, "locator": 0.02, "board": 0.1, "mission": 0.1}
TARGET_TIMEOUT_S = 10


def bombard(name: str, runs: int, seed: int) -> int:
    """Without coverage. Returns how many payloads were too much."""
    random, good, crashes = np.random.default_rng(seed), [*_kept(name), *seeds(name)], 0
    for k in range(runs):
        if k < len(good):
            payload = good[k]
        elif random.random() < 0.7:
            payload = damaged(good[int(random.integers(len(good)))], random)[:MAX_BYTES]
        else:
            payload = random.bytes(int(random.integers(0, 600)))
        try:
            TARGETS[name](payload)
        except Exception:
            crashes += 1
            path = FOLDER / name / f"crash-{seed}-{k}"
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(payload)
            print(f"{name}: {path}\n{traceback.format_exc(limit=-3)}", flush=True)
    return crashes


def _kept(name: str) -> list[bytes]:
    return [path.read_bytes() for path in sorted((FOLDER / name).glob("crash-*"))]


def explore(name: str, runs: int, seed: int) -> None:
    """With coverage: libFuzzer ends the process, with exit code 77 at the first crash."""
    import atheris

    corpus = FOLDER / name / "corpus"
    corpus.mkdir(parents=True, exist_ok=True)
    for k, payload in enumerate([*_kept(name), *seeds(name)]):
        (corpus / f"seed-{k}").write_bytes(payload)
    options = [f"-runs={runs}", f"-seed={seed}", f"-max_len={MAX_BYTES}", f"-timeout={TARGET_TIMEOUT_S}", "-verbosity=0"]
    atheris.Setup([name, str(corpus), *options, f"-artifact_prefix={FOLDER / name}/"], TARGETS[name])
    atheris.Fuzz()


def main() -> int:
    """See the module's docstring."""
    parser = argparse.ArgumentParser(prog="make fuzz", description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--runs", type=int, default=1_000_000)
    parser.add_argument("--target", action="append", choices=TARGETS, help="only this one; repeatable")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--child", action="store_true", help="in this process, without coverage")
    options = parser.parse_args()
    guided = importlib.util.find_spec("atheris") is not None
    names = options.target or list(TARGETS)
    if options.child:
        return min(sum(bombard(name, options.runs, options.seed) for name in names), 1)
    failed = []
    for name in names:
        runs, begin_s = max(round(options.runs * SHARE.get(name, 1.0)), 1), time.monotonic()
        module = ["-m", "tests.faults.explore" if guided else "tests.faults.fuzz"]
        arguments = ["--target", name, "--runs", str(runs), "--seed", str(options.seed), *([] if guided else ["--child"])]
        code = subprocess.run([sys.executable, *module, *arguments], check=False).returncode
        failed += [name] if code else []
        how = "with coverage" if guided else "without coverage"
        print(
            f"{name}: {runs} payloads {how}, {'CRASH' if code else 'no crash'}, {time.monotonic() - begin_s:.0f} s", flush=True
        )
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
