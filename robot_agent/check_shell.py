"""SHELL: `robot-agent check`: looks the board over before the robot gets wet. One failure does not keep the rest from being
tried."""

import itertools
import os
import platform
import stat
import time
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path

import numpy as np

from robot_agent import check, realtime
from robot_agent.check import Finding, Verdict
from robot_agent.config import Board, open_board
from robot_agent.rehearsal import rehearse
from wire import topics
from wire.bus import Bus
from wire.experiment import Experiment, load_experiment
from wire.keys import Keys, open_keys
from wire.link_key import agent_end
from wire.mavlink import Telemetry
from wire.messages import StationHeartbeat
from wire.network import endpoint, is_loopback, parse_address
from wire.reach import trouble_reaching
from wire.toml_file import ConfigError
from wire.topics import Role, process_name
from wire.transport import Unreached, ZenohTransport

REHEARSED, WARM_UP = 400, 60  # control steps: 20 s of flight
BOARD_WITHIN_S = 2.0
STATION_WITHIN_S = 3.0


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
    yield from _device(board)
    yield from _board(board)
    yield from _network(board)
    yield from _computer(board)
    if experiment is not None:
        yield _timing(experiment, board.robot)
    if thrusters is None or experiment is None:
        yield Finding("thrusters", Verdict.SKIPPED, "not turned (--thrusters turns them one by one)")
    else:
        yield from thrusters(experiment)


def _device(board: Board) -> Iterator[Finding]:
    kind, _, rest = board.link.partition(":")
    if kind != "serial":
        return
    device = Path(rest.rpartition(":")[0] if rest.rpartition(":")[2].isdigit() else rest)
    if not device.exists():
        yield Finding("device", Verdict.FAIL, f"{device}: not there; is the board plugged in, and powered?")
    elif not stat.S_ISCHR(device.stat().st_mode):
        yield Finding("device", Verdict.FAIL, f"{device}: is no serial port")
    elif not os.access(device, os.R_OK | os.W_OK):
        yield Finding(
            "device", Verdict.FAIL, f"{device}: no permission; add the user to its group (sudo usermod -aG dialout USER)"
        )
    else:
        yield Finding("device", Verdict.OK, f"{device}: can be read and written")


def _board(board: Board) -> Iterator[Finding]:
    try:
        telemetry = hear_board(board)
    except ConfigError as error:
        yield Finding("thruster board", Verdict.FAIL, str(error))
        return
    if telemetry is None:
        yield Finding("thruster board", Verdict.FAIL, f"{board.link}: silent for {BOARD_WITHIN_S:g} s")
        return
    detail = (
        f"heard; {telemetry.battery_v:.1f} V, depth {telemetry.depth_m:.2f} m, {'ARMED' if telemetry.armed else 'disarmed'}"
    )
    yield Finding("thruster board", Verdict.WARN if telemetry.armed else Verdict.OK, detail)


def hear_board(board: Board) -> Telemetry | None:
    """What the thruster board says, or None if it says nothing."""
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
                if heard.battery_v > 0.0:
                    break
        return heard
    finally:
        wires.close()


def _network(board: Board) -> Iterator[Finding]:
    process = process_name(Role.ROBOT, board.robot)
    keys = None
    if board.keys is not None:
        try:
            keys = open_keys(Path(board.keys), process)
            yield _certificate(keys, process)
        except ConfigError as error:
            yield Finding("certificate", Verdict.FAIL, str(error))
            return
    try:
        where = endpoint(board.station, process, None if keys is None else Path(board.keys or ""), insecure=board.insecure)
    except ConfigError as error:
        yield Finding("station", Verdict.FAIL, str(error))
        return
    if keys is None and not is_loopback(parse_address(board.station)[1]):
        yield Finding("certificate", Verdict.WARN, "none: the network is open, anybody on it can command the robots")
    trouble = trouble_reaching(where.address, where.keys)
    if trouble:
        yield Finding("station", Verdict.FAIL, f"{where.address}: {trouble}")
        return
    try:
        with Bus(ZenohTransport(where, patience_s=STATION_WITHIN_S), board.fleet) as bus:
            beats = bus.inbox(topics.HEARTBEAT, StationHeartbeat)
            bus.wait(lambda: beats.newest_header() is not None, STATION_WITHIN_S)
            received, now_ns = beats.newest(), time.time_ns()
    except Unreached as error:
        yield Finding("station", Verdict.FAIL, str(error))
        return
    if received is None:
        why = "a router answers, but no station is heard; is `groundstation run` on, under the same --fleet?"
        yield Finding("station", Verdict.FAIL, f"{where.address}: {why}")
        return
    yield Finding("station", Verdict.OK, f"{where.address}: heard, its mission is {received.message.mission}")
    since_ns = received.header.age_ns + time.monotonic_ns() - received.arrived_ns
    yield check.clock((now_ns - received.header.stamp_ns - since_ns) * 1e-9)


def _certificate(keys: Keys, process: str) -> Finding:
    from cryptography import x509  # only here: a flying agent has no use for it
    from cryptography.x509.oid import NameOID

    try:
        found = x509.load_pem_x509_certificate(keys.certificate.read_bytes())
        found.verify_directly_issued_by(x509.load_pem_x509_certificate(keys.ca.read_bytes()))
    except Exception as error:  # the library has a dozen ways to say that a file is no good; each is the answer here
        return Finding("certificate", Verdict.FAIL, f"{keys.certificate}: not of the authority beside it: {error}")
    names = found.subject.get_attributes_for_oid(NameOID.COMMON_NAME)
    name = str(names[0].value) if names else "nobody"
    return check.certificate(name, process, found.not_valid_before_utc, found.not_valid_after_utc, datetime.now(UTC))


def _computer(board: Board) -> Iterator[Finding]:
    yield Finding("real time", Verdict.OK, realtime.permitted())
    governor = realtime.governor()
    if governor and governor != "performance":
        yield Finding("CPU governor", Verdict.WARN, f"{governor}: steps take longer at a low clock; `performance` is steadier")


def _timing(experiment: Experiment, robot: int) -> Finding:
    steps_ms = []
    for agent, inputs, now_ns in itertools.islice(rehearse(experiment, robot), REHEARSED):
        began = time.perf_counter_ns()
        agent.step(inputs, now_ns)
        steps_ms.append((time.perf_counter_ns() - began) * 1e-6)
    p50, p99 = np.percentile(steps_ms[WARM_UP:], [50, 99]).tolist()
    return check.timing(p50, p99, experiment.controller.period_s, len(experiment.robot_ids) - 1)
