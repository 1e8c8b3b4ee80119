"""The targets of fuzzing: every decoder, and every `step`. A target takes any bytes, and raises only for a bug.

Decoders get the bytes as they are. Steps get what can be made of them: messages of any numbers, also of those that no decoder
lets through, at any instants, in any order.
"""

import contextlib
import dataclasses
import math
import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np

from groundstation.logs.reader import valid_records
from groundstation.mission.command_dispatcher import CommandResult
from groundstation.mission.mission import Mission
from groundstation.planning.feasibility import PlanError
from groundstation.planning.planner import plan
from groundstation.planning.segment import PlanSegment
from groundstation.telemetry import RobotView
from groundstation.web.protocol import BadRequest, read_request
from localizer.tracking.fleet_localizer import FleetLocalizer
from robot_agent.agent import Agent
from robot_agent.inputs import Inputs, StampedObstacles, StampedPlan, StampedPose, StationView
from robot_agent.safety.modes import POWERED
from robot_agent.safety.sensor_checks import LEVEL_MPS2
from shoal.config.experiment import Experiment, load_experiment
from shoal.config.loader import apply_setting, check, read_toml
from shoal.config.vehicle import Vehicle
from shoal.errors import ConfigError
from shoal.mavlink.agent_link import AgentLink
from shoal.messages.codec import DecodeError, Header, decode, encode
from shoal.messages.messages import (
    BoardReading,
    Command,
    CommandKind,
    Obstacles,
    Plan,
    Pose,
    Reply,
    RobotState,
    Track,
    Trajectory,
    is_finite,
)
from sim_bridge.thruster_board.board import ThrusterBoard
from sim_bridge.thruster_board.board_link import BoardLink
from tests.faults.bites import Bites
from tests.shoal.strategies import CLASSES, example

PERIOD_NS = 50_000_000
SMALL = ("camera.size_px=[96,64]", "camera.focal_px=[60,60]", "camera.centre_px=[47.5,31.5]")


@cache
def _pool(*settings: str) -> Experiment:
    return load_experiment("pool", settings)


# --- decoders


def messages(data: bytes) -> None:
    """Protobuf: the first byte says which message it is to be. What gets through can be sent on."""
    cls = CLASSES[data[0] % len(CLASSES)] if data else CLASSES[0]
    with contextlib.suppress(DecodeError):
        encode(decode(cls, data[1:], "peer", "topic"))
    with contextlib.suppress(DecodeError):
        Header.decode(data[:28], "peer", "topic")


def mavlink(data: bytes) -> None:
    """Both ends, in pieces."""
    board, agent, size = BoardLink(1), AgentLink(1), 1 + len(data) // 3
    for k in range(0, len(data), size):
        board.receive(data[k : k + size], k * PERIOD_NS)
        agent.receive(data[k : k + size], k * PERIOD_NS)
    telemetry = agent.telemetry
    assert all(map(math.isfinite, (telemetry.heading_rad, telemetry.yaw_rate_radps, telemetry.depth_m, telemetry.battery_v)))


@cache
def _file() -> Path:
    return Path(tempfile.mkdtemp(prefix="shoal-fuzz-")) / "fuzz.toml"


def toml(data: bytes) -> None:
    """An experiment's or a vehicle's file, and a setting laid over an experiment."""
    _file().write_bytes(data)
    for model in (Experiment, Vehicle):
        with contextlib.suppress(ConfigError):
            check(model, read_toml(_file()), "fuzz")
    table = _pool().model_dump(mode="json", exclude_none=True)
    with contextlib.suppress(ConfigError):
        apply_setting(table, data.decode("latin1"))
        check(Experiment, table, "fuzz")


def requests(data: bytes) -> None:
    """Requests that a page may send."""
    with contextlib.suppress(BadRequest):
        read_request(data)
    with contextlib.suppress(BadRequest):
        read_request(data.decode("utf-8", "surrogateescape"))


