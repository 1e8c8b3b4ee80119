"""Settings of the robots' control and safety: observer, heading, optimisation, distances, ages."""

from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from wire.config.baseline_controllers import (
    AdaptiveNnConfig,
    BacksteppingConfig,
    FuzzyConfig,
    LawName,
    LqrConfig,
    PidConfig,
    SlidingModeConfig,
)
from wire.config.vehicle import NotNegative, Positive
from wire.toml_loader import Section


class Live:
    """Marks a key that may be changed in flight (live_gains.py): no size and no structure hangs on it, and any value within
    its bounds can be flown."""


LIVE = Live()

Weight = Annotated[float, Field(ge=0, le=100)]
InputWeight = Annotated[float, Field(ge=0, le=1e4)]
Bandwidth = Annotated[float, Field(gt=0, le=50), LIVE]
Gain = Annotated[float, Field(ge=0, le=10), LIVE]


COAST_S = 1.0  # an estimate ends so long after its last pose: prediction alone is none any more
COMMAND_AGE_S = 0.25  # CMD_AGE_MS of a thruster board as it comes (docs/board.md): without pulses for so long it disarms


class Safety(Section):
    """Collision avoidance and freshness."""

    radius_m: Positive = 0.30
    margin_m: NotNegative = 0.05
    bubble_mps: NotNegative = 0.1  # how fast the space around a silent neighbour grows
    bubble_max_m: NotNegative = 0.5  # and how far: a robot that is gone must not push the others against the walls
    pose_hold_s: Positive = 0.19  # hold, then (pose_neutral_s) neutral, counted from the last pose: within 0.2 s, all told
    pose_neutral_s: Annotated[float, Field(gt=0, lt=COAST_S)] = 0.45  # before the estimate ends
    station_hold_s: Positive = 1.0
    station_neutral_s: Positive = 3.0
    station_disarm_s: Annotated[float, Field(gt=0, le=60)] = 10.0  # and a board that is forgotten does not stay armed
    plan_max_age_s: Annotated[float, Field(gt=0, le=5)] = 0.5  # and at most as old as a plan reaches ahead (experiment.py)
    watch_thrusters: bool = True  # neutral when the gyroscope does not feel what the thrusters were told
    off_path_m: Positive = (
        0.3  # neutral when farther off its path than this for 0.5 s, nothing being in the way; still water: 0.1
    )

    off_depth_m: Positive = 0.15  # the same for its depth, whose errors are millimetres: a thruster or an ankle that is dead
    # a robot refuses to begin on its path, or to go on along it, when it is farther away from it than this and than the way
    # from its planned start to the path's first pose together
    join_within_m: Positive = 1.0

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


class EstimatorConfig(Section):
    """Extended state observer (31), bandwidth form b1 = 3w, b2 = 3w^2, b3 = w^3 (Gao 2003). The sensing delay is compensated,
    so noise sets the bandwidth, not delay: at 2 rad/s a pose noise of 1.5 mm makes 2 mm/s in velocity."""

    enabled: bool = True  # False: no disturbance estimate
    bandwidth_radps: Bandwidth = 2.0
    yaw_bandwidth_radps: Bandwidth = 4.0
    use_imu_yaw_rate: bool = True
    sway: bool = True  # False: the article's model, which cannot slide sideways
    current_rate_radps: Gain = 0.15  # how fast a side force that lasts is put down to a current; 0: never


class GuidanceConfig(Section):
    """Reference heading from the force the path asks for: without it a robot that cannot
    push sideways never corrects a lateral error at walking pace."""

    enabled: bool = True
    position_gain_per_s2: Gain = 0.08  # 0.28 rad/s: a third of what heading, filter and observer can follow
    velocity_gain_per_s: Gain = 0.5  # damping ratio 0.9
    max_correction_rad: Annotated[float, Field(gt=0, lt=np.pi / 2), LIVE] = 1.4
    turning_force_n: Annotated[float, Field(gt=0, le=10), LIVE] = 0.02  # forces well below this are not worth a turn
    filter_s: Annotated[float, Field(gt=0, le=30), LIVE] = (
        1.0  # time constant of the force that feeds back: 0.5 follows noise, 2.0 overshoots by 4 cm
    )
    hold_radius_m: Annotated[float, Field(gt=0, le=5), LIVE] = (
        0.06  # station keeping: nearer than this the heading stays as it is
    )


class MpcConfig(Section):
    """Model predictive control (35-40). The article's own setting: horizon 25, blocks of fifteen ones, r = 0.01,
    `linearise = "point"`, no lag."""

    solver: Literal["osqp", "daqp"] = "osqp"
    horizon: Annotated[int, Field(ge=2, le=200)] = 50
    blocks: Annotated[tuple[Annotated[int, Field(ge=1)], ...], Field(min_length=1)] = (1, 1, 2, 3, 4, 4)
    linearise: Literal["trajectory", "point"] = "trajectory"
    q: Annotated[tuple[Weight, Weight, Weight, Weight], LIVE] = (1.0, 1.0, 1.0, 1.0)
    q_formation: Annotated[tuple[Weight, Weight, Weight, Weight], LIVE] = (0.15, 0.15, 0.15, 0.15)
    r: Annotated[tuple[InputWeight, InputWeight, InputWeight], LIVE] = (
        0.05,
        0.05,
        8.0,
    )  # per N^2 and (N m)^2: the same 0.01 for all lets yaw chatter at its rate limit
    slack: Positive = 1e4  # per unit of the largest position weight above 1: no weight buys a way through another robot
    model_lag: bool = True

    @model_validator(mode="after")
    def _blocks_fit(self) -> Self:
        if sum(self.blocks) > self.horizon:
            raise ValueError(f"blocks sum to {sum(self.blocks)} steps, more than horizon = {self.horizon}")
        return self


class ControllerConfig(Section):
    """The control loop of a robot, which runs 1/period_s times a second. `law` computes the wrench from estimate and
    reference."""

    period_s: Annotated[float, Field(ge=0.01, le=COMMAND_AGE_S / 2)] = 0.05  # so that one step may fail to come
    law: LawName = "eso-mpc"
    estimator: EstimatorConfig = EstimatorConfig()
    guidance: GuidanceConfig = GuidanceConfig()
    mpc: MpcConfig = MpcConfig()
    backstepping: BacksteppingConfig = BacksteppingConfig()
    pid: PidConfig = PidConfig()
    lqr: LqrConfig = LqrConfig()
    sliding_mode: SlidingModeConfig = SlidingModeConfig()
    fuzzy: FuzzyConfig = FuzzyConfig()
    adaptive_nn: AdaptiveNnConfig = AdaptiveNnConfig()
