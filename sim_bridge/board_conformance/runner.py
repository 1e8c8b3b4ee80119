"""Whether a thruster board keeps the rules of docs/board.md: each one named, tried and measured, over its link alone. Pure.

sim_bridge/board_conformance/rules.py has the rules. One that `spins` commands thrust, or would cause it on a board that breaks
the rule; in a dry run these are left out.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from enum import Enum

from sim_bridge.board_conformance.probe import Probe

TRIES = 4  # of a rule that fails while the machine that examines is held up


class Verdict(Enum):
    """What became of a rule."""

    PASSED = "passed"
    FAILED = "FAILED"
    SKIPPED = "skipped"


@dataclass(frozen=True)
class Outcome:
    """One rule tried."""

    rule: str
    requirement: str
    verdict: Verdict
    measured: str


Measured = tuple[bool, str]  # whether it is as required, and what was seen


@dataclass(frozen=True)
class Rule:
    """What is required, and how it is tried."""

    name: str
    requirement: str
    check: Callable[[Probe], Measured]
    spins: bool = False
    signed: bool = False  # means something on a signed link only


def examine(probe: Probe, dry: bool, rules: Iterable[Rule]) -> Iterator[Outcome]:
    """Try the rules one after the other. Between them, and at the end, the board is disarmed."""
    for rule in rules:
        if (rule.spins and dry) or (rule.signed and probe.key is None):
            why = "dry run" if rule.spins else "the link is not signed"
            yield Outcome(rule.name, rule.requirement, Verdict.SKIPPED, why)
            continue
        for _ in range(TRIES):
            stalls = probe.stalls
            passed, measured = _try(rule, probe)
            if passed or probe.stalls == stalls:
                break
            measured += " (this machine was held up)"
        yield Outcome(rule.name, rule.requirement, Verdict.PASSED if passed else Verdict.FAILED, measured)


def _try(rule: Rule, probe: Probe) -> Measured:
    try:
        passed, measured = rule.check(probe)
    except KeyError as missing:
        passed, measured = False, f"needs the parameter {missing}"
    finally:
        rested = probe.rest()
    if passed and not rested:
        return False, f"{measured}; then it did not disarm"
    return passed, measured
