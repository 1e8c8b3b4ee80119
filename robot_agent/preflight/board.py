"""SHELL: `robot-agent check`: preflight of the robot's computer and its thruster board. A failed check does not stop the
others."""

import itertools
import platform
import time
from collections.abc import Callable, Generator, Iterator, Mapping
from pathlib import Path

import numpy as np

from robot_agent.host import realtime
from robot_agent.host.board_parameters import BoardParameters, compare, wanted_parameters
from robot_agent.host.board_zero import SERVICE_FOLDER, read_record, state_folder
from robot_agent.host.config import AgentConfig, open_board_link
from robot_agent.preflight import findings
from robot_agent.preflight.findings import CheckFinding, CheckVerdict
from robot_agent.preflight.network import check_network
from robot_agent.preflight.rehearsal import RehearsalFailed, rehearse
from robot_agent.safety.health import RESTART_DEPTH_M
from shoal.config.experiment import Experiment, load_experiment
from shoal.errors import ConfigError
from shoal.mavlink.agent_link import AgentLink, Telemetry
from shoal.mavlink.board_address import number_in_name, parse_link, serial_ports, serial_trouble
from shoal.mavlink.parameter_list import ParameterList
from shoal.mavlink.signing_key import agent_end
from shoal.messages.messages import Mode
from shoal.runtime.version import code

REHEARSED, WARM_UP = 400, 60  # control steps: 20 s of flight
BOARD_WITHIN_S, PARAMETERS_WITHIN_S = 2.0, 4.0  # the second: from the first burst on; a board tells one with each, in 1 s all
HIGHEST_M = 0.05  # above the surface; a sensor's noise and drift in a session
ZERO_JUDGED_MS = 1000  # of its life, from which on a board has judged its depth zero: 8 pressures take it 0.3 s


def run_preflight(
    config: AgentConfig, thrusters: Callable[[Experiment], Iterator[CheckFinding]] | None
) -> Iterator[CheckFinding]:
    """Run all checks, in the order of their dependence; `thrusters` turns them, None if not asked for."""
    machine = f"shoal {code().short}, Python {platform.python_version()}, {platform.machine()}"
    yield CheckFinding("software", CheckVerdict.OK, machine)
    experiment = None
    try:
        loaded = load_experiment(config.experiment, config.settings)
        loaded.robot(config.robot)
        vehicle, experiment = loaded.vehicle, loaded
        detail = f"{loaded.name} ({loaded.hash[:8]}), robot {config.robot} of {len(loaded.robot_ids)}"
        yield CheckFinding("experiment", CheckVerdict.OK, detail)
        parts = f"{len(vehicle.thrusters)} thrusters" if vehicle.legs is None else f"{len(vehicle.legs.position_m)} legs"
        detail = f"{vehicle.name}: {parts}, {vehicle.mass.surge_kg:g} kg with what it drags along"
        yield CheckFinding("vehicle", CheckVerdict.OK, detail)
    except ConfigError as error:
        yield CheckFinding("experiment", CheckVerdict.FAIL, str(error))
    flying = yield from check_network(config)
    yield from _computer()
    if experiment is not None:
        yield step_timing(experiment, config.robot)
    yield from check_device(config)
    yield from _depth_zero()
    idle = False
    if flying:  # two programs on one thruster board: what one sends the other would spoil
        yield CheckFinding("thruster board", CheckVerdict.SKIPPED, "this robot's agent has it (systemctl stop shoal-agent)")
    else:
        idle = yield from _board(config, experiment)
    if thrusters is None or experiment is None or not idle:
        needs = "(--thrusters moves them one by one)" if thrusters is None else "(the board must say that it is disarmed)"
        yield CheckFinding("thrusters", CheckVerdict.SKIPPED, f"not turned {needs}")
    else:
        yield from thrusters(experiment)


def check_device(config: AgentConfig) -> Iterator[CheckFinding]:
    """Check that the serial port of the link is there, and that its name stays with the board."""
    try:
        address = parse_link(config.link)
    except ConfigError:
        return  # the thruster board's line says it
    if address.kind == "serial":
        trouble, doubt = serial_trouble(Path(address.where)), number_in_name(address.where, serial_ports())
        verdict = CheckVerdict.FAIL if trouble else CheckVerdict.WARN if doubt else CheckVerdict.OK
        yield CheckFinding("device", verdict, trouble or doubt or f"{address.where}: can be read and written")


