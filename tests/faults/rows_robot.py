"""Faults on a robot: its computer, the wire to its board, the board, its thrusters, its battery."""

import signal
import time

import numpy as np

from shoal.messages.messages import CommandKind, Mode, Solve, required
from tests.faults.rig import Rig
from tests.faults.row import OFF, POWERED, RESUMED, Random, Sample, resumed
from tests.faults.wires import LineTrouble, forgeries
from tests.flights.broken_thrusters import LACKING_N, THRUST_LEFT, WATCHED_S

NEVER_S = 999.0
SETTLED_S = 6.0  # a flight's first seconds, in which a robot comes to its depth
DEPTH_WATCHED_S = 10.0
SAME_US = 5  # a board whose outputs differ by no more than this from what they were told does as it is told
FELT = ("dead", "reversed")  # what is found wherever the thruster pushes; the others may go on as they were told to


def agent_killed(rig: Rig, random: Random) -> Sample:
    robot = int(random.choice(rig.robots))
    ns = rig.signal(f"agent-{robot}", signal.SIGKILL)
    neutral_s = rig.neutral_s(ns, [robot])
    rig.restart(f"agent-{robot}")
    begin_ns = time.monotonic_ns()
    rig.wait(lambda: any(True for _ in rig.since(robot, begin_ns)), "restarted agent heard")
    time.sleep(0.3)
    states = [report.state for report in rig.since(robot, begin_ns)]
    armed = any(state.mode is not Mode.DISARMED or (state.board is not None and state.board.armed) for state in states)
    return {"neutral": neutral_s, "restarted and not disarmed": float(armed)}


def agent_hung(rig: Rig, random: Random) -> Sample:
    robot = int(random.choice(rig.robots))
    ns = rig.signal(f"agent-{robot}", signal.SIGSTOP)
    neutral_s = rig.neutral_s(ns, [robot])
    time.sleep(float(random.uniform(0.0, 1.0)))
    rig.signal(f"agent-{robot}", signal.SIGCONT)
    return {"neutral": neutral_s, RESUMED: resumed(rig, (robot,), 2.0)}


def agent_ended(rig: Rig, random: Random) -> Sample:
    """As a person ends it, or a computer that is switched off."""
    robot, board = int(random.choice(rig.robots)), rig.boards
    ns = rig.signal(f"agent-{robot}", signal.SIGTERM)
    neutral_s = rig.neutral_s(ns, [robot])
    rig.wait(lambda: not board[robot].changes[-1][2], "board disarmed")
    disarmed_ns = next(at for at, _, armed in board[robot].changes if at >= ns and not armed)
    rig.wait(lambda: rig.process(f"agent-{robot}").exit_code is not None, "agent ended")
    rig.restart(f"agent-{robot}")
    return {"neutral": neutral_s, "disarmed": (disarmed_ns - ns) * 1e-9, RESUMED: resumed(rig, (robot,), 1.0)}


def depth_wrong(rig: Rig, random: Random) -> Sample:
    """Until the robot is neutral: after that it floats. A sensor that is stuck shows only after seconds."""
    rig.cruise(SETTLED_S)
    robot, how = int(random.choice(rig.robots)), str(random.choice(["reads 10", "jumps 0.5", "jumps -0.2", "stuck"]))
    i, off_m = rig.robots.index(robot), 0.0
    before_m = float(rig.truth.eta[i, 2])
    ns = rig.break_(f"depth {robot} {how}")
    while time.monotonic_ns() - ns < DEPTH_WATCHED_S * 1e9 and rig.mode(robot) in POWERED:
        time.sleep(0.02)
        off_m = max(off_m, abs(float(rig.truth.eta[i, 2]) - before_m))
    if how == "stuck":
        rig.break_()
        return {"true depth off, stuck": off_m}
    figures = {"true depth off": off_m, "fault": rig.mode_s(robot, OFF, ns, 1.0), "neutral": rig.neutral_s(ns, [robot])}
    rig.break_()
    return {**figures, RESUMED: resumed(rig, (robot,), 1.0)}


def solver_stuck(rig: Rig, random: Random) -> Sample:
    robot = int(random.choice(rig.robots))
    ns = rig.signal(f"agent-{robot}", signal.SIGUSR1)
    neutral_s = rig.neutral_s(ns, [robot])
    rig.signal(f"agent-{robot}", signal.SIGKILL)
    rig.restart(f"agent-{robot}")
    return {"neutral": neutral_s}


def solver_slow(rig: Rig, random: Random) -> Sample:
    robot = int(random.choice(rig.robots))
    ns = rig.signal(f"agent-{robot}", signal.SIGUSR2)
    times_s = {"neutral": rig.neutral_s(ns, [robot]), "alert": rig.alert_s(ns)}
    rig.signal(f"agent-{robot}", signal.SIGKILL)
    rig.restart(f"agent-{robot}")
    return times_s


def solver_unsolved(rig: Rig, random: Random) -> Sample:
    robot = int(random.choice(rig.robots))
    ns = rig.signal(f"agent-{robot}", signal.SIGALRM)
    neutral_s = rig.neutral_s(ns, [robot])
    controls = [h.state.control for h in rig.since(robot, ns)]
    shifted = sum(control is not None and control.solve is Solve.SHIFTED for control in controls)
    rig.signal(f"agent-{robot}", signal.SIGKILL)
    rig.restart(f"agent-{robot}")
    return {"neutral": neutral_s, "shifted plans": float(shifted)}


