"""Rehearsal: the robot's own agent on its own experiment, round a circle, with every neighbour's plan. Pure.

It serves to time a control step on the CPU that will run it. The poses are those of a robot that flies as planned, a few
millimetres off; the work of a step does not depend on the tracking error.
"""

from collections.abc import Iterator

import numpy as np

from robot_agent.agent import Agent
from robot_agent.inputs import Inputs, StampedPlan, StampedPose, StationView
from robot_agent.safety.sensor_checks import LEVEL_MPS2
from shoal.config.experiment import Experiment
from shoal.frames import Array
from shoal.messages.codec import Header
from shoal.messages.messages import BoardReading, Command, CommandKind, Plan, Pose, Track, Trajectory

RADIUS_M, SPEED_MPS, DEPTH_M = 0.5, 0.1, 0.3
APART_M = 1.2  # between circles' centres: plans are heard, and no robot is in the way
NOISE = (0.0015, 0.0015, 0.009)  # x, y, yaw: what the localizer has
STATION = 1  # session
ARM_AFTER = 20  # steps, 1 s: until the estimate stands


class RehearsalFailed(Exception):
    """The robot does not fly in this rehearsal, with the reason."""


def rehearse(experiment: Experiment, robot: int) -> Iterator[tuple[Agent, Inputs, int]]:
    """Yield agent, inputs and time of one control step after another, without end; the caller does the step. Raises
    RehearsalFailed if the agent refuses to fly."""
    unmoved = experiment.safety.model_copy(update={"watch_thrusters": False})  # here thrusters move nothing
    experiment = experiment.model_copy(update={"safety": unmoved})
    agent, period_s, noise = Agent(experiment, robot), experiment.controller.period_s, np.random.default_rng(1)
    period_ns, me = round(period_s * 1e9), experiment.robot_ids.index(robot)
    trajectory, full_v = _circle(period_s), experiment.vehicle.battery.full_v
    told_m = DEPTH_M + experiment.robot(robot).depth_offset_m
    k = 0
    while True:
        now_ns = (k + 1) * period_ns
        steps = max(k - ARM_AFTER, 0)
        eta = trajectory.eta[steps % len(trajectory.eta)]
        x, y, yaw = (eta[[0, 1, 3]] + noise.normal(0.0, NOISE)).tolist()
        pose = Pose(x, y, yaw, np.diag(np.square(NOISE)), Track.MARKER, True, 0.9, DEPTH_M)
        station = StationView(STATION, now_ns, 0.0)
        board = BoardReading(
            board_ms=now_ns // 1_000_000,
            arrival_ns=now_ns,
            yaw_rate_radps=SPEED_MPS / RADIUS_M if k > ARM_AFTER else 0.0,
            acceleration_mps2=np.array(LEVEL_MPS2),
            depth_m=told_m,
            armed=k >= ARM_AFTER,
            battery_v=full_v,
        )
        others = ((i, other) for i, other in enumerate(experiment.robot_ids) if other != robot)
        plans = {other: StampedPlan(_plan(experiment, i - me, steps), now_ns) for i, other in others}
        if k == ARM_AFTER:
            given_ns = now_ns - period_ns  # as the last step ends: what that went by is still fresh
            for n, order in enumerate((CommandKind.LOAD, CommandKind.ARM, CommandKind.START), 1):
                command = Command(
                    order,
                    robot,
                    experiment_hash=experiment.hash,
                    trajectory_id=trajectory.id,
                    trajectory=trajectory if order is CommandKind.LOAD else None,
                    start_ns=given_ns + period_ns,
                )
                reply = agent.handle_command(
                    Header(STATION, n, given_ns), command, StationView(STATION, given_ns, 0.0), given_ns
                )
                if not reply.accepted:
                    raise RehearsalFailed(f"{order.name} is refused: {reply.reason}")
        yield agent, Inputs(StampedPose(pose, now_ns - 20_000_000), board, station, plans=plans), now_ns
        k += 1


def _eta(times_s: Array, i: int) -> Array:
    """Poses (n, 4) along a circle: the robot's own around the pool's centre, or the i-th one beside it."""
    angle = times_s * SPEED_MPS / RADIUS_M
    x, y = RADIUS_M * np.cos(angle) + i * APART_M, RADIUS_M * np.sin(angle)
    return np.stack([x, y, np.full_like(angle, DEPTH_M), angle + np.pi / 2], axis=1)


def _circle(period_s: float) -> Trajectory:
    """The rehearsal's trajectory: a minute around the circle."""
    times_s = np.arange(0.0, 60.0, period_s, dtype=np.float64)
    eta = _eta(times_s, 0)
    velocity = np.gradient(eta, period_s, axis=0)
    return Trajectory("rehearsal", period_s, eta, velocity, np.gradient(velocity, period_s, axis=0))


def _plan(experiment: Experiment, i: int, step: int) -> Plan:
    period_s, horizon = experiment.controller.period_s, experiment.controller.mpc.horizon
    eta = _eta(np.arange(step, step + horizon + 1, dtype=np.float64) * period_s, i)
    return Plan(period_s, eta, eta)
