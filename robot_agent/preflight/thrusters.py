"""SHELL: move each thruster and each ankle a little, one after another. The board's echo is compared, and a person is asked.

Pulses go out at the control rate, as in flight, so the board's own rules (arming, rate, age) hold all the time. However it
ends, also by a signal or a closed terminal, the last things sent are neutral pulses and a disarm.
"""

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import replace

from robot_agent.host.config import AgentConfig, open_board_link
from robot_agent.preflight.findings import CheckFinding, CheckVerdict
from robot_agent.preflight.robot_picture import part, picture, place
from robot_agent.safety.thruster_selftest import TOLERANCE_US, one_pushed, push_pulse_us
from shoal.config.experiment import Experiment
from shoal.config.vehicle import LEGS, Vehicle
from shoal.mavlink.agent_link import CHANNELS, AgentLink
from shoal.mavlink.board_port import Link
from shoal.mavlink.signing_key import agent_end
from shoal.runtime.runtime import signals_raise

TURN_S, REST_S = 0.6, 0.4  # long enough for a person to see which one it is
ARM_WITHIN_S = 2.0
ANKLE_DEG = 30  # degrees
STRAYS = 2  # echoes in which another output moves: one may be wrong
NOT_ARMED = "the board does not arm"
THRUST_SHARE = 0.15  # of the largest thrust: turns, and tips nothing over


class _Bench:
    """Link to the board, with pulses sent at the control rate."""

    def __init__(self, experiment: Experiment, link: Link, mavlink: AgentLink) -> None:
        self._link, self._mavlink = link, mavlink
        self._period_s = experiment.controller.period_s
        self.vehicle, self.neutral_us = experiment.vehicle, experiment.vehicle.neutral_us
        legs = experiment.vehicle.legs
        if legs is not None:
            share = min(math.radians(ANKLE_DEG) / legs.ankle_range_rad, 1.0)
            self.ankle_us = round(self.neutral_us[LEGS] + share * (legs.ankle_us[1] - self.neutral_us[LEGS]))
        self.turn_us = push_pulse_us(experiment.vehicle, THRUST_SHARE * experiment.vehicle.thruster.max_thrust_n)

    @property
    def armed(self) -> bool:
        return self._mavlink.telemetry.armed

    @property
    def last_text(self) -> str:
        """The board's last text."""
        texts = self._mavlink.telemetry.texts
        return texts[-1][1] if texts else "it does not say why"

    def hold(self, pulse_us: tuple[int, ...], seconds: float, arm: bool | None = None) -> list[tuple[int, ...]]:
        """Send pulses for a while; with `arm` also ask the board to arm or disarm, until it has. Returns the echoes."""
        echoes: list[tuple[int, ...]] = []
        end_s = time.monotonic() + seconds
        while time.monotonic() < end_s:
            self._link.send(self._mavlink.heartbeat())
            if self._mavlink.telemetry.is_thruster_board:  # an autopilot would take pulses for a pilot's sticks
                if arm is not None:
                    self._link.send(self._mavlink.arm(arm))
                self._link.send(self._mavlink.pulses(pulse_us))
            time.sleep(self._period_s)
            self._mavlink.receive(self._link.read(), time.monotonic_ns())
            echoes.append(self._mavlink.telemetry.echo_us)
            if arm is not None and self.armed == arm and not self._mavlink.telemetry.arm_open:
                break
        return echoes


