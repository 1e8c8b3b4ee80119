"""Health of a robot: ages of its inputs and results of its checks, from which the mode is decided. Pure."""

import math

from robot_agent.control.controller import ControlOutput
from robot_agent.guidance.driving import off_depth_m
from robot_agent.inputs import Inputs, StationView
from robot_agent.safety.modes import LIVE, POWERED, UNDER_WAY, Health
from robot_agent.safety.output_check import OutputCheck
from robot_agent.safety.path_deviation import PathDeviationMonitor
from robot_agent.safety.path_watch import PathWatch
from robot_agent.safety.sensor_checks import NOISE_M, NOISE_RADPS, GravityCheck, GyroscopeCheck, StuckSensorCheck
from robot_agent.safety.thruster_fault_detection import ThrusterFaultDetector
from robot_agent.vehicle.battery import BatteryMonitor
from robot_agent.vehicle.eso import GATE_RAD
from robot_agent.vehicle.fixed_thrusters import make_allocator
from shoal.config.experiment import Experiment
from shoal.frames import wrap
from shoal.mavlink.agent_link import autopilot_name
from shoal.messages.messages import BoardReading, Guidance, Mode

ARM_AGAIN_S = 0.2  # how often the board is asked to arm, or later to disarm, when it has not done as told
DISARM_S = 0.5  # so long after the power is taken away every step disarms, whatever the board says: frames get lost
NEVER_S = float("inf")
RESTART_DEPTH_M = 0.05  # a board that restarted deeper has a wrong zero; noise and drift of a sensor are some cm at most
DEPTH_SLACK_M = 0.3  # a pressure sensor that says more than this beyond the pool is wrong; the station warns from there on


