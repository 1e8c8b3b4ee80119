"""SHELL: one robot's process around its core: read, step, publish.

By the wall clock a step comes once a period, on a grid that follows the camera slowly (step_clock.py), and no later than the
instant at which the last pose becomes too old. A command that takes the power away brings a step of its own at once. An
owner of the time, such as the simulator, gives the node a clock and a pace of its own.

When the loop ends, by request or by an exception, the thruster board is first told to go neutral and to disarm. It would do so
by itself, but only 0.25 s later.
"""

import logging
import threading
import time
from collections.abc import Generator, Iterable, Iterator
from dataclasses import dataclass, replace

from robot_agent.agent import Agent, Outputs
from robot_agent.control.live_tuning import Prepared
from robot_agent.host.board_parameters import BoardParameters, wanted_parameters
from robot_agent.host.board_zero import BoardZero, state_folder
from robot_agent.host.sd_notify import ServiceNotifier
from robot_agent.host.step_clock import StepClock
from robot_agent.host.zero_request import ZeroRequests
from robot_agent.safety.modes import LIVE
from robot_agent.step_record import inputs_of, record_command, record_step, station_view, with_reply
from shoal.bus.bus import Bus, Received
from shoal.bus.command_deduplication import ALWAYS_TAKEN
from shoal.config.experiment import Experiment
from shoal.mavlink.agent_link import ACCEPTED, ARM_DISARM, Telemetry
from shoal.mavlink.board_port import Link
from shoal.mavlink.signing_key import Signing, agent_end
from shoal.messages import topics
from shoal.messages.codec import Header
from shoal.messages.messages import (
    Command,
    CommandKind,
    Mode,
    Obstacles,
    Plan,
    Pose,
    Reply,
    StationHeartbeat,
    StepInputs,
    StepTiming,
)
from shoal.runtime.runtime import Clock, Stop, WallClock, log, log_to_bus, run_steps, wait
from shoal.runtime.version import code

DISARMED = (ARM_DISARM, ACCEPTED)  # the board's answer
LINK_HEARTBEAT_S = 1.0
CLOCK_PERIOD_S = 1.0
CLOCK_WAIT_S = 0.01  # for the board's answer about its time: its loop, 5 ms, and the way. What is left of the period is longer
LEAVE_S = 0.25  # for the board's answer that it is disarmed; after that long without pulses it is by itself
LEAVE_AGAIN_S = 0.01  # how often it is told meanwhile
LEAVE_TIMES = 3  # at the least: one datagram of ten may be lost


@dataclass(frozen=True)
class StepTime:
    """The instant at which a step was due, and up to which stamps inputs of others count at it; None: whatever has come."""

    due_ns: int
    plans_up_to_ns: int | None = None
    obstacles_up_to_ns: int | None = None


