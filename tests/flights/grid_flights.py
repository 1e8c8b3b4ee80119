"""A flight of the grid: planned, flown along its path, then held in place, with its trouble."""

import math
from dataclasses import dataclass, field

import numpy as np

from groundstation.planning import planner
from shoal.config.experiment import Experiment, load_experiment
from shoal.errors import ConfigError
from shoal.frames import Array
from shoal.messages.messages import CommandKind, Mode, RobotState, Trajectory
from tests.flights.cells import SQUARE_M, FlightPlan
from tests.flights.claims import claim_of, nees
from tests.flights.water import Trouble, TroubledFleet, TroubledPlant

CLAIMS_EVERY_S, CLAIMS_FROM_S = 0.5, 5.0
STOPPED = frozenset({Mode.FAULT, Mode.STOPPED, Mode.DISARMED})
AFTER_S = 2.0  # flown on after all robots have stopped
GAPS_EVERY_S = {"gaps": 3.0, "gaps, resumed": 15.0}
SEEN_AGAIN_S = 1.0  # after a gap, then RESUME
TURNS_AT_S, TURNS_IN_S = 20.0, 30.0  # a current that turns round
SWEPT_AT_S, SWEPT_IN_S = 10.0, 3.0  # a current that becomes too strong


@dataclass(eq=False)
class FlightLog:
    """Everything about a flight that figures are made of. Row k is the control step at time (k + 1) period_s from START."""

    plan: FlightPlan
    period_s: float
    refused: str = ""  # reason of a planner or robot that did not begin
    truth: Array = field(default_factory=lambda: np.zeros((0, 1, 4)))  # (steps, n, 4)
    path: Array = field(default_factory=lambda: np.zeros((0, 1, 4)))  # (steps, n, 4): the trajectories
    states: list[list[RobotState]] = field(default_factory=list)  # of each robot
    hold_row: int | None = None  # the first row after HOLD was ordered
    trouble_row: int | None = None  # the first row with the trouble that should stop a robot
    wrench_limit: Array = field(default_factory=lambda: np.ones(3))
    step_limit: Array = field(default_factory=lambda: np.ones(3))
    claims: list[dict[str, float]] = field(default_factory=list)  # NEES of each group of states, all robots


def fly(plan: FlightPlan, hold_s: float) -> FlightLog:
    """Fly a plan whole."""
    try:
        experiment = load_experiment("straight", plan.settings)
        trajectories = planner.plan(experiment)
        starts = planner.start_poses(experiment, trajectories)
    except ConfigError as error:
        return FlightLog(plan, 1.0 / plan.rate_hz, refused=f"planner: {error}")
    if plan.scene == "square":
        trajectories = {robot: square(experiment, plan.speed_mps, len(t.eta)) for robot, t in trajectories.items()}
    trouble = Trouble()
    if plan.of.trouble == "turned marker":
        trouble.marker_turn_rad = math.radians(plan.amount)
    places = np.array([starts[robot] for robot in experiment.robot_ids])
    water = TroubledPlant(experiment, experiment.seed, places, trouble)
    return _Flight(
        plan, experiment, TroubledFleet(experiment, trajectories, water, experiment.seed, trouble), water, trouble
    ).fly(hold_s)


def square(experiment: Experiment, speed_mps: float, samples: int) -> Trajectory:
    """Laps of a square whose velocity turns within one control period: at each corner the reference rests for one sample. Its
    heading follows as quickly as the vehicle can turn."""
    period_s, limits = experiment.controller.period_s, experiment.vehicle.limits
    steps = max(math.ceil(SQUARE_M / (speed_mps * period_s)), 8)  # of a side
    speed_mps = SQUARE_M / (steps * period_s)
    quarter = 0.5 * math.pi
    # a turn by a cosine: its greatest rate is pi/2 times the mean one, its greatest acceleration quarter pi^2 / (2 T^2)
    by_rate_s = 0.5 * math.pi * quarter / (0.8 * limits.yaw_rate_radps)
    by_moment_s = math.pi * math.sqrt(0.5 * quarter * experiment.vehicle.mass.yaw_kg_m2 / (0.4 * limits.wrench[2]))
    turn_s = max(by_rate_s, by_moment_s)
    row = np.arange(samples)
    side, along = row // steps, (row % steps) / steps
    corners = SQUARE_M * np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    ahead = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])[side % 4]
    eta, velocity, acceleration = np.zeros((3, samples, 4))
    eta[:, :2] = corners[side % 4] + SQUARE_M * along[:, None] * ahead
    eta[:, 2] = experiment.path.depth_m
    velocity[:, :2] = np.where((row % steps > 0)[:, None], speed_mps * ahead, 0.0)
    phase = np.pi * np.minimum((row % steps) * period_s / turn_s, 1.0)
    turns, moves = quarter * (side > 0), phase < np.pi
    eta[:, 3] = quarter * side - 0.5 * turns * (1.0 + np.cos(phase))
    velocity[:, 3] = 0.5 * turns * np.pi / turn_s * np.sin(phase) * moves
    acceleration[:, 3] = 0.5 * turns * (np.pi / turn_s) ** 2 * np.cos(phase) * moves
    return Trajectory("square", period_s, eta, velocity, acceleration)