def logs(data: bytes) -> None:
    """A log that was cut, or is none."""
    path = _file().with_suffix(".mcap")
    path.write_bytes(b"\x89MCAP0\r\n" + data)
    for _ in valid_records(path):
        pass


# --- steps


@cache
def _trajectory() -> Trajectory:
    return plan(_pool())[1]


def agent(data: bytes) -> None:
    """A robot that flies, given anything: it puts out pulses that servos can take, neutral ones unless its mode has thrust;
    what it believes and plans is finite."""
    bites, robot, now_ns = Bites(data), Agent(_pool(), 1), 10**12
    for number, order in enumerate((CommandKind.LOAD, CommandKind.ARM, CommandKind.START), start=1):
        station = StationView(1, now_ns, 0.0)
        pose = Pose(0.5, 0.1, 0.2, np.eye(3) * 1e-6, Track.MARKER, True, 1.0, 0.3)
        board = BoardReading(number, now_ns, acceleration_mps2=np.array(LEVEL_MPS2), battery_v=12.0, armed=number > 2)
        robot.step(Inputs(StampedPose(pose, now_ns), board, station), now_ns)
        path = _trajectory()
        command = Command(
            order,
            1,
            experiment_hash=_pool().hash,
            trajectory_id=path.id,
            trajectory=path if order is CommandKind.LOAD else None,
            start_ns=now_ns,
        )
        robot.handle_command(Header(1, number, now_ns), command, station, now_ns)
        now_ns += PERIOD_NS
    while bites.left:
        _agent_step(robot, bites, now_ns)
        now_ns += (PERIOD_NS, 0, PERIOD_NS, 10**9)[bites.byte(4)]


def _agent_step(robot: Agent, bites: Bites, now_ns: int) -> None:
    def instant() -> int:
        return now_ns - (0, 20_000_000, -20_000_000, 10**10)[bites.byte(4)]

    kind = bites.byte(8)
    inputs = robot.inputs
    pose = StampedPose(bites.message(Pose), instant()) if kind & 1 else inputs.pose
    board = dataclasses.replace(inputs.board, arrival_ns=now_ns, armed=True)
    if kind & 2:
        board = dataclasses.replace(
            board,
            board_ms=bites.byte(),
            arrival_ns=instant(),
            heading_rad=bites.number(),
            yaw_rate_radps=bites.number(),
            depth_m=bites.number(),
            battery_v=bites.number(),
        )
    plans = {2: StampedPlan(bites.message(Plan), instant())} if kind & 4 else inputs.plans
    watched = StampedObstacles(bites.message(Obstacles), instant()) if kind & 4 else inputs.obstacles
    outputs = robot.step(Inputs(pose, board, StationView(1, now_ns, 0.0), False, plans, watched, bites.byte(5)), now_ns)
    assert len(outputs.pulse_us) == 8 and all(1000 <= pulse <= 2000 for pulse in outputs.pulse_us)
    assert robot.mode in POWERED or outputs.pulse_us[:4] == (1500,) * 4
    state = outputs.state
    assert is_finite(state.estimate) and is_finite(state.control)
    if outputs.plan is not None:
        decode(Plan, encode(outputs.plan), "agent", "plan")


def orders(data: bytes) -> None:
    """Any order to any robot, from anybody. Nothing but ARM, START, RESUME and HOLD in their places leads to thrust."""
    bites, robot, now_ns = Bites(data), Agent(_pool(), 1), 10**12
    while bites.left:
        command = bites.message(Command)
        header = Header(bites.byte(2), bites.byte(), now_ns - bites.byte() * 10_000_000)
        reply = robot.handle_command(header, command, StationView(bites.byte(2), now_ns, 0.0), now_ns)
        decode(Reply, encode(reply), "agent", "reply")
        robot.step(dataclasses.replace(robot.inputs, station=StationView(1, now_ns, 0.0)), now_ns)
        now_ns += PERIOD_NS
    assert robot.mode not in POWERED  # it never knew where it is