def link_cut(rig: Rig, random: Random) -> Sample:
    robot = int(random.choice(rig.robots))
    ns = time.monotonic_ns()
    rig.wires[robot].trouble = LineTrouble(cut=True)
    neutral_s = rig.neutral_s(ns, [robot])
    rig.wires[robot].trouble = LineTrouble()
    return {"neutral": neutral_s, RESUMED: resumed(rig, (robot,), 2.0)}


def link_garbage(rig: Rig, random: Random) -> Sample:
    """Bit flips, false starts, doubled and old frames for two seconds, forged ones among them; then a clean wire again."""
    robot = int(random.choice(rig.robots))
    wire, board = rig.wires[robot], rig.boards[robot]
    wire.trouble = LineTrouble(
        flip=float(random.uniform(0.001, 0.01)), junk=0.3, doubled=0.3, forged=forgeries(robot, wire.number, random)
    )
    time.sleep(2.0)
    wire.trouble = LineTrouble()
    ns = time.monotonic_ns()
    rig.wait(lambda: any(at > ns for at, _ in board.taken[-5:]), "board takes overrides again", 5.0)

    def heard_at_ns() -> list[int]:
        ages = [(h.ns, h.state.timing.board_age_ms) for h in rig.since(robot, ns)]
        return [at_ns for at_ns, age_ms in ages if age_ms is not None and age_ms < 40.0]

    rig.wait(lambda: bool(heard_at_ns()), "telemetry again", 5.0)
    return {
        "board in step again": (next(at for at, _ in board.taken if at > ns) - ns) * 1e-9,
        "agent in step again": (heard_at_ns()[0] - ns) * 1e-9,
    }


def board_disobeys(rig: Rig, random: Random) -> Sample:
    """Its outputs 1 and 2 are confused. Only while both are told different pulses does the board put out anything else than it
    was told, and only that time counts."""
    robot = int(random.choice(rig.robots))
    ns = rig.break_(f"board {robot} crossed")
    neutral_s, alert_s = rig.neutral_s(ns, [robot]), rig.alert_s(ns)
    rig.break_()
    board = rig.boards[robot]
    figures = {
        name: board.told_s(lambda pulses: abs(pulses[0] - pulses[1]) > SAME_US, ns, ns + round(seconds * 1e9))
        for name, seconds in (("neutral", neutral_s), ("alert", alert_s))
    }
    return {**figures, RESUMED: resumed(rig, (robot,), 1.0)}


def thruster_broken(rig: Rig, random: Random) -> Sample:
    """Until somebody says so, what is not flagged must do no harm, and what is must lead to neutral. A thruster that is told
    next to nothing lacks nothing: until the flag only that time counts in which it does."""
    rig.cruise(float(random.uniform(10.0, 20.0)))  # a flight's first seconds are rough, and excuse more
    robot, number = int(random.choice(rig.robots)), int(random.integers(1, 5))
    how = str(random.choice([*FELT, "stuck", "weak 0.3"]))
    ns = rig.break_(f"thruster {robot}/{number} {how}")
    off_m, astray_m, i = 0.0, 0.0, rig.robots.index(robot)
    while time.monotonic_ns() - ns < WATCHED_S * 1e9 and rig.mode(robot) in POWERED:
        time.sleep(0.05)
        state = rig.states[robot][-1].state
        if state.mode in POWERED:
            off_m = max(off_m, float(np.hypot(*(required(state.estimate).eta - rig.truth.eta[i])[:2])))
            astray_m = max(astray_m, float(np.hypot(*(required(state.control).eta_reference - rig.truth.eta[i])[:2])))
    figures = {"estimate off the truth": off_m, "off its path": astray_m}
    if rig.mode(robot) not in POWERED:
        flagged_s = rig.alert_s(ns, "fault (")  # what the station says of it; others may warn of other things
        figures["neutral after the flag"] = rig.neutral_s(ns, [robot]) - flagged_s
        if how in FELT:
            lost, force_n = 1.0 - THRUST_LEFT[how], rig.experiment.vehicle.thruster.force_n
            figures["flagged"] = rig.boards[robot].told_s(
                lambda pulses: lost * abs(float(force_n(np.array(pulses[number - 1], dtype=float)))) > LACKING_N,
                ns,
                ns + round(flagged_s * 1e9),
            )
    elif how in FELT:
        figures["flagged"] = NEVER_S
    rig.break_()
    rig.land()  # what was not flagged is a habit by now
    return figures


def battery_empty(rig: Rig, random: Random) -> Sample:
    """The voltage falls below the neutral level within a second."""
    robot = int(random.choice(rig.robots))
    for volts in (0.8, 1.5):
        rig.break_(f"battery {robot} sag {volts}")
        time.sleep(0.3)
    ns = rig.break_(f"battery {robot} sag 3.5")
    neutral_s = rig.neutral_s(ns, [robot])
    time.sleep(1.0)
    rig.order(CommandKind.DISARM)
    time.sleep(0.5)
    rig.order(CommandKind.LOAD)
    time.sleep(0.5)
    armed = rig.order(CommandKind.ARM).accepted
    time.sleep(0.5)
    armed |= rig.boards[robot].changes[-1][2]
    rig.break_()
    return {"neutral": neutral_s, "armed on an empty battery": float(armed)}
