"""SHELL: `robot-agent check`: looks the board over before the robot gets wet. One failure does not keep the rest from being
tried."""

import itertools
import platform
import time
from collections.abc import Callable, Generator, Iterator
from importlib import metadata
from pathlib import Path

import numpy as np

from robot_agent.host import realtime
from robot_agent.host.config import Board, open_board
from robot_agent.preflight import findings
from robot_agent.preflight.findings import Finding, Verdict
from robot_agent.preflight.network import look_at_network
from robot_agent.preflight.rehearsal import Grounded, rehearse
from wire.config.experiment import Experiment, load_experiment
from wire.mavlink.agent_link import Telemetry
from wire.mavlink.board_port import parse_link, serial_trouble
from wire.mavlink.signing_key import agent_end
from wire.messages.messages import Mode
from wire.toml_loader import ConfigError

REHEARSED, WARM_UP = 400, 60  # control steps: 20 s of flight
BOARD_WITHIN_S = 2.0


def look_over(board: Board, thrusters: Callable[[Experiment], Iterator[Finding]] | None) -> Iterator[Finding]:
    """Everything, in the order in which things depend on each other; `thrusters` turns them, if asked for."""
    machine = f"shoal {metadata.version('shoal')}, Python {platform.python_version()}, {platform.machine()}"
    yield Finding("software", Verdict.OK, machine)
    experiment = None
    try:
        loaded = load_experiment(board.experiment, board.settings)
        loaded.robot(board.robot)
        vehicle, experiment = loaded.vehicle, loaded
        detail = f"{loaded.name} ({loaded.hash[:8]}), robot {board.robot} of {len(loaded.robot_ids)}"
        yield Finding("experiment", Verdict.OK, detail)
        detail = f"{vehicle.name}: {len(vehicle.legs.position_m)} legs, {vehicle.mass.surge_kg:g} kg with what it drags along"
        yield Finding("vehicle", Verdict.OK, detail)
    except ConfigError as error:
        yield Finding("experiment", Verdict.FAIL, str(error))
    flying = yield from look_at_network(board)
    yield from _computer(board)
    if experiment is not None:
        yield _timing(experiment, board.robot)
    yield from _device(board)
    idle = False
    if flying:  # two programs on one thruster board: what one sends the other would spoil
        yield Finding("thruster board", Verdict.SKIPPED, "this robot's agent has it (systemctl stop shoal-agent)")
    else:
        idle = yield from _board(board)
    if thrusters is None or experiment is None or not idle:
        needs = "(--thrusters turns them one by one)" if thrusters is None else "(the board must say that it is disarmed)"
        yield Finding("thrusters", Verdict.SKIPPED, f"not turned {needs}")
    else:
        yield from thrusters(experiment)


def _device(board: Board) -> Iterator[Finding]:
    try:
        address = parse_link(board.link)
    except ConfigError:
        return  # the thruster board's line says it
    if address.kind == "serial":
        trouble = serial_trouble(Path(address.where))
        verdict = Verdict.FAIL if trouble else Verdict.OK
        yield Finding("device", verdict, trouble or f"{address.where}: can be read and written")


def _board(board: Board) -> Generator[Finding, None, bool]:
    """Returns whether it is heard, and says that it is disarmed: so nobody flies the robot."""
    try:
        telemetry = hear_board(board)
    except ConfigError as error:
        yield Finding("thruster board", Verdict.FAIL, str(error))
        return False
    idle = telemetry.heartbeats > 0 and not telemetry.armed
    battery = f"{telemetry.battery_v:.1f} V" if telemetry.battery_reports else "no voltage told"
    armed = "disarmed" if idle else "ARMED: by whom?" if telemetry.armed else "does not say whether it is armed"
    detail = f"heard; {battery}, depth {telemetry.depth_m:.2f} m, {armed}"
    yield Finding("thruster board", Verdict.OK if idle and telemetry.battery_reports else Verdict.WARN, detail)
    return idle


def hear_board(board: Board) -> Telemetry:
    """What the thruster board says. Raises ConfigError if it says nothing."""
    wires, signing = open_board(board)
    mavlink = agent_end(board.robot, signing)
    try:
        deadline, heard = time.monotonic() + BOARD_WITHIN_S, None
        while time.monotonic() < deadline:
            wires.send(mavlink.heartbeat())  # a board behind UDP learns from it where we are
            wires.wait(0.1)
            mavlink.receive(wires.read(), time.monotonic_ns())
            if mavlink.telemetry.board_ms >= 0:
                heard = mavlink.telemetry
                if heard.battery_reports and heard.heartbeats:
                    break
        if heard is None:
            why = wires.trouble or _others(mavlink.telemetry)
            raise ConfigError(f"{board.link}: silent for {BOARD_WITHIN_S:g} s{why and '; '}{why}")
        return heard
    finally:
        wires.close()


def _others(seen: Telemetry) -> str:
    """What came in the place of the robot's own board, if anything did."""
    if seen.forged_frames:
        return "what comes is signed with another key, or there is no link_key"
    if seen.unsigned_frames:
        return "what comes is not signed (over a cable, `robot-agent params give-key FILE` gives the board a key)"
    if seen.echo_us:
        return "it speaks, but tells no depth that can be true"
    return "what comes is not of this robot's board" if seen.foreign_frames else ""


def _computer(board: Board) -> Iterator[Finding]:
    yield Finding("real time", Verdict.OK, realtime.permitted())
    governor = realtime.governor()
    if governor and governor != "performance":
        yield Finding("CPU governor", Verdict.WARN, f"{governor}: steps take longer at a low clock; `performance` is steadier")


def _timing(experiment: Experiment, robot: int) -> Finding:
    steps_ms = []
    try:
        for agent, inputs, now_ns in itertools.islice(rehearse(experiment, robot), REHEARSED):
            began = time.perf_counter_ns()
            state = agent.step(inputs, now_ns).state
            steps_ms.append((time.perf_counter_ns() - began) * 1e-6)
    except Grounded as why:
        return findings.not_timed(str(why))
    if state.mode is not Mode.TRACKING:
        return findings.not_timed(f"the robot is {state.mode.name}, {state.fault or 'for no reason told'}")
    p50, p99 = np.percentile(steps_ms[WARM_UP:], [50, 99]).tolist()
    return findings.timing(p50, p99, experiment.controller.period_s, len(experiment.robot_ids) - 1)