def _depth_zero() -> Iterator[CheckFinding]:
    """Say of a board whose zero is in doubt how to get out of it; nothing otherwise."""
    record = None
    try:
        record = read_record(state_folder() or SERVICE_FOLDER)
    except PermissionError:  # only the service's user, and root, may read it
        return
    except OSError as error:
        why = f"{error.filename}: {error.strerror}: a robot whose board reports no restarts will not arm"
        yield CheckFinding("depth zero", CheckVerdict.WARN, f"{why} (is its depth right? `robot-agent confirm-zero`)")
    if record is not None and record.zero_m > RESTART_DEPTH_M:
        why = f"the board restarted where the robot was last known to be, at {record.zero_m:.2f} m: it will not arm"
        remedy = "restart the board in air; or, if it was in air, `robot-agent confirm-zero`"
        yield CheckFinding("depth zero", CheckVerdict.WARN, f"{why} ({remedy})")


def _board(config: AgentConfig, experiment: Experiment | None) -> Generator[CheckFinding, None, bool]:
    """Listen to the thruster board. Returns True if it is heard and reports that it is disarmed: so no agent flies the
    robot."""
    wanted = None if experiment is None else wanted_parameters(experiment)
    try:
        mavlink, advice = listen(config, wanted)
    except ConfigError as error:
        yield CheckFinding("thruster board", CheckVerdict.FAIL, str(error))
        return False
    telemetry = mavlink.telemetry
    if advice:
        yield CheckFinding("baud rate", CheckVerdict.WARN, advice)
    if telemetry.autopilot_name:
        why = f"{config.link}: {telemetry.autopilot_name}, no thruster board: it takes pulses for a pilot's sticks"
        yield CheckFinding("thruster board", CheckVerdict.FAIL, why)
        return False
    idle = telemetry.heartbeats > 0 and not telemetry.armed
    battery = f"{telemetry.battery_v:.1f} V" if telemetry.battery_reports else "no voltage told"
    armed = "disarmed" if idle else "ARMED: by whom?" if telemetry.armed else "does not say whether it is armed"
    simulated = ", in HIL mode: measurements are simulated" if telemetry.hil else ""
    is_zero_wrong = telemetry.depth_m < -HIGHEST_M
    zero = ", above the surface: was it switched on under water? Restart it in air" if is_zero_wrong else ""
    on = f"on for {telemetry.board_ms / 1000.0:.0f} s{_start(telemetry)}"
    sound = idle and telemetry.battery_reports and not (telemetry.hil or is_zero_wrong or telemetry.zero_in_question)
    detail = f"heard; {battery}, depth {telemetry.depth_m:.2f} m{zero}, {on}, {armed}{simulated}"
    yield CheckFinding("thruster board", CheckVerdict.OK if sound else CheckVerdict.WARN, detail)
    if wanted is not None:
        yield _parameters(mavlink.parameters, wanted)
    return idle


def _parameters(reported: ParameterList, wanted: Mapping[str, float]) -> CheckFinding:
    """List all differences between the board's parameters and the experiment's."""
    if not reported.is_complete:
        came = f"{len(reported.values)} of {reported.count or len(wanted)} came within {PARAMETERS_WITHIN_S:g} s"
        return CheckFinding("parameters", CheckVerdict.FAIL, f"{came}: the robot does not arm before all are known")
    differences = compare(reported.values, wanted)
    matter = [str(difference) for difference in differences if difference.matters]
    own = [str(difference) for difference in differences if not difference.matters]
    detail = f"{reported.count} as in the experiment"
    if matter:
        detail = f"the robot does not arm (`robot-agent params set` changes one): {', '.join(matter)}"
    if own:
        detail += f"; the board's own: {', '.join(own)}"
    return CheckFinding("parameters", CheckVerdict.FAIL if matter else CheckVerdict.OK, detail)


def _start(telemetry: Telemetry) -> str:
    """Text about how the board's present life began."""
    if not telemetry.reports_start:
        return " (its depth counts from where it was then)"
    cause = f" after {' and '.join(telemetry.reset_causes) or 'a reset of unknown cause'}"
    kept = ", with the zeros kept from before" if telemetry.restarted else ""
    doubt = ", DEPTH ZERO IN QUESTION: it will not arm before `robot-agent confirm-zero`" if telemetry.zero_in_question else ""
    return f"{cause}{kept}{doubt}"