def turn_thrusters(
    experiment: Experiment, config: AgentConfig, ask: Callable[[str], bool] | None = None
) -> Iterator[CheckFinding]:
    """Move each thruster, then each ankle; yield one finding for each. The caller has made sure that no hand is near.

    `ask` puts a question to a person and returns the answer: before each move, with a picture of what should move, and after
    it. The board is disarmed whenever a person is asked. Without `ask` the board's echo alone is judged.
    """
    link, signing = open_board_link(config)
    bench = _Bench(experiment, link, agent_end(config.robot, signing))
    with signals_raise():
        try:
            for channel in range(CHANNELS):
                if not can_move(experiment.vehicle, channel):
                    continue
                if ask is not None and not ask(
                    f"\n{picture(experiment.vehicle, channel)}\n{_watch(experiment, channel)} Move it now?"
                ):
                    yield CheckFinding(part(experiment.vehicle, channel), CheckVerdict.SKIPPED, "not moved: not wanted")
                    continue
                finding = _move(bench, channel)
                yield finding if ask is None or finding.verdict is not CheckVerdict.OK else _with_answer(ask, finding)
                if finding.detail.startswith(NOT_ARMED):
                    return
        finally:
            bench.hold(bench.neutral_us, ARM_WITHIN_S, arm=False)
            link.close()


def can_move(vehicle: Vehicle, channel: int) -> bool:
    """True if there is a thruster or an ankle on the output."""
    return vehicle.legs is not None or any(thruster.channel == channel + 1 for thruster in vehicle.thrusters)


def _move(bench: _Bench, channel: int) -> CheckFinding:
    """Move one output there and back on a board that is armed for it."""
    bench.hold(bench.neutral_us, ARM_WITHIN_S, arm=True)
    if not bench.armed:
        return CheckFinding(part(bench.vehicle, channel), CheckVerdict.FAIL, f"{NOT_ARMED}: {bench.last_text}")
    pulses = one_pushed(bench.neutral_us, channel, bench.turn_us if channel < bench.vehicle.thruster_count else bench.ankle_us)
    echoes = bench.hold(pulses, TURN_S)
    bench.hold(bench.neutral_us, REST_S)
    bench.hold(bench.neutral_us, ARM_WITHIN_S, arm=False)
    return judge(bench.vehicle, channel, pulses, echoes)


def _watch(experiment: Experiment, channel: int) -> str:
    """The text about what a person should see."""
    vehicle, where = experiment.vehicle, place(experiment.vehicle, channel)
    what = part(vehicle, channel)
    if vehicle.legs is None:
        direction = ", ".join(f"{number:.2g}" for number in vehicle.thruster_places[channel][3:])
        return f"{what}, {where}, turns slowly and pushes the robot towards ({direction}): ahead, to starboard, down."
    if channel < LEGS:
        return f"{what}, {where}, turns slowly and pushes ahead: its jet goes astern."
    return f"{what}, {where}, turns by {ANKLE_DEG} degrees and back: its jet goes up, thrust would point down."


def _with_answer(ask: Callable[[str], bool], finding: CheckFinding) -> CheckFinding:
    """The finding with what the person has seen."""
    if ask(f"Did {finding.what} move so, and nothing else?"):
        return replace(finding, detail=f"{finding.detail}; seen")
    return CheckFinding(finding.what, CheckVerdict.FAIL, "moved otherwise, as the person says, and the board says as told")


def judge(vehicle: Vehicle, channel: int, pulses_us: tuple[int, ...], echoes: list[tuple[int, ...]]) -> CheckFinding:
    """Compare echoes with the pulses for one output (from 0); no other one may move."""
    what, outputs = part(vehicle, channel), range(len(pulses_us))
    full = [echo for echo in echoes if len(echo) >= len(pulses_us)]
    if not full:
        return CheckFinding(what, CheckVerdict.FAIL, "the board does not say what it puts out")
    nearest = min(full, key=lambda echo: abs(echo[channel] - pulses_us[channel]))
    if abs(nearest[channel] - pulses_us[channel]) > TOLERANCE_US:
        return CheckFinding(what, CheckVerdict.FAIL, f"told {pulses_us[channel]} us, put out {nearest[channel]} us")
    strayed = [sum(abs(echo[k] - pulses_us[k]) > TOLERANCE_US for echo in full) for k in outputs]
    others = [k for k in outputs if k != channel and strayed[k] >= min(STRAYS, len(full))]
    if others:
        return CheckFinding(what, CheckVerdict.FAIL, f"{part(vehicle, others[0])} moved as well")
    return CheckFinding(what, CheckVerdict.OK, f"{pulses_us[channel]} us, as the board says too")
