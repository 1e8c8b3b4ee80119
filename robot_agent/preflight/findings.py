"""What was found when the board was looked over: one line each, and whether the robot may go into the water. Pure."""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from datetime import datetime
from enum import Enum

from wire.security.key_ring import EXPIRES_SOON

CLOCK_APART_S = 1.0  # TLS and the order of logs depend on the clocks; no age and no order does
MINUTE = "%Y-%m-%d %H:%M"
BUDGET = 0.5  # of a period: what a control step may take


class Verdict(Enum):
    """How it is."""

    OK = "ok"
    WARN = "warn"
    FAIL = "FAIL"
    SKIPPED = "skipped"


@dataclass(frozen=True)
class Finding:
    """One line of the table."""

    what: str
    verdict: Verdict
    detail: str


def exit_code(findings: Sequence[Finding]) -> int:
    """0 if nothing has failed."""
    return int(any(finding.verdict is Verdict.FAIL for finding in findings))


def to_json(findings: Sequence[Finding]) -> str:
    """For programs."""
    return json.dumps([{**asdict(finding), "verdict": finding.verdict.name.lower()} for finding in findings], indent=1)


def certificate(common_name: str, starts: datetime, expires: datetime, now: datetime) -> Finding:
    """Whether a certificate counts, and for how long."""
    days = (expires - now).days
    if now < starts:
        return Finding("certificate", Verdict.FAIL, f"valid from {starts:{MINUTE}} UTC on; is this board's clock right?")
    if now >= expires:
        return Finding(
            "certificate", Verdict.FAIL, f"expired on {expires:%Y-%m-%d %H:%M} UTC; `groundstation keys add` renews it"
        )
    verdict = Verdict.WARN if expires - now < EXPIRES_SOON else Verdict.OK
    return Finding("certificate", verdict, f"{common_name}, valid for {days} days more")


def clock(offset_s: float) -> Finding:
    """This board's clock against the station's, as its heartbeat tells it."""
    verdict = Verdict.OK if abs(offset_s) <= CLOCK_APART_S else Verdict.WARN
    side = "ahead of" if offset_s > 0 else "behind"
    return Finding("clock", verdict, f"{abs(offset_s) * 1e3:.0f} ms {side} the station's")


def timing(p50_ms: float, p99_ms: float, period_s: float, neighbours: int) -> Finding:
    """A control step's time on this CPU against half a period."""
    budget_ms = BUDGET * period_s * 1e3
    verdict = Verdict.OK if p99_ms <= budget_ms else Verdict.WARN if p50_ms <= budget_ms else Verdict.FAIL
    detail = f"p50 {p50_ms:.2f} ms, p99 {p99_ms:.2f} ms with {neighbours} neighbours; half a period is {budget_ms:g} ms"
    return Finding("control step", verdict, detail)


def not_timed(why: str) -> Finding:
    """No time of a control step is known: a robot that does not fly has little to compute."""
    return Finding("control step", Verdict.WARN, f"not timed: in the rehearsal, a circle of 1 m at 0.3 m, {why}")
