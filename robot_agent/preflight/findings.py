"""Findings of the preflight: one line each, with a verdict. Pure."""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from datetime import datetime
from enum import Enum

from shoal.bus.key_ring import EXPIRES_SOON
from shoal.runtime.version import are_known

CLOCK_APART_S = 1.0  # TLS and the order of logs depend on the clocks; no age and no order does
MINUTE = "%Y-%m-%d %H:%M"
BUDGET = 0.5  # of a period: what a control step may take


class CheckVerdict(Enum):
    """Result of one check."""

    OK = "ok"
    WARN = "warn"
    FAIL = "FAIL"
    SKIPPED = "skipped"


@dataclass(frozen=True)
class CheckFinding:
    """A finding: one line of the preflight's table."""

    what: str
    verdict: CheckVerdict
    detail: str


def exit_code(findings: Sequence[CheckFinding]) -> int:
    """0 if no check has failed, else 1."""
    return int(any(finding.verdict is CheckVerdict.FAIL for finding in findings))


def to_json(findings: Sequence[CheckFinding]) -> str:
    return json.dumps([{**asdict(finding), "verdict": finding.verdict.name.lower()} for finding in findings], indent=1)


def certificate(common_name: str, starts: datetime, expires: datetime, now: datetime) -> CheckFinding:
    """Judge a certificate's period of validity."""
    days = (expires - now).days
    if now < starts:
        return CheckFinding(
            "certificate", CheckVerdict.FAIL, f"valid from {starts:{MINUTE}} UTC on; is this board's clock right?"
        )
    if now >= expires:
        return CheckFinding(
            "certificate", CheckVerdict.FAIL, f"expired on {expires:%Y-%m-%d %H:%M} UTC; `groundstation keys add` renews it"
        )
    verdict = CheckVerdict.WARN if expires - now < EXPIRES_SOON else CheckVerdict.OK
    return CheckFinding("certificate", verdict, f"{common_name}, valid for {days} days more")


def same_code(stations: str, own: str) -> CheckFinding:
    """Compare version and commit of the station's program, "" of an earlier one, with this computer's."""
    if not are_known(stations, own):
        text = f"{own}, the station's {stations or 'an earlier version'}: nobody knows whether that is the same"
        return CheckFinding("code", CheckVerdict.WARN, text)
    if stations == own:
        return CheckFinding("code", CheckVerdict.OK, f"{own}, as the station's")
    text = f"{own}, the station's {stations or 'an earlier version'} (`groundstation deploy` brings it here)"
    return CheckFinding("code", CheckVerdict.WARN, text)


def clock(offset_s: float) -> CheckFinding:
    """Judge this computer's clock against the station's heartbeat."""
    verdict = CheckVerdict.OK if abs(offset_s) <= CLOCK_APART_S else CheckVerdict.WARN
    side = "ahead of" if offset_s > 0 else "behind"
    return CheckFinding("clock", verdict, f"{abs(offset_s) * 1e3:.0f} ms {side} the station's")


def timing(p50_ms: float, p99_ms: float, period_s: float, neighbours: int) -> CheckFinding:
    """Judge a control step's time on this CPU against half a period."""
    budget_ms = BUDGET * period_s * 1e3
    verdict = CheckVerdict.OK if p99_ms <= budget_ms else CheckVerdict.WARN if p50_ms <= budget_ms else CheckVerdict.FAIL
    detail = f"p50 {p50_ms:.2f} ms, p99 {p99_ms:.2f} ms with {neighbours} neighbours; half a period is {budget_ms:g} ms"
    return CheckFinding("control step", verdict, detail)


def not_timed(why: str) -> CheckFinding:
    """Finding for a control step that could not be timed: a robot that does not fly has little to compute."""
    return CheckFinding("control step", CheckVerdict.WARN, f"not timed: in the rehearsal, a circle of 1 m at 0.3 m, {why}")
