"""READ FIRST (control): one control step, from what was sensed to pulse widths. Pure: time is an argument, nothing blocks.

    controller = Controller(vehicle, config, safety)
    output = controller.step(measurement, goal, neighbours, now_ns)     # once per config.period_s

The data's way through `Controller.step`:

    measurement -> Estimator (eso.py)       state at the exposure, predicted to now and to when a new command can act
    goal        -> Reference (reference.py) path over the horizon, heading that lets surge thrust correct lateral errors
    neighbours  -> Formation (formation.py) weighted reference, half-spaces that keep robots apart
                -> Mpc (mpc.py, model.py, qp.py)    wrench over the horizon
                -> Allocator (allocation.py)        4 thrusters and 4 ankles, as pulse widths

The estimator is told that `output.pulse_us` went out at `now_ns`. `goal = None` means neutral: it goes on estimating, puts out
neutral pulses and forgets its plan. All instants are on one clock, the robot's monotonic one (in lockstep the simulator's).
"""

from dataclasses import dataclass

from robot_agent.eso import Measurement, Sighting
from robot_agent.formation import Neighbour
from robot_agent.reference import Follow, Goal, Hold
from wire.frames import Array
from wire.messages import Solve

__all__ = ["ControlOutput", "Follow", "Goal", "Hold", "Measurement", "Neighbour", "Sighting"]


@dataclass(frozen=True, eq=False)
class ControlOutput:
    """Everything one control step found out. Arrays are the caller's to keep: they are never written again."""

    pulse_us: tuple[int, ...]  # 4 thrusters, 4 ankles; neutral unless `solve` is SOLVED or SHIFTED
    wrench: Array  # (3,) asked for: surge N, heave N, yaw N m
    wrench_step: Array  # (3,) its change in this step
    wrench_delivered: Array  # (3,) what the pulses give by the nominal thrust curve
    estimated: bool  # False until the first pose, and after coasting too long: eta, nu, disturbance mean nothing
    eta: Array  # (4,) estimated pose now
    nu: Array  # (4,) estimated velocity now, body frame
    disturbance: Array  # (4,) estimated acceleration that the nominal model does not explain, body frame
    eta_reference: Array  # (4,) the goal now: yaw is the path's tangent
    eta_command: Array  # (4,) what the controller was given: yaw with crab angle and correction
    plan_eta: Array  # (horizon + 1, 4) predicted poses at now + s * period_s; node 0 is `eta`
    plan_reference: Array  # (horizon + 1, 4) the commands the plan is meant to follow, at the same instants
    tracking_error_m: float  # distance from the goal's position
    solve: Solve
    iterations: int
    slack_m: float  # by how much the plan enters the space of another robot
    pose_age_s: float  # of the pose the estimate rests on