class HealthMonitor:
    """Memory of one robot's inputs and outputs from step to step."""

    def __init__(self, experiment: Experiment, plan_period_s: float = 0.0) -> None:
        """`plan_period_s`: see `PathWatch`."""
        self._safety, self._markers = experiment.safety, experiment.localizer.markers
        self._period_s = experiment.controller.period_s
        self._battery = BatteryMonitor(experiment.vehicle.battery)
        self._outputs = OutputCheck(experiment.vehicle.thruster_count)
        self._thrusters = ThrusterFaultDetector(experiment.vehicle)
        self._gyroscope, self._rate, self._gravity = GyroscopeCheck(), StuckSensorCheck(NOISE_RADPS), GravityCheck()
        self._pressure = StuckSensorCheck(NOISE_M)
        self._uses_gyroscope = experiment.controller.estimator.use_imu_yaw_rate
        self._allocator, self._watch = make_allocator(experiment.vehicle), PathWatch(experiment, plan_period_s)
        self._depth, self._pool = PathDeviationMonitor(experiment.safety.off_depth_m), experiment.pool
        self._output: ControlOutput | None = None  # of the last control step
        self._mode = Mode.DISARMED
        self._sighted_ns: int | None = None  # instant of the last pose that was seen, not only predicted
        self._verified_ns: int | None = None  # and of the last one that is surely this robot
        self._armed_since_ns: int | None = None  # since when the board should be armed and is not
        self._board_armed = False  # the board has armed since it was last to be disarmed
        self._disarmed_at: int | None = None  # number of the heartbeat that first reported it disarmed since then
        self._wanted: bool | None = None  # whether the board is to be armed; None before the first step
        self._wanted_since_ns = 0
        self._asked_ns: int | None = None  # when the board was last told so
        self._estimated = self._estimate_ended = False

    def note_inputs(self, inputs: Inputs, mode: Mode, now_ns: int, testing: bool = False) -> None:
        """Take in a step's inputs, in the mode up to now. During a thruster self-test that test judges the board's outputs."""
        newest, board = inputs.pose, inputs.board
        if newest is not None and newest.is_seen:
            self._sighted_ns = newest.instant_ns
            if newest.pose.identity_verified or not self._markers:
                self._verified_ns = newest.instant_ns
        self._check_sensors(inputs)
        if mode is not self._mode:
            self._watch.reset()
            self._depth.reset()
        if mode not in LIVE:  # somebody may hold it
            self._watch.response.reset()
        elif newest is not None and newest.is_seen and self._fits(newest.pose.yaw_rad):
            pose = newest.pose
            self._watch.response.note_pose(newest.instant_ns, complex(pose.x_m, pose.y_m), pose.yaw_rad, newest.variance_m2)
        self._mode = mode
        self._battery.note_board(board, now_ns)
        if board.armed or not self._board_armed:
            self._disarmed_at = None
        elif self._disarmed_at is None:
            self._disarmed_at = board.heartbeats
        if not testing:
            self._outputs.note_board(board, now_ns)
        if mode not in POWERED:
            self._thrusters.reset()
            self._estimate_ended = False
        elif board.board_ms >= 0:
            self._thrusters.note_voltage(board.battery_v, board.arrival_ns)
            self._thrusters.step(_own_yaw_rate_radps(board), board.arrival_ns, board.board_ms * 1_000_000)

    def _fits(self, yaw_rad: float) -> bool:
        """True unless a pose's heading is far from the estimate's: a marker that is read the wrong way round."""
        output = self._output
        return output is None or output.estimate is None or abs(wrap(yaw_rad - output.estimate.eta.item(3))) < GATE_RAD

    def _check_sensors(self, inputs: Inputs) -> None:
        """Compare the board's sensors with themselves, with gravity and with the poses."""
        newest, board = inputs.pose, inputs.board
        if board.board_ms < 0:
            return
        self._pressure.note_sample(board.depth_m, board.arrival_ns)
        if self._uses_gyroscope:
            self._rate.note_sample(board.yaw_rate_radps, board.arrival_ns)
            self._gravity.note_sample(board.acceleration_mps2.tolist(), board.arrival_ns)
            self._gyroscope.note_rate(board.yaw_rate_radps, board.arrival_ns)
            if newest is not None and newest.is_seen:
                self._gyroscope.note_heading(newest.pose.yaw_rad, newest.instant_ns)

    def note_pulses(self, pulse_us: tuple[int, ...], now_ns: int) -> None:
        """Take note of pulses that went out; the board's echo and the gyroscope are compared with them."""
        self._outputs.note_pulses(pulse_us, now_ns)
        self._thrusters.note_moments(*self._allocator.level_moments(pulse_us), now_ns)
        surge_n, _, yaw_nm = self._allocator.delivered(pulse_us)[0].tolist()[:3]
        self._watch.response.note_thrust(surge_n, yaw_nm, now_ns)

    def note_output(self, output: ControlOutput, mode: Mode, now_ns: int) -> None:
        """Take in a control step's estimate and reference, in the mode from now on."""
        is_estimated = output.estimate is not None
        self._estimate_ended |= mode in POWERED and self._estimated and not is_estimated
        self._estimated = is_estimated
        self._watch.step(output, mode, now_ns)
        depth_m = 0.0 if output.estimate is None else output.estimate.eta.item(2)
        path_depth_m = depth_m if output.control is None else output.control.eta_reference.item(2)
        if mode is Mode.DRIVEN and output.estimate is not None:  # the reference leads
            depth_m = path_depth_m - off_depth_m(path_depth_m, depth_m, output.estimate.nu.item(2))
        self._depth.step(complex(depth_m), complex(path_depth_m), True, False, now_ns)  # no robot gives way by depth
        self._thrusters.note_flow(output.flow_moment)
        self._output = output

    @property
    def neutral_us(self) -> tuple[int, ...]:
        """Pulses with which no thruster turns: 4 thrusters, 4 ankles."""
        return self._allocator.neutral_us

    def health(self, inputs: Inputs, solver_failed: bool, now_ns: int, drive_age_s: float = 0.0) -> Health:
        """Return the values that reactions are decided by. Changes nothing."""
        board = inputs.board
        observation = self._output.observation if self._output is not None else None
        disarmed_s = (now_ns - self._armed_since_ns) * 1e-9 if self._armed_since_ns is not None else 0.0
        if self._disarmed_at is not None and (board.heartbeats == 0 or board.heartbeats > self._disarmed_at):
            disarmed_s = NEVER_S  # two heartbeats say so. By itself, and it knows why: only a person may arm it again
        return Health(
            pose_age_s=_age_s(self._sighted_ns, now_ns),
            identity_age_s=_age_s(self._verified_ns, now_ns),
            station_age_s=inputs.station.age_s,
            board_age_s=_age_s(board.arrival_ns if board.board_ms >= 0 else None, now_ns),
            board_disarmed_s=disarmed_s,
            autopilot=autopilot_name(board.autopilot),
            gyroscope=self._gyroscope_doubt,
            accelerometer=self._gravity.doubt,
            depth_same_s=self._pressure.same_s,
            battery_empty=self._battery.empty,
            emergency_stop=inputs.emergency_stop,
            solver_failed=solver_failed,
            late_s=round(inputs.late_steps * self._period_s, 9),
            echo_wrong_s=self._outputs.wrong_s,
            thrusters_broken=self._thrusters.broken,
            off_path=self._watch.has_left,
            likely_cause=self._watch.likely_cause,
            watch_reason=self._watch.finding.reason,
            watch_detail=self._watch.finding.detail,
            estimate_ended=self._estimate_ended,
            off_depth=self._depth.left,
            depth_age_s=observation.depth_age_s if observation is not None else 0.0,
            depth_leap=observation.depth_leap if observation is not None else "",
            leap=observation.leap if observation is not None else "",
            place_age_s=observation.pose_age_s if observation is not None else 0.0,
            drive_age_s=drive_age_s,
        )

    @property
    def _gyroscope_doubt(self) -> str:
        """The reason to doubt the gyroscope; empty if there is none."""
        if self._rate.same_s:
            return f"exactly the same for {self._rate.same_s:.1f} s"
        apart_rad = self._gyroscope.apart_rad
        return f"its turn and the camera's differ by {apart_rad:.2f} rad" if apart_rad else ""

    @property
    def guidance(self) -> Guidance:
        """State of the guidance: it decides the robot's motion."""
        return self._watch.state

    def arming_refusal(self, inputs: Inputs, station: StationView, now_ns: int) -> str:
        """Return the reason not to arm now; empty if there is none."""
        health, limit_s = self.health(inputs, False, now_ns), self._safety.pose_hold_s
        if inputs.emergency_stop:
            return "the emergency stop is down"
        if station.age_s > self._safety.station_hold_s:
            return "no station is heard"
        if health.board_age_s > limit_s:
            return f"the thruster board was last heard {health.board_age_s:.2f} s ago"
        if health.autopilot:
            return f"{health.autopilot} is on the link, no thruster board: it takes pulses for a pilot's sticks"
        if inputs.board.armed:
            return "the thruster board is still armed"
        if inputs.board.zero_in_question:
            return (
                "the thruster board restarted, and its depth zero is in question: confirm it on the robot with "
                "`robot-agent confirm-zero`, or in air have it taken anew with `robot-agent confirm-zero --in-air`"
            )
        if inputs.board.power_on_depth_m > RESTART_DEPTH_M:
            return (
                f"the thruster board restarted at {inputs.board.power_on_depth_m:.2f} m and took its depth zero there: "
                "restart it in air; or, if it was in air, confirm that on the robot with `robot-agent confirm-zero`"
            )
        if inputs.board.objection:
            return inputs.board.objection
        if health.pose_age_s > limit_s:
            return f"the last pose is {health.pose_age_s:.2f} s old"
        if health.identity_age_s > limit_s:
            return "its identity is not verified: no marker was read"
        depth_m = inputs.board.depth_m
        floor_m = self._pool.size_m[2]
        if self._pool.walls and not -DEPTH_SLACK_M <= depth_m <= floor_m + DEPTH_SLACK_M:
            return f"the depth sensor says {depth_m:.2f} m in a pool of {floor_m:g} m: check it, or its zero"
        if health.depth_age_s > self._safety.pose_neutral_s:
            return f"no depth that can be true for {health.depth_age_s:.2f} s (the sensor says {depth_m:.2f} m)"
        if health.depth_same_s:
            return f"the depth sensor has said exactly {depth_m:.2f} m for {health.depth_same_s:.1f} s: it measures nothing"
        if health.gyroscope:
            return f"gyroscope in doubt: {health.gyroscope}: check the gyroscope, and the marker"
        if health.accelerometer:
            return f"accelerometer in doubt: {health.accelerometer}"
        return self._battery.arming_refusal(now_ns)

    def arming_command(self, armed: bool, mode: Mode, now_ns: int) -> bool | None:
        """Return True to arm the board, False to disarm it, None to send nothing at this step. `armed` is the board's own
        report. Call it once a step. For DISARM_S after the power is taken away, or after the program starts, each step
        disarms."""
        wanted = mode in LIVE
        if wanted is not self._wanted:
            self._wanted, self._wanted_since_ns, self._asked_ns = wanted, now_ns, None
        if armed == wanted:
            self._armed_since_ns, self._board_armed = None, wanted
        elif self._armed_since_ns is None or not wanted:
            self._armed_since_ns = now_ns if wanted else None
        if wanted and not armed and self._board_armed:
            return None  # it has disarmed itself, or one heartbeat is wrong: neither is a reason to arm it
        insists = not wanted and now_ns - self._wanted_since_ns < DISARM_S * 1e9
        is_due = self._asked_ns is None or now_ns - self._asked_ns >= ARM_AGAIN_S * 1e9
        if not insists and (armed == wanted or not is_due):
            return None
        self._asked_ns = now_ns
        return wanted

    def react_by_ns(self, mode: Mode) -> int | None:
        """Instant at which the pose becomes too old for `mode`; None if there is none."""
        if mode not in POWERED or self._sighted_ns is None:
            return None
        limit_s = self._safety.pose_hold_s if mode in UNDER_WAY else self._safety.pose_neutral_s
        return self._sighted_ns + round(limit_s * 1e9) + 1


def _own_yaw_rate_radps(board: BoardReading) -> float:
    """Rate about the hull's own axis, about which thrusters turn it: a tilted hull that swings turns its heading by that."""
    if not board.tilt.size:
        return board.yaw_rate_radps
    roll, pitch, _, pitch_rate = board.tilt.tolist()
    return float(math.cos(roll) * math.cos(pitch) * board.yaw_rate_radps - math.sin(roll) * pitch_rate)


def _age_s(instant_ns: int | None, now_ns: int) -> float:
    return NEVER_S if instant_ns is None else (now_ns - instant_ns) * 1e-9
