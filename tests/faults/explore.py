"""SHELL: one target of `make fuzz` under atheris, whose instrumentation must come before the project's modules do.

python -m tests.faults.explore --target NAME --runs N --seed S
"""

import argparse

import atheris

with atheris.instrument_imports(include=["shoal", "robot_agent", "localizer", "sim_bridge", "groundstation"]):
    from tests.faults.fuzz import explore


def main() -> None:
    """See the module's docstring."""
    parser = argparse.ArgumentParser()
    for name in ("--target", "--runs", "--seed"):
        parser.add_argument(name, required=True)
    options = parser.parse_args()
    explore(options.target, int(options.runs), int(options.seed))


if __name__ == "__main__":
    main()
