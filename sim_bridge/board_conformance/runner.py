"""Conformance run: each rule of docs/board.md named, tried and measured over a thruster board's link. Pure.

sim_bridge/board_conformance/rules.py has the rules. A rule that `spins` commands thrust, or would cause it on a board that
breaks the rule; a dry run skips these.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from enum import Enum

from sim_bridge.board_conformance.probe import BoardProbe

TRIES = 4  # attempts of a rule that fails while the examining machine is held up


class RuleVerdict(Enum):
    """Verdict on a rule."""

    PASSED = "passed"
    FAILED = "FAILED"
    SKIPPED = "skipped"


@dataclass(frozen=True)
class RuleResult:
    rule: str
    requirement: str
    verdict: RuleVerdict
    measured: str


Measured = tuple[bool, str]  # True if as required; the measured figures


@dataclass(frozen=True)
class Rule:
    """A requirement and its check."""

    name: str
    requirement: str
    check: Callable[[BoardProbe], Measured]
    spins: bool = False
    signed: bool = False  # applies to signed links only


def examine(probe: BoardProbe, dry: bool, rules: Iterable[Rule]) -> Iterator[RuleResult]:
    """Try the rules one after the other. After each, however it ends, the board is disarmed and has its own parameters again;
    else the rule has failed."""
    for rule in rules:
        if (rule.spins and dry) or (rule.signed and probe.key is None):
            why = "dry run" if rule.spins else "the link is not signed"
            yield RuleResult(rule.name, rule.requirement, RuleVerdict.SKIPPED, why)
            continue
        for _ in range(TRIES):
            stalls = probe.stalls
            passed, measured = _check_rule(rule, probe)
            if passed or probe.stalls == stalls:
                break
            measured += " (this machine was held up)"
        yield RuleResult(rule.name, rule.requirement, RuleVerdict.PASSED if passed else RuleVerdict.FAILED, measured)


def _check_rule(rule: Rule, probe: BoardProbe) -> Measured:
    """Check a rule, and bring the board back to rest with its own parameters."""
    try:
        passed, measured = rule.check(probe)
    except KeyError as missing:
        passed, measured = False, f"needs the parameter {missing}"
    finally:
        rested, remaining = probe.rest(), probe.put_back()
    if remaining:
        return False, f"{measured}; {', '.join(remaining)} has to be put back by hand"
    if passed and not rested:
        return False, f"{measured}; then it did not disarm"
    return passed, measured
