"""SHELL: turn each thruster a little, one after another, and compare with the board's echo. The robot must be free to move.

Pulses go out at the control rate, as in flight, so the board's own rules (arming, rate, age) hold all the time. However it
ends, also by a signal or a closed terminal, the last things sent are neutral pulses and a disarm.
"""

import signal
import time
from collections.abc import Iterator
from types import FrameType

from robot_agent.host.config import AgentConfig, open_board_link
from robot_agent.preflight.findings import CheckFinding, CheckVerdict
from robot_agent.safety.thruster_selftest import THRUSTERS, TOLERANCE_US, one_pushed, push_pulse_us
from robot_agent.vehicle.allocation import Allocator
from wire.config.experiment import Experiment
from wire.mavlink.agent_link import AgentLink
from wire.mavlink.board_port import Link
from wire.mavlink.signing_key import agent_end

TURN_S, REST_S = 0.6, 0.4  # long enough for a person to see which one it is
ARM_WITHIN_S = 2.0
THRUST_SHARE = 0.15  # of the largest thrust: turns, and tips nothing over


class _Bench:
    """Link to the board, with pulses sent at the control rate."""

    def __init__(self, experiment: Experiment, link: Link, mavlink: AgentLink) -> None:
        self._link, self._mavlink = link, mavlink
        self._period_s = experiment.controller.period_s
        self.neutral_us = Allocator(experiment.vehicle).neutral_us
        self.turn_us = push_pulse_us(experiment.vehicle, THRUST_SHARE * experiment.vehicle.thruster.max_thrust_n)

    @property
    def armed(self) -> bool:
        return self._mavlink.telemetry.armed

    @property
    def said(self) -> str:
        """The board's last text."""
        texts = self._mavlink.telemetry.texts
        return texts[-1][1] if texts else "it does not say why"

    def hold(self, pulse_us: tuple[int, ...], seconds: float, arm: bool | None = None) -> list[tuple[int, ...]]:
        """Send pulses for a while; with `arm` also ask the board to arm or disarm, until it has. Returns the echoes."""
        echoes: list[tuple[int, ...]] = []
        end_s = time.monotonic() + seconds
        while time.monotonic() < end_s:
            if arm is not None:
                self._link.send(self._mavlink.arm(arm))
            self._link.send(self._mavlink.heartbeat() + self._mavlink.pulses(pulse_us))
            time.sleep(self._period_s)
            self._mavlink.receive(self._link.read(), time.monotonic_ns())
            echoes.append(self._mavlink.telemetry.echo_us)
            if arm is not None and self.armed == arm:
                break
        return echoes


def turn_thrusters(experiment: Experiment, config: AgentConfig) -> Iterator[CheckFinding]:
    """Yield one finding per thruster. The caller has made sure that no hand is near."""
    link, signing = open_board_link(config)
    before = {number: signal.signal(number, _end) for number in (signal.SIGTERM, signal.SIGHUP)}
    bench = _Bench(experiment, link, agent_end(config.robot, signing))
    try:
        bench.hold(bench.neutral_us, ARM_WITHIN_S, arm=True)
        if not bench.armed:
            yield CheckFinding("thrusters", CheckVerdict.FAIL, f"the board does not arm: {bench.said}")
            return
        for i in range(THRUSTERS):
            wanted = one_pushed(bench.neutral_us, i, bench.turn_us)
            echoes = bench.hold(wanted, TURN_S)
            bench.hold(bench.neutral_us, REST_S)
            yield judge(i, wanted, echoes)
    finally:
        bench.hold(bench.neutral_us, ARM_WITHIN_S, arm=False)
        link.close()
        for number, handler in before.items():
            signal.signal(number, handler)


def _end(number: int, frame: FrameType | None) -> None:
    """Signal handler: end as Ctrl-C does, through the `finally` blocks."""
    raise SystemExit(128 + number)


def judge(i: int, wanted: tuple[int, ...], echoes: list[tuple[int, ...]]) -> CheckFinding:
    """Compare echoes with the pulses for thruster i (from 0); no other one may turn."""
    what = f"thruster {i + 1}"
    full = [echo[:THRUSTERS] for echo in echoes if len(echo) >= THRUSTERS]
    if not full:
        return CheckFinding(what, CheckVerdict.FAIL, "the board does not say what it puts out")
    nearest = min(full, key=lambda echo: abs(echo[i] - wanted[i]))
    if abs(nearest[i] - wanted[i]) > TOLERANCE_US:
        return CheckFinding(what, CheckVerdict.FAIL, f"told {wanted[i]} us, put out {nearest[i]} us")
    others = [k + 1 for k in range(THRUSTERS) if k != i and abs(nearest[k] - wanted[k]) > TOLERANCE_US]
    if others:
        return CheckFinding(what, CheckVerdict.FAIL, f"thruster {others[0]} turned as well")
    return CheckFinding(
        what, CheckVerdict.OK, f"{wanted[i]} us, as the board says too; did the right one turn, pushing ahead?"
    )
