"""How robots are controlled and what keeps them safe: observer, heading, optimisation, distances and ages."""

from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from wire.laws import AdaptiveNn, Backstepping, Fuzzy, LawName, Lqr, Pid, SlidingMode
from wire.toml_file import Section
from wire.vehicle import NotNegative, Positive

Weight3 = tuple[NotNegative, NotNegative, NotNegative]
Weight4 = tuple[NotNegative, NotNegative, NotNegative, NotNegative]


class Safety(Section):
    """Collision avoidance and freshness."""

    radius_m: Positive = 0.30
    margin_m: NotNegative = 0.05
    bubble_mps: NotNegative = 0.1  # how fast the space around a silent neighbour grows
    bubble_max_m: NotNegative = 0.5  # and how far: a robot that is gone must not push the others against the walls
    pose_hold_s: Positive = 0.2  # hold, then (pose_neutral_s) neutral, counted from the last pose
    pose_neutral_s: Positive = 0.45
    station_hold_s: Positive = 1.0
    station_neutral_s: Positive = 3.0
    station_disarm_s: Positive = 10.0
    plan_max_age_s: Positive = 0.5

    @model_validator(mode="after")
    def _worse_comes_later(self) -> Self:
        for earlier, later in (
            ("pose_hold_s", "pose_neutral_s"),
            ("station_hold_s", "station_neutral_s"),
            ("station_neutral_s", "station_disarm_s"),
        ):
            if not getattr(self, earlier) < getattr(self, later):
                raise ValueError(f"{later} = {getattr(self, later)} must be more than {earlier} = {getattr(self, earlier)}")
        return self


class Estimator(Section):
    """Extended state observer (31), bandwidth form b1 = 3w, b2 = 3w^2, b3 = w^3 (Gao 2003). The sensing delay is compensated,
    so noise sets the bandwidth, not delay: at 2 rad/s a pose noise of 1.5 mm makes 2 mm/s in velocity."""

    enabled: bool = True  # False: no disturbance estimate
    bandwidth_radps: Positive = 2.0
    yaw_bandwidth_radps: Positive = 4.0
    use_imu_yaw_rate: bool = True
    sway: bool = True  # False: the article's model, which cannot slide sideways
    current_rate_radps: NotNegative = 0.15  # how fast a side force that lasts is put down to a current; 0: never


class Guidance(Section):
    """Reference heading from the force the path asks for: without it a robot that cannot
    push sideways never corrects a lateral error at walking pace."""

    enabled: bool = True
    position_gain_per_s2: NotNegative = 0.08  # 0.28 rad/s: a third of what heading, filter and observer can follow
    velocity_gain_per_s: NotNegative = 0.5  # damping ratio 0.9
    max_correction_rad: Annotated[float, Field(gt=0, lt=np.pi / 2)] = 1.4
    turning_force_n: Positive = 0.02  # forces well below this are not worth a turn
    filter_s: Positive = 1.0  # time constant of the force that feeds back: 0.5 follows noise, 2.0 overshoots by 4 cm
    hold_radius_m: Positive = 0.06  # station keeping: nearer than this the heading stays as it is


class Mpc(Section):
    """Model predictive control (35-40). The article's own setting: horizon 25, blocks of fifteen ones, r = 0.01,
    `linearise = "point"`, no lag."""

    solver: Literal["osqp", "daqp"] = "osqp"
    horizon: Annotated[int, Field(ge=2, le=200)] = 50
    blocks: Annotated[tuple[Annotated[int, Field(ge=1)], ...], Field(min_length=1)] = (1, 1, 2, 3, 4, 4)
    linearise: Literal["trajectory", "point"] = "trajectory"
    q: Weight4 = (1.0, 1.0, 1.0, 1.0)
    q_formation: Weight4 = (0.15, 0.15, 0.15, 0.15)
    r: Weight3 = (0.05, 0.05, 8.0)  # per N^2 and (N m)^2: the same 0.01 for all lets yaw chatter at its rate limit
    slack: Positive = 1e4
    model_lag: bool = True

    @model_validator(mode="after")
    def _blocks_fit(self) -> Self:
        if sum(self.blocks) > self.horizon:
            raise ValueError(f"blocks sum to {sum(self.blocks)} steps, more than horizon = {self.horizon}")
        return self


class Controller(Section):
    """What runs on the robot, 1/period_s times a second. `law` is what computes the wrench, given estimate and reference."""

    period_s: Annotated[float, Field(ge=0.01, le=0.5)] = 0.05
    law: LawName = "eso-mpc"
    estimator: Estimator = Estimator()
    guidance: Guidance = Guidance()
    mpc: Mpc = Mpc()
    backstepping: Backstepping = Backstepping()
    pid: Pid = Pid()
    lqr: Lqr = Lqr()
    sliding_mode: SlidingMode = SlidingMode()
    fuzzy: Fuzzy = Fuzzy()
    adaptive_nn: AdaptiveNn = AdaptiveNn()
