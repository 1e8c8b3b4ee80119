"""Settings of the robots' control and safety: observer, optimisation, distances, ages."""

from itertools import accumulate, pairwise
from typing import Annotated, Any, Literal, Self

from pydantic import Field, model_validator

from shoal.config.baseline_controllers import (
    AdaptiveNnConfig,
    BacksteppingConfig,
    FuzzyConfig,
    Law,
    LqrConfig,
    PidConfig,
    SlidingModeConfig,
)
from shoal.config.loader import Section
from shoal.config.vehicle import NotNegative, Positive


class Live:
    """Marks a key that may be changed in flight (live_gains.py): no size and no structure hangs on it, and any value within
    its bounds can be flown."""


LIVE = Live()

Weight = Annotated[float, Field(ge=0, le=100)]
InputWeight = Annotated[float, Field(ge=0, le=1e4)]
Bandwidth = Annotated[float, Field(gt=0, le=50), LIVE]


COAST_S = 1.0  # an estimate ends so long after its last pose: prediction alone is none any more
WAY_ROOM_M = 0.12  # beyond 2R: robots give way to one that comes nearer; with 0.10 eight robots came to 0.619 m of 0.6
COMMAND_AGE_S = 0.25  # CMD_AGE_MS of a thruster board as it comes (docs/board.md): without pulses for so long it disarms


class Safety(Section):
    """Collision avoidance and freshness."""

    radius_m: Positive = 0.30
    """R of equation (36): centres of robots stay two of these apart. Not less than the vehicle's radius."""
    margin_m: NotNegative = 0.05
    """Distance beyond the least one at which robots, obstacles and walls enter the optimisation."""
    bubble_mps: NotNegative = 0.1
    """Rate at which the space around a silent neighbour grows."""
    bubble_max_m: NotNegative = 0.5
    """Largest growth of that space. After a minute of silence the growth is gone again."""
    pose_hold_s: Positive = 0.19
    """Age of the last pose at which a robot holds: within 0.2 s, one control step included."""
    pose_neutral_s: Annotated[float, Field(gt=0, lt=COAST_S)] = 0.45
    """Age of the last pose at which thrusters go to neutral."""
    station_hold_s: Positive = 1.0
    """Age of the station's last heartbeat at which a robot holds."""
    station_neutral_s: Positive = 3.0
    """Age of the station's last heartbeat at which thrusters go to neutral."""
    station_disarm_s: Annotated[float, Field(gt=0, le=60)] = 10.0
    """Age of the station's last heartbeat at which a robot disarms."""
    plan_max_age_s: Annotated[float, Field(gt=0, le=5)] = 0.5
    """Age up to which a neighbour's plan is used; at most the time that a plan reaches ahead."""
    watch_thrusters: bool = True
    """Go to neutral when the gyroscope does not measure what the thrusters were commanded."""
    off_path_m: Positive = 0.3
    """Distance from its path at which a robot goes to neutral, after 0.5 s with nothing in the way. In still water: 0.1."""
    off_depth_m: Positive = 0.15
    """The same for depth: a dead thruster or ankle shows here first."""
    join_within_m: Positive = 1.0
    """A robot refuses START and RESUME when it is farther from its path than this plus the way from its planned start."""

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
    """Extended state observer (31), bandwidth form b1 = 3w, b2 = 3w^2, b3 = w^3 (Gao 2003). At 2 rad/s a pose noise of 1.5 mm
    makes 2 mm/s in velocity."""

    kind: Literal["eso", "kalman"] = "kalman"
    """The article's observer, or Kalman filters (docs/control.md). Not given: `eso` for `eso-mpc-article`, else `kalman`."""
    enabled: bool = True
    """Estimate the disturbance. False: the estimate is zero."""
    bandwidth_radps: Bandwidth = 2.0
    """Bandwidth w for x, y and z. Higher follows disturbances faster, and passes more noise on."""
    yaw_bandwidth_radps: Bandwidth = 4.0
    """Bandwidth w for yaw."""
    use_imu_yaw_rate: bool = True
    """Use the gyroscope's yaw rate."""
    sway: bool = True
    """Model sideways motion. False: the article's model, which cannot slide sideways."""


MOST_STEPS = 200  # of a horizon


class MpcConfig(Section):
    """Reach of plans and trajectories, and the article's MPC (35-40). Defaults under `eso-mpc-article`: horizon 25, blocks of
    fifteen ones, r = 0.01."""

    horizon: Annotated[int, Field(ge=2, le=MOST_STEPS)] = 50
    """Prediction steps of controller.period_s. Not given: as many as reach 2.5 s ahead, 200 at most."""
    blocks: Annotated[tuple[Annotated[int, Field(ge=1)], ...], Field(min_length=1)] = (1, 1, 2, 3, 4, 4)
    """Steps for which each input is kept, the last one to the horizon's end (move blocking). Not given: the same times at
    every period, within the horizon."""
    q: Annotated[tuple[Weight, Weight, Weight, Weight], LIVE] = (1.0, 1.0, 1.0, 1.0)
    """Weight of squared tracking errors in x, y, z (per m^2) and yaw (per rad^2)."""
    q_formation: Annotated[tuple[Weight, Weight, Weight, Weight], LIVE] = (0.15, 0.15, 0.15, 0.15)
    """Weight of squared formation errors to each neighbour in x, y, z and yaw."""
    r: Annotated[tuple[InputWeight, InputWeight, InputWeight], LIVE] = (0.05, 0.05, 8.0)
    """Weight of squared input changes in surge, heave (per N^2) and yaw (per (N m)^2). With 0.01 for all, yaw chatters at
    its rate limit."""
    slack: Positive = 1e4
    """Penalty of entering another robot's space, per unit of the largest position weight above 1."""

    @model_validator(mode="after")
    def _blocks_fit(self) -> Self:
        if sum(self.blocks) > self.horizon:
            raise ValueError(f"blocks sum to {sum(self.blocks)} steps, more than horizon = {self.horizon}")
        return self