def locator(data: bytes) -> None:
    """Any pictures at any instants."""
    experiment, bites = _pool(*SMALL), Bites(data)
    eyes, now_ns = FleetLocalizer(experiment), 0
    width, height = experiment.camera.size_px
    while bites.left:
        shape = ((height, width), (height, width), (height, width), (width, height))[bites.byte(4)]
        pixels = np.resize(np.frombuffer(bites.take(1 + bites.byte() * 8), np.uint8), shape)
        now_ns += (PERIOD_NS, 0, -PERIOD_NS, 10**10)[bites.byte(4)]
        for _, pose in eyes.step(pixels, now_ns, {1: bites.number(), 2: bites.number()}).poses:
            decode(Pose, encode(pose), "localizer", "pose")


def board(data: bytes) -> None:
    """Any bytes on its wire: never a pulse beyond its range, never thrust without arming."""
    bites, now_ns = Bites(data), 0
    thrusters = ThrusterBoard(_pool(), 1, 1)
    agent_end, still = AgentLink(1), np.zeros(4)
    while bites.left:
        kind = bites.byte(4)
        pulses = [500 + bites.byte() * 2000 // 255 for _ in range(8)]
        sent = (bites.take(bites.byte()), agent_end.pulses(pulses), agent_end.arm(True), agent_end.pulses([1500] * 8))[kind]
        thrusters.receive(sent, now_ns)
        now_ns += bites.byte() * 2_000_000
        thrusters.step(now_ns, still, still, still, 9.0 + bites.byte() / 64.0)
        assert all(1000 <= pulse <= 2000 for pulse in thrusters.pulses)
        assert thrusters.armed or thrusters.pulses[:4] == (1500,) * 4


def mission(data: bytes) -> None:
    """Robots that say anything, and answer anything."""
    experiment, bites, now_ns = _pool(), Bites(data), 10**12
    segment = PlanSegment({r: dataclasses.replace(_trajectory(), id=str(r)) for r in experiment.robot_ids}, _trajectory(), 1.0)
    flight = Mission(experiment, segment, dict.fromkeys(experiment.robot_ids, np.zeros(4)), True)
    while bites.left:
        fleet = {
            robot: RobotView(bites.message(RobotState), abs(bites.number()), bites.message(Pose), abs(bites.number()))
            if bites.byte(4)
            else RobotView()
            for robot in experiment.robot_ids
        }
        if bites.byte(4) == 0:
            flight.request(list(CommandKind)[bites.byte(len(CommandKind))], fleet, now_ns)
        commands = flight.step(fleet, [CommandResult(bites.message(Command), bites.message(Reply))], now_ns)
        for command in commands:
            decode(Command, encode(command), "station", "command")
        if flight.plan_request is not None:
            with contextlib.suppress(PlanError):
                flight.planned(flight.plan_request.plan(), fleet, now_ns)
        now_ns += PERIOD_NS * (1 + bites.byte())


TARGETS: dict[str, Callable[[bytes], None]] = {
    "messages": messages,
    "mavlink": mavlink,
    "toml": toml,
    "requests": requests,
    "logs": logs,
    "agent": agent,
    "orders": orders,
    "locator": locator,
    "board": board,
    "mission": mission,
}


def seeds(name: str) -> list[bytes]:
    """Good input of a target, to begin from."""
    link, end = AgentLink(1), BoardLink(1)
    good = {
        "messages": [bytes([i]) + encode(example(cls)) for i, cls in enumerate(CLASSES)],
        "mavlink": [link.pulses([1500] * 8) + link.arm(True), end.attitude(5, 1.0, 0.1) + end.pressure(5, 0.3)],
        "toml": [Path("shoal/config/experiments/pool.toml").read_bytes(), b"controller.mpc.horizon=20"],
        "requests": [b'{"kind":"order","n":1,"order":"start"}', b'{"kind":"try","n":2,"edit":{"points_m":[[0,0],[1,2]]}}'],
    }
    return good.get(name, [bytes(range(256)), bytes(300)])