class _Flight:
    """One flight under way."""

    def __init__(
        self, plan: FlightPlan, experiment: Experiment, fleet: TroubledFleet, water: TroubledPlant, trouble: Trouble
    ) -> None:
        self._plan, self._fleet, self._water, self._trouble = plan, fleet, water, trouble
        self._n, limits = len(experiment.robots), experiment.vehicle.limits
        self._period_s = experiment.controller.period_s
        self._log = FlightLog(
            plan,
            self._period_s,
            wrench_limit=np.array(limits.wrench),
            step_limit=np.array(limits.wrench_step(self._period_s)),
        )
        self._claims_at_s, self._claimed_ns = CLAIMS_FROM_S, [-1] * self._n
        self._resume_at_s = math.inf

    def fly(self, hold_s: float) -> FlightLog:
        """Fly the path, then HOLD."""
        log, fleet = self._log, self._fleet
        try:
            fleet.start()
        except ConfigError as error:
            log.refused = str(error)
            return log
        self._fly_until(self._plan.of.path_s)
        if self._plan.of.holds and not self._all_stopped():
            self._trouble.unseen = False
            log.hold_row = len(fleet.truth) - fleet.begin
            for i in range(self._n):
                fleet.order(CommandKind.HOLD, i)
            self._fly_until(self._plan.of.path_s + hold_s)
        log.truth, log.path = np.array(fleet.truth[fleet.begin :]), np.array(fleet.truth[fleet.begin :]) - fleet.errors()
        log.states = [robot.states[fleet.begin :] for robot in fleet.robots]
        return log

    def _fly_until(self, end_s: float) -> None:
        fleet = self._fleet
        while fleet.time_s < end_s - 1e-9:
            self._switch_trouble(fleet.time_s)
            fleet.step()
            self._note_claims(fleet.time_s)
            if self._all_stopped():
                end_s = min(end_s, fleet.time_s + AFTER_S)

    def _all_stopped(self) -> bool:
        return all(robot.agent.mode in STOPPED for robot in self._fleet.robots)

    def _switch_trouble(self, time_s: float) -> None:
        """Bring the trouble to its state at a time."""
        kind, amount, trouble = self._plan.of.trouble, self._plan.amount, self._trouble
        current = np.array(self._plan.current_mps)
        match kind:
            case "gaps" | "gaps, resumed" if self._log.hold_row is None and time_s > 10.0:
                trouble.unseen = time_s % GAPS_EVERY_S[kind] < amount
                self._resume(time_s)
            case "reverse" if TURNS_AT_S < time_s <= TURNS_AT_S + TURNS_IN_S + 1.0:
                turned = math.pi * min((time_s - TURNS_AT_S) / TURNS_IN_S, 1.0)
                cos, sin = math.cos(turned), math.sin(turned)
                self._water.stream(np.array([cos * current[0] - sin * current[1], sin * current[0] + cos * current[1], 0.0]))
            case "swept" if SWEPT_AT_S <= time_s <= SWEPT_AT_S + SWEPT_IN_S + 1.0:
                share = amount * min((time_s - SWEPT_AT_S) / SWEPT_IN_S, 1.0)  # of the robot's speed
                way = self._plan.number  # rad: any direction
                self._water.stream(share * self._plan.fastest_mps * np.array([math.cos(way), math.sin(way), 0.0]))
                if share >= 1.0 and self._log.trouble_row is None:
                    self._begin_trouble()
            case "held at the start" | "turned marker" if self._log.trouble_row is None:
                trouble.held = kind == "held at the start"
                self._begin_trouble()
            case "held" if time_s >= amount and self._log.trouble_row is None:
                trouble.held = True
                self._begin_trouble()
            case "held in an encounter" | "thrustless" if self._log.trouble_row is None and self._nearest_m() < amount:
                trouble.held, trouble.thrustless = kind != "thrustless", kind == "thrustless"
                self._begin_trouble()
            case "plans lost":
                trouble.plans_lost = amount

    def _begin_trouble(self) -> None:
        self._log.trouble_row = len(self._fleet.truth) - self._fleet.begin

    def _nearest_m(self) -> float:
        first, second = self._water.eta[:2, :2]
        return float(np.hypot(*(first - second)))

    def _resume(self, time_s: float) -> None:
        """Order RESUME, as an operator would, when a robot that holds by itself has been seen again for a while."""
        holding = [i for i, robot in enumerate(self._fleet.robots) if robot.agent.mode is Mode.HOLDING]
        if not holding or self._trouble.unseen:
            self._resume_at_s = math.inf
        elif self._resume_at_s == math.inf:
            self._resume_at_s = time_s + SEEN_AGAIN_S
        elif time_s >= self._resume_at_s:
            for i in holding:
                self._fleet.order(CommandKind.RESUME, i, self._period_s, time_s + self._period_s)

    def _note_claims(self, time_s: float) -> None:
        """Hold the observers' beliefs against the truth."""
        if time_s < self._claims_at_s:
            return
        self._claims_at_s += CLAIMS_EVERY_S
        for i, robot in enumerate(self._fleet.robots):
            claim = claim_of(robot.agent)
            if claim is None or claim.at_ns <= self._claimed_ns[i] or claim.at_ns not in self._fleet.exposures:
                continue
            self._claimed_ns[i] = claim.at_ns
            self._log.claims.append(nees(claim, self._fleet.exposures[claim.at_ns], i))