class AgentNode:
    """Inboxes, link and clock of one robot."""

    def __init__(
        self,
        experiment: Experiment,
        robot: int,
        bus: Bus,
        link: Link,
        stop: Stop,
        watchdog: ServiceNotifier | None = None,
        signing: Signing | None = None,
        clock: Clock | None = None,
    ) -> None:
        """Make the node. With `signing`, frames to the board are signed, and unsigned frames from it are dropped. Without a
        `clock` it goes by the wall clock; `pace` may be replaced before the loop begins."""
        self.agent = Agent(experiment, robot)
        self._experiment, self._robot, self._bus, self.link, self.stop = experiment, robot, bus, link, stop
        self._watchdog = watchdog or ServiceNotifier({})
        self.clock: Clock = clock or WallClock()
        self.pace: Iterable[StepTime] = self._wall_pace()
        self._signing = signing
        self.mavlink = agent_end(robot, signing)
        folder = None if self.clock.waits else state_folder()
        self._zero = BoardZero(folder)
        self._zero_requests = ZeroRequests(folder, on_confirmed=self._zero.confirm)
        self._parameters = BoardParameters(wanted_parameters(experiment))
        self.poses = bus.inbox(topics.POSE, Pose, robot)
        self._pose: Received[Pose] | None = None  # the newest that counts
        self._two_senders_logged = False  # that two programs publish poses
        self.heartbeats = bus.inbox(topics.HEARTBEAT, StationHeartbeat)
        others = (r for r in experiment.robot_ids if r != robot)
        self.plans = bus.inboxes(topics.PLAN, Plan, others, wakes=self.clock.waits)
        self.obstacles = bus.inbox(topics.OBSTACLES, Obstacles)
        self._turn = threading.Lock()  # a command comes from a network thread; it waits for the step to end
        self._hurry = threading.Event()  # a command took the power away: the thrusters must not wait for the next pose
        self._link_heartbeat_s = self._clocks_compared_s = 0.0
        self._dropped = 0  # frames of the board, for their signature
        self._trouble = ""  # that the link was last said to have
        self._pace = StepClock(experiment.controller.period_s, time.monotonic())
        self._failure: BaseException | None = None  # of a command, on a network thread: the loop ends with it
        self._leaving = False
        self._steps = self._commands = 0  # of this agent, as the log counts them
        self._station_session = 0
        self._logged_state = ("disarmed", "")

    def run(self) -> None:
        """Run the control loop until told to stop. Raises the exception that ended it otherwise. Either way the board is
        disarmed first."""
        try:
            run_steps(self.steps())
        except BaseException as error:
            self._leave(f"the control loop has ended: {type(error).__name__}: {error}", logging.ERROR)
            raise
        self._leave("told to stop")

    def steps(self) -> Generator[None]:
        """The control loop: yields when the robot is ready, and after each step; `next` waits for the next one."""
        log_to_bus(self._bus, self.clock, f"agent-{self._robot}")
        log.info("%s", code())
        self.stop.on_request(self._awake)
        self._bus.serve(self._robot, self.on_command)
        self.greet()
        self._bus.announce(f"agent-{self._robot}")
        log.info("ready, experiment %s", self._experiment.hash[:8])
        self._watchdog.ready(f"robot {self._robot}, experiment {self._experiment.name}")
        self._watchdog.mode(self.agent.mode.name)
        yield
        for instant in self.pace:
            if self._failure is not None:
                raise self._failure
            started_ns = time.perf_counter_ns()
            now_ns = self.clock.now_ns()
            with self._turn:
                record, outputs = self.step(now_ns, instant)
            self.write(outputs, now_ns, instant.due_ns, started_ns)
            self._watchdog.alive(time.monotonic_ns())
            self._bus.publish(topics.INPUTS, record, now_ns, self._robot)
            self._compare_clocks()
            yield

    def _awake(self) -> None:
        """Wake the loop at once, wherever it sleeps."""
        self._hurry.set()
        with self._bus.arrival:
            self._bus.arrival.notify_all()

    def _leave(self, why: str, level: int = logging.INFO) -> None:
        """Send neutral and disarm to the board until it confirms, at most LEAVE_S long. No other pulses are sent
        afterwards."""
        self._leaving = True
        before, until_s = self.mavlink.telemetry.acknowledgements, time.monotonic() + LEAVE_S
        count, disarmed = 0, False
        while not self.mavlink.telemetry.autopilot_name and (
            count < LEAVE_TIMES or (not disarmed and time.monotonic() < until_s)
        ):
            self.link.send(self.mavlink.arm(False))
            if self.mavlink.telemetry.is_thruster_board:
                self.link.send(self.mavlink.pulses(self.agent.neutral_us))
            count += 1
            self.link.wait(LEAVE_AGAIN_S)
            self.mavlink.receive(self.link.read(), self.clock.now_ns())
            telemetry = self.mavlink.telemetry
            answered = telemetry.acknowledgements > before and telemetry.acknowledged == DISARMED
            disarmed = answered and not (telemetry.armed or telemetry.arm_open)
        if self.mavlink.telemetry.autopilot_name:
            log.log(level, "%s; %s is on the link: nothing is sent to it", why, self.mavlink.telemetry.autopilot_name)
            return
        if disarmed:
            log.log(level, "%s; neutral and disarm sent to the thruster board, which says that it is disarmed", why)
            return
        silence, trouble = f"which has not said within {LEAVE_S:g} s that it is disarmed", self.link.trouble
        if not trouble and not self.mavlink.telemetry.heartbeats:  # a port sends nothing to a board that has not spoken
            trouble = "it has not been heard yet"
        outcome = f"may not have reached the thruster board ({trouble})" if trouble else "sent to the thruster board"
        log.log(max(level, logging.WARNING), "%s; neutral and disarm %s, %s", why, outcome, silence)

    def greet(self) -> None:
        """Send a heartbeat, so that a board behind UDP learns our address; renew the kept times of signatures."""
        self.link.send(self.mavlink.heartbeat())
        if self._signing is not None:
            try:
                self._signing.stamps.renew(self.mavlink.stamp)
            except OSError as error:  # a full disk is no reason to stop; only a restart would come too early for the board
                log.warning("the times of signatures cannot be kept: %s", error)

    def _tell_of_link(self) -> None:
        """Log why nothing gets through to the board (no device, or a device in use), once per change."""
        autopilot = self.mavlink.telemetry.autopilot_name
        trouble = f"{autopilot} is on the link; nothing is sent to it" if autopilot else self.link.trouble
        if trouble and trouble != self._trouble:
            log.warning("thruster board: %s", trouble)
        self._trouble = trouble

    def _tell_of_strangers(self) -> None:
        """Log frames dropped for their signature, at most once a second."""
        telemetry = self.mavlink.telemetry
        dropped = telemetry.unsigned_frames + telemetry.forged_frames + telemetry.replayed_frames
        if dropped > self._dropped:
            log.warning(
                "link: %d frames dropped for their signature: %d without, %d with another key, %d replayed",
                dropped - self._dropped, telemetry.unsigned_frames, telemetry.forged_frames, telemetry.replayed_frames,
            )  # fmt: skip
            self._dropped = dropped

    def _compare_clocks(self) -> None:
        """Ask for the board's time once a second, and wait for the answer no longer than the rest of the period surely allows.
        Where time waits for the step, nothing is measured."""
        deadline_s = time.monotonic() + CLOCK_WAIT_S
        if self.clock.waits or deadline_s - self._clocks_compared_s < CLOCK_PERIOD_S:
            return
        self._clocks_compared_s = deadline_s
        before = self.mavlink.telemetry.round_trips
        self.link.send(self.mavlink.timesync(self.clock.now_ns()))
        while self.mavlink.telemetry.round_trips == before and (left_s := deadline_s - time.monotonic()) > 0:
            self.link.wait(left_s)
            self.mavlink.receive(self.link.read(), self.clock.now_ns())

    def on_command(self, header: Header, command: Command) -> Reply:
        """Serve a command of the station, on a network thread. One that fails ends the robot's program."""
        agent = self.agent
        try:
            prepared = agent.prepare(command)  # what is long to make is made beside the steps
            with self._turn:
                if self._leaving and command.order not in ALWAYS_TAKEN:
                    return Reply(self._robot, False, f"{command.order.name}: the robot's program is ending", self.agent.mode)
                reply = self._obey(header, command, prepared if agent is self.agent else None)
        except Exception as error:  # the command may be carried out by half: the robot must not fly on
            self._failure = error
            self._awake()
            return Reply(
                self._robot, False, f"{command.order.name}: {type(error).__name__}: {error}; the robot's program ends"
            )
        if command.order is not CommandKind.DRIVE or not reply.accepted:  # one comes every period
            log.info("%s: %s", command.order.name, "accepted" if reply.accepted else f"refused: {reply.reason}")
        return reply

    def _obey(self, header: Header, command: Command, prepared: Prepared | None) -> Reply:
        """Carry out a command, record it with its reply, and wake the loop if the robot loses its power."""
        # Where time waits, the station may have begun a step that we have not: a command of that step is given in it.
        now_ns = max(self.clock.now_ns(), self.clock.arrival_ns(header.stamp_ns))
        heartbeat = self._station()
        record = record_command(self._steps, self._commands, self.clock, header, command, heartbeat)
        live = self.agent.mode in LIVE  # a thruster test runs in ARMED
        reply = self.agent.handle_command(header, command, station_view(record, now_ns), now_ns, prepared)
        self._commands += 1
        if live and self.agent.mode not in LIVE:
            self._awake()
        self._bus.publish(topics.COMMANDS, with_reply(record, reply), now_ns, self._robot)
        return reply

    # --- inputs

    def step(self, now_ns: int, instant: "StepTime") -> tuple[StepInputs, Outputs]:
        """Collect the newest inputs in a record, and do the agent's step from that record alone: a rerun has no more."""
        self.mavlink.receive(self.link.read(), now_ns)
        heartbeat, obstacles = self._station(), self.obstacles.newest(instant.obstacles_up_to_ns)
        newest_plans = {robot: inbox.newest(instant.plans_up_to_ns) for robot, inbox in self.plans.items()}
        plans = {robot: plan for robot, plan in newest_plans.items() if plan is not None}
        telemetry = self._note_board(now_ns)
        pose = self._trusted_pose()
        record = record_step(self._steps, self._pace.late_steps, self.clock, pose, heartbeat, telemetry, plans, obstacles)
        self._steps += 1
        plan_messages = {robot: plan.message for robot, plan in plans.items()}
        obstacles_message = obstacles.message if obstacles is not None else None
        return record, self.agent.step(inputs_of(record, plan_messages, obstacles_message, now_ns), now_ns)

    def _note_board(self, now_ns: int) -> Telemetry:
        """Return the board's telemetry, with the objection to arming that follows from it ("" for none).

        Before that, correct the depth zero, and send the board requests: for its parameters, and a person's for a new zero. A
        robot with power is sent none, and none is sent in lockstep: its board is the simulator's, of the same experiment.
        """
        zero_m = self._zero.note(self.mavlink.telemetry)
        if zero_m is not None:
            self.mavlink.set_zero(zero_m)
        if self.clock.waits:
            return self.mavlink.telemetry
        has_power = self.agent.mode in LIVE
        requests = self._parameters.step(self.mavlink, now_ns * 1e-9)
        requests += self._zero_requests.step(self.mavlink, has_power)
        if requests and not has_power:
            self.link.send(requests)
        objection, telemetry = self._parameters.objection, self.mavlink.telemetry
        if not objection and not telemetry.echo_us:
            objection = "the thruster board does not report its outputs: a thruster that turns by itself would go unnoticed"
        in_question = telemetry.zero_in_question or (self._zero.is_unknown and not telemetry.reports_start)
        return replace(telemetry, objection=objection, zero_in_question=in_question)

    def _trusted_pose(self) -> Received[Pose] | None:
        """The newest pose. While two programs publish poses by turns it is the last one before: it grows old, and the robot
        holds, then stops."""
        two = self.poses.has_two_senders()
        if two and not self._two_senders_logged:
            log.error("two programs publish poses of this robot by turns, and none counts: end one of them")
        self._two_senders_logged = two
        if not two:
            self._pose = self.poses.newest()
        return self._pose

    def _station(self) -> Received[StationHeartbeat] | None:
        """Return the last heartbeat. At a new station a disarmed robot starts with a new agent, so that the station's log
        holds everything that the agent remembers."""
        heartbeat = self.heartbeats.newest()
        if heartbeat is not None and heartbeat.header.session != self._station_session:
            self._station_session = heartbeat.header.session
            if self._steps and self.agent.mode is Mode.DISARMED:
                self.agent = Agent(self._experiment, self._robot)
                self._steps = self._commands = 0
        return heartbeat

    # --- pace: when a step is due

    def _wall_pace(self) -> "Iterator[StepTime]":
        """Times of the control steps by the wall clock, each when it is due."""
        pace = self._pace = StepClock(self._experiment.controller.period_s, time.monotonic())
        taken: Received[Pose] | None = None
        while not self.stop.requested:
            due_s = self._await_step(pace, taken)
            if self.stop.requested:
                return
            self._hurry.clear()
            now_s, pose = time.monotonic(), self.poses.newest()
            pace.note_step(now_s, _arrived_s(pose, taken))
            taken = pose
            yield StepTime(self.clock.now_ns() - round(max(now_s - due_s, 0.0) * 1e9))

    def _await_step(self, pace: StepClock, taken: Received[Pose] | None) -> float:
        """Sleep until the next step. Returns the instant (s, monotonic) at which it was due. `taken` is the last step's
        pose."""
        react_by_s = self._react_by_s()
        # Asleep, not waiting: among twenty robots something arrives every 3 ms, and would wake it for nothing.
        self._hurry.wait(max(min(pace.opens_s, react_by_s) - time.monotonic(), 0.0))
        while not self.stop.requested and not self._hurry.is_set():
            newest = self.poses.newest_header()
            due_s = min(pace.due_s(_arrived_s(self.poses.newest(), taken)), react_by_s)
            left_s = due_s - time.monotonic()
            if left_s <= 0.0:
                return due_s
            wait(
                self._bus,
                self.stop,
                lambda newest=newest: self._hurry.is_set() or self.poses.newest_header() is not newest,  # type: ignore[misc]
                left_s,
            )
        return time.monotonic()

    def _react_by_s(self) -> float:
        """Instant (s, monotonic) at which the pose becomes too old; infinity if it does not, or is too old already."""
        react_by_ns, now_ns = self.agent.react_by_ns, self.clock.now_ns()
        if react_by_ns is None or react_by_ns <= now_ns:
            return float("inf")
        return time.monotonic() + (react_by_ns - now_ns) * 1e-9

    # --- outputs

    def _send_to_board(self, outputs: Outputs, now_ns: int) -> None:
        """Send a change of arming, once in a while the link's heartbeat, and the pulses."""
        board = self.mavlink.telemetry
        is_unknown = not (board.is_thruster_board or board.autopilot_name)
        may_change_arming = board.is_thruster_board or (is_unknown and not outputs.arm)  # an unknown board is only disarmed
        if outputs.arm is not None and may_change_arming:
            self.link.send(self.mavlink.arm(outputs.arm))
        if now_ns * 1e-9 - self._link_heartbeat_s >= LINK_HEARTBEAT_S:
            self._link_heartbeat_s = now_ns * 1e-9
            self._tell_of_link()
            self.greet()
            self._tell_of_strangers()
        if board.is_thruster_board:  # not before its first heartbeat: an autopilot would take pulses for a pilot's sticks
            self.link.send(self.mavlink.pulses(outputs.pulse_us))

    def _with_measured(self, timing: StepTiming, step_ns: int, sending_ns: int) -> StepTiming:
        """A step's timing with the values that only this process measures: the step, the time until pulses were sent, the
        board link."""
        telemetry = self.mavlink.telemetry
        return replace(
            timing,
            step_us=step_ns * 1e-3,
            exposure_to_pwm_ms=None if timing.pose_age_ms is None else timing.pose_age_ms + sending_ns * 1e-6,
            missed_deadlines=self._pace.missed,
            board_round_trip_ms=telemetry.round_trip_ns * 1e-6,
            board_clock_offset_s=telemetry.clock_offset_ns * 1e-9,
        )

    def write(self, outputs: Outputs, now_ns: int, due_ns: int, started_ns: int) -> None:
        """Send pulses to the board first, then publish plan and state."""
        step_ns = time.perf_counter_ns() - started_ns
        self._send_to_board(outputs, now_ns)
        sent_ns = time.perf_counter_ns() - started_ns
        if not self.clock.waits:  # where time waits for the step, nothing is late
            self._pace.count_lateness((sent_ns + now_ns - due_ns) * 1e-9)
        age_ns = 0 if self.clock.waits else sent_ns
        if outputs.plan is not None:
            self._bus.publish(topics.PLAN, outputs.plan, now_ns, self._robot, age_ns=age_ns)
        timing = self._with_measured(outputs.state.timing, step_ns, age_ns)
        state = replace(outputs.state, code=code().short, timing=timing)
        self._bus.publish(topics.STATE, state, now_ns, self._robot, age_ns=age_ns)
        if (state.doing, state.fault) != self._logged_state:
            self._logged_state = (state.doing, state.fault)
            self._watchdog.mode(state.mode.name, state.fault)
            say = log.warning if state.fault else log.info
            say("%s%s", state.doing, f": {state.fault}" if state.fault else "")


def _arrived_s(pose: Received[Pose] | None, taken: Received[Pose] | None) -> float | None:
    """Arrival (s, monotonic) of a pose; None if there is none or a step has taken it."""
    return None if pose is None or pose is taken else pose.arrived_ns * 1e-9
