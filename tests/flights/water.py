"""Fleet and plant of the grid: robots can be held fast, have a turned marker, be unseen, lose their thrust or others' plans,
or meet another current. The truth at every exposure is kept, for the observer is judged by it."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from robot_agent.agent import Outputs
from robot_agent.inputs import StampedPlan, StampedPose
from shoal.config.experiment import Experiment
from shoal.frames import Array
from shoal.messages.messages import Trajectory
from sim_bridge.in_process.fleet import AgentFleet, DirectPlant

STREAM = 57  # keeps this use of the seed apart from the others
EXPOSURES_KEPT = 128  # more than the oldest pose that an observer may still be at


@dataclass
class Trouble:
    """Things that go wrong, as they are now. The flight switches them on and off."""

    held: bool = False  # the first robot cannot move at all
    thrustless: bool = False  # the first robot's thrusters stand still, whatever it is told
    marker_turn_rad: float = 0.0  # of the first robot: its pose's yaw is wrong by so much
    unseen: bool = False  # no new pose comes
    plans_lost: float = 0.0  # fraction of the plans that do not reach a robot


@dataclass(frozen=True, eq=False)
class TrueState:
    """The truth at the instant of a pose: poses and velocities over ground (n, 4), the water's velocity in the pool (n, 3)."""

    eta: Array
    nu: Array
    water_mps: Array


class TroubledPlant(DirectPlant):
    """The plant with its troubles."""

    def __init__(self, experiment: Experiment, seed: int, starts: Array, trouble: Trouble) -> None:
        super().__init__(experiment, seed, starts)
        self._trouble = trouble
        self._held_eta: Array | None = None
        self._neutral_us = self._pulses_us[0].copy()

    def advance(self, to_ns: int) -> None:
        """Move on; a robot that is held fast is back where it was, at rest."""
        if not self._trouble.held:
            self._held_eta = None
        elif self._held_eta is None:
            self._held_eta = self.eta[0].copy()
        super().advance(to_ns)
        if self._held_eta is not None:
            eta, nu = self.eta.copy(), self.nu.copy()
            eta[0], nu[0] = self._held_eta, 0.0
            self._state = replace(self._state, eta=eta, nu=nu)

    def act(self, i: int, outputs: Outputs) -> None:
        """Take an agent's pulses; thrusters without power get none."""
        super().act(i, outputs)
        if self._trouble.thrustless and i == 0:
            self._pulses_us[0] = self._neutral_us

    def stream(self, current_mps: Array) -> None:
        """Let the water stream at another current (3,) from now on."""
        self._plant.set_current(current_mps)

    def exposure(self) -> TrueState:
        """The truth now."""
        return TrueState(self.eta.copy(), self.nu.copy(), self._plant.water_mps(self._state))


@dataclass(eq=False)
class _PlanInbox:
    """Plans that a robot has got, with the instant of the last one of each other robot."""

    plans: dict[int, StampedPlan] = field(default_factory=dict)
    instants_ns: dict[int, int] = field(default_factory=dict)


class TroubledFleet(AgentFleet):
    """The fleet with its troubles."""

    def __init__(
        self, experiment: Experiment, trajectories: Mapping[int, Trajectory], water: TroubledPlant, seed: int, trouble: Trouble
    ) -> None:
        super().__init__(experiment, trajectories, water, seed)
        self._plant, self._trouble = water, trouble
        self._random = np.random.default_rng([seed, STREAM])
        self._inboxes = [_PlanInbox() for _ in self.robots]
        self._last_seen: dict[int, StampedPose] = {}
        self.exposures: dict[int, TrueState] = {}  # by the instant on the agents' clock, the newest last

    def expose(self, stamp_ns: int) -> None:
        """Localize every robot, and keep the truth."""
        self.exposures[stamp_ns] = self._plant.exposure()
        if len(self.exposures) > EXPOSURES_KEPT:
            del self.exposures[next(iter(self.exposures))]
        super().expose(stamp_ns)

    def pose(self, i: int) -> StampedPose | None:
        """The newest pose that has come."""
        if self._trouble.unseen and i in self._last_seen:
            return self._last_seen[i]
        pose = super().pose(i)
        if pose is not None and i == 0 and self._trouble.marker_turn_rad:
            pose = replace(pose, pose=replace(pose.pose, yaw_rad=pose.pose.yaw_rad + self._trouble.marker_turn_rad))
        if pose is not None:
            self._last_seen[i] = pose
        return pose

    def control_step(self, i: int, plans: Mapping[int, StampedPlan | None]) -> None:
        """One control step of a robot with the plans that have reached it."""
        if not self._trouble.plans_lost:
            super().control_step(i, plans)
            return
        inbox = self._inboxes[i]
        for robot, plan in plans.items():
            if plan is not None and inbox.instants_ns.get(robot) != plan.instant_ns:
                inbox.instants_ns[robot] = plan.instant_ns
                if robot not in inbox.plans or self._random.random() >= self._trouble.plans_lost:
                    inbox.plans[robot] = plan
        super().control_step(i, inbox.plans)