class NonlinearMpcConfig(Section):
    """Nonlinear MPC. All other weights follow from vehicle, control period and noise."""

    heading_m: Annotated[float, Field(ge=0, le=1), LIVE] = 0.01
    """Error of the place that weighs like 1 rad from the direction of motion through the water."""
    arm_m: Annotated[float, Field(gt=0, le=1), LIVE] = 0.2
    """Error of the place that weighs like 1 rad of heading when a person steers. Also sets how smooth the yaw moment is."""
    turning_m: Annotated[float, Field(ge=0, le=1), LIVE] = 0.01
    """Error of the place that weighs like turning at 1 rad/s, on a path."""
    hold_turning_m: Annotated[float, Field(ge=0, le=1), LIVE] = 0.05
    """The same on HOLD. With 0.01 the heading wanders by 0.29 rad/s, with 0.15 the place by 2 cm."""


class ControllerConfig(Section):
    """The control loop of a robot."""

    period_s: Annotated[float, Field(ge=0.01, le=COMMAND_AGE_S / 2)] = 0.05
    """Control period, at most half of the age at which a board disarms."""
    law: Law = "nmpc"
    """Control law: the nonlinear MPC, one that it is compared with, or MODULE:NAME of your own (docs/baselines.md)."""
    own: Annotated[tuple[float, ...], Field(max_length=100, examples=[[0.3, 0.2]])] = ()
    """Numbers for a law of your own."""
    estimator: EstimatorConfig = EstimatorConfig()
    """Extended state observer."""
    mpc: MpcConfig = MpcConfig()
    """Model predictive control."""
    nmpc: NonlinearMpcConfig = NonlinearMpcConfig()
    """Nonlinear MPC."""
    backstepping: BacksteppingConfig = BacksteppingConfig()
    """Backstepping."""
    pid: PidConfig = PidConfig()
    """PID."""
    lqr: LqrConfig = LqrConfig()
    """Linear-quadratic regulator."""
    sliding_mode: SlidingModeConfig = SlidingModeConfig()
    """Sliding mode."""
    fuzzy: FuzzyConfig = FuzzyConfig()
    """Fuzzy PI."""
    adaptive_nn: AdaptiveNnConfig = AdaptiveNnConfig()
    """Adaptive neural network."""

    @model_validator(mode="after")
    def _knows_what_it_knows(self) -> "ControllerConfig":
        if self.law == "nmpc" and self.estimator.kind != "kalman":
            raise ValueError(f'estimator.kind = {self.estimator.kind!r}: the law nmpc needs "kalman"')
        return self

    @model_validator(mode="before")
    @classmethod
    def _looks_as_far_ahead_at_every_rate(cls, given: Any) -> Any:
        """Horizon and blocks that are not given are the default ones in time; no block ends after the horizon."""
        usual_s, mpc_fields = cls.model_fields["period_s"].default, MpcConfig.model_fields
        if not isinstance(given, dict) or not isinstance(period_s := given.get("period_s", usual_s), int | float):
            return given
        if not isinstance(mpc := given.get("mpc", {}), dict) or not 1e-3 < period_s < 1.0:
            return given
        per_step = usual_s / period_s
        horizon = mpc.get("horizon", min(max(round(mpc_fields["horizon"].default * per_step), 2), MOST_STEPS))
        latest = horizon if isinstance(horizon, int) and horizon > 0 else MOST_STEPS  # another is refused for itself
        ends = sorted({min(max(round(end * per_step), 1), latest) for end in accumulate(mpc_fields["blocks"].default)})
        blocks = tuple(end - begin for begin, end in pairwise((0, *ends)))
        return {**given, "mpc": {"horizon": horizon, "blocks": blocks, **mpc}}

    @model_validator(mode="before")
    @classmethod
    def _fill_in_article_defaults(cls, given: Any) -> Any:
        """Before validation, give the article's law its own defaults: the observer (31), and a model without sway."""
        if not isinstance(given, dict) or given.get("law") != "eso-mpc-article":
            return given
        usual: dict[str, dict[str, Any]] = {
            "estimator": {"kind": "eso", "sway": False},
            "mpc": {"horizon": 25, "blocks": (1,) * 15, "r": (0.01, 0.01, 0.01)},
        }
        sections = {name: given.get(name, {}) for name in usual}  # a section that is no table is refused for itself
        return {**given, **{name: {**usual[name], **s} for name, s in sections.items() if isinstance(s, dict)}}