def listen(config: AgentConfig, wanted: Mapping[str, float] | None) -> tuple[AgentLink, str]:
    """Return the link with what the thruster board has told, and what should be changed of the link. Its parameters are read
    if some are `wanted`. Raises ConfigError if the board is silent."""
    wires, signing = open_board_link(config)
    mavlink = agent_end(config.robot, signing)
    parameters = None if wanted is None else BoardParameters(wanted)
    try:
        within_s = BOARD_WITHIN_S + wires.first_word_s
        deadline, is_heard = time.monotonic() + within_s, False
        while time.monotonic() < deadline:
            wires.send(mavlink.heartbeat())  # a board behind UDP learns from it where we are
            if parameters is not None and (request := parameters.step(mavlink, time.monotonic())):
                wires.send(request)
            wires.wait(0.1)
            mavlink.receive(wires.read(), time.monotonic_ns())
            telemetry = mavlink.telemetry
            if telemetry.autopilot_name:
                return mavlink, wires.advice
            if telemetry.board_ms >= 0:
                if not is_heard and parameters is not None:
                    deadline += PARAMETERS_WITHIN_S
                is_heard = True
                judged = not telemetry.zero_in_question or telemetry.board_ms > ZERO_JUDGED_MS
                is_complete = parameters is None or mavlink.parameters.is_complete
                if telemetry.battery_reports and telemetry.heartbeats and judged and is_complete:
                    break
        if not is_heard:
            why = wires.trouble or _foreign_frames(mavlink.telemetry, config.robot)
            raise ConfigError(f"{config.link}: silent for {within_s:g} s{why and '; '}{why}")
        return mavlink, wires.advice
    finally:
        wires.close()


def _foreign_frames(telemetry: Telemetry, robot: int) -> str:
    """Text about frames that came where the board's own were expected: whose they are; empty if none came."""
    if telemetry.forged_frames:
        return "what comes is signed with another key, or there is no link_key"
    if telemetry.unsigned_frames:
        return "what comes is not signed (over a cable, `robot-agent params give-key FILE` gives the board a key)"
    if telemetry.hil:
        return "it is in HIL mode, and nothing simulates its measurements: start `sim-bridge hil`, or power it off and on"
    if telemetry.echo_us:
        return "it speaks, but tells no depth that can be true"
    if telemetry.foreign_peer is not None:
        system, component = telemetry.foreign_peer
        return f"what comes is not of this robot's board (system {robot}, component 1), but of {system}, {component}"
    return "what comes is no frame of a thruster board" if telemetry.foreign_frames else ""


def _computer() -> Iterator[CheckFinding]:
    """Findings about the computer that runs the agent: real-time scheduling and CPU clock."""
    yield CheckFinding("real time", CheckVerdict.OK, realtime.permitted())
    governor = realtime.governor()
    if governor and governor != "performance":
        yield CheckFinding(
            "CPU governor", CheckVerdict.WARN, f"{governor}: steps take longer at a low clock; `performance` is steadier"
        )


def step_timing(experiment: Experiment, robot: int) -> CheckFinding:
    """The finding about how long control steps take, from those of a rehearsed flight."""
    steps_ms = []
    try:
        for agent, inputs, now_ns in itertools.islice(rehearse(experiment, robot), REHEARSED):
            began = time.perf_counter_ns()
            state = agent.step(inputs, now_ns).state
            steps_ms.append((time.perf_counter_ns() - began) * 1e-6)
    except RehearsalFailed as failed:
        return findings.not_timed(str(failed))
    except Exception as error:  # a law of one's own that is not installed here, or that fails: the other checks go on
        why = str(error) if isinstance(error, ConfigError) else f"{type(error).__name__}: {error}"
        return CheckFinding("control step", CheckVerdict.FAIL, why)
    if state.mode is not Mode.TRACKING:
        return findings.not_timed(f"the robot is {state.mode.name}, {state.fault or 'for no reason told'}")
    p50, p99 = np.percentile(steps_ms[WARM_UP:], [50, 99]).tolist()
    return findings.timing(p50, p99, experiment.controller.period_s, len(experiment.robot_ids) - 1)
