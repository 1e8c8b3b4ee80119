"""READ FIRST. The simulated pool as one pure object: robots in water, each with its thruster board.

    bytes from the robots' computers -> boards (board.py) -> pulses -> thrusters -> dynamics -> next state
                                                                       sensors -> boards -> bytes to the computers

`step` moves everything to the next event: an exposure, sensors that are due, a board whose outputs change, a fault. Between
events all steps of the plant are one call. sim_bridge/node/pool.py connects it to the wires; time here is the plant's.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Protocol

import numpy as np

from shoal.config.experiment import Experiment
from shoal.frames import Array
from sim_bridge.fault_schedule import BEFORE_S, FaultSchedule
from sim_bridge.plant.fleet import PlantRun, PlantState
from sim_bridge.plant.sensors import BoardSensors
from sim_bridge.thruster_board.board import ThrusterBoard


class WorldBoard(Protocol):
    """A thruster board of the world: a simulated one, or a real one in HIL mode (sim_bridge/node/hil_board.py)."""

    sensors: BoardSensors
    burst_ms: int
    obeys_ns: int | None  # plant time of the order that outputs of the last step obey, if they are known late only

    @property
    def pulses(self) -> tuple[int, ...]: ...
    @property
    def armed(self) -> bool: ...
    @property
    def neutral(self) -> bool: ...
    @property
    def next_event_ns(self) -> int:
        """Plant time until which `step` need not be called. In the past: it has to be at every step of the plant."""

    def receive(self, data: bytes, now_ns: int) -> bool: ...
    def measures(self, now_ns: int) -> bool: ...
    def step(self, now_ns: int, eta: Array, nu: Array, acceleration: Array, supply_v: float, tilt: Array) -> bytes: ...


class World(PlantRun):
    """The fleet in the water from the moment the robots are put in at `starts`, poses (n, 4) in the pool frame."""

    def __init__(
        self,
        experiment: Experiment,
        seed: int,
        starts: Array,
        board_factory: Callable[[Experiment, int, int], WorldBoard] = ThrusterBoard,
        held: bool = False,
    ) -> None:
        """Make the world. With `held` the robots are kept in place until the first of them is armed."""
        super().__init__(experiment, seed, starts)
        self._held = held
        # one thruster board per robot, in the experiment's order
        self.boards: list[WorldBoard] = [board_factory(experiment, robot, seed) for robot in experiment.robot_ids]
        self._frame_period_s = 1.0 / experiment.all_cameras[0].rate_hz
        self._no_acceleration, self._no_voltage = np.zeros_like(starts), [0.0] * len(starts)
        self._frames = 1  # the first is at time 0
        self.faults = FaultSchedule(experiment)
        self.start_ns: int | None = None  # plant time at which the newest flight began; set by the process
        self.exposed = False  # the last step reached the middle of an exposure

    @property
    def exposure_ns(self) -> int:
        """Plant time of the next exposure: the first step at or after it is due."""
        due = self._frames * self._frame_period_s - 1e-9
        return -int(-due * 1e9 // self._step_ns) * self._step_ns

    def receive(self, i: int, data: bytes) -> bool:
        """Give bytes from the i-th robot's computer to its board. Returns True if the board took a frame of them."""
        return self.boards[i].receive(data, self.now_ns)

    def board_ms(self, i: int) -> int:
        """Board time of the i-th board's last burst."""
        return max(self.boards[i].burst_ms, 0)

    def neutral(self, i: int) -> bool:
        """True if the i-th board's thruster outputs are all at neutral."""
        return self.boards[i].neutral

    @property
    def flown_s(self) -> float:
        """Time since the newest flight began."""
        return BEFORE_S if self.start_ns is None else (self.now_ns - self.start_ns) * 1e-9

    def apply_faults(self) -> list[str]:
        """Move the fault timeline to now. Returns a line of text for each fault that began or ended."""
        changes = self.faults.advance(self.flown_s, self.now_ns * 1e-9)
        self._set_gust(self.faults.gust_mps)
        for board, faults in zip(self.boards, self.faults.imu if changes else (), strict=False):
            board.sensors.faults = faults
        return changes

    def break_by_hand(self, what: str, for_s: float) -> str:
        """Take a person's fault, or mend all of them. Returns it as --fault takes it."""
        return self.faults.add(what, for_s, self.flown_s, self.now_ns * 1e-9)

    def next_exposure(self) -> tuple[Array, Array, Array] | None:
        """Poses, velocities and tilts (n, 4) at the next exposure, if no pulse sent from now on can change them; else None.

        Faults that begin meanwhile can change them: compare before use.
        """
        steps = (self.exposure_ns - self.now_ns) // self._step_ns
        if self._held or not 0 < steps <= self._plant.dead_steps:
            return None
        state = self._plant.step(self._state, self.faults.pulses(self._pulses()), self.faults.actuators, steps)
        return state.eta, state.nu, state.tilt

    def _pulses(self) -> Array:
        """Pulses on the boards' outputs, (n, 8)."""
        return np.array([board.pulses for board in self.boards], dtype=np.float64)

    def _next_state(self, steps: int) -> PlantState:
        """The plant some steps on, with the pulses and the faults of now."""
        self._held = self._held and not any(board.armed for board in self.boards)
        if self._held:
            return replace(self._state, steps=self._state.steps + steps)
        return self._plant.step(self._state, self.faults.pulses(self._pulses()), self.faults.actuators, steps)

    def _quiet_steps(self, until_ns: int) -> int:
        """Plant steps to the next event or to `until_ns`, whichever comes first; at least one."""
        due_ns = min(until_ns, self.exposure_ns, *(board.next_event_ns for board in self.boards))
        steps = max(-((self.now_ns - due_ns) // self._step_ns), 1)
        return self.faults.quiet_steps(self.flown_s, self._step_ns * 1e-9, steps, self.now_ns * 1e-9)

    def step(self, until_ns: int = 0) -> list[tuple[int, bytes]]:
        """Move to the next event, but not beyond the first plant step at or after `until_ns`; by one step at least. Returns
        what the boards send: (index of the robot, bytes). Nothing may arrive at a board between two events."""
        self._state = state = self._next_state(self._quiet_steps(until_ns))
        measures = self.boards[0].measures(self.now_ns)  # otherwise the values are not used
        acceleration = self._plant.acceleration(state) if measures else self._no_acceleration
        supply_v = self._plant.rest_v(state, self.faults.actuators).tolist() if measures else self._no_voltage
        self.exposed = self.now_ns * 1e-9 >= self._frames * self._frame_period_s - 1e-9
        if self.exposed:  # of a camera faster than the plant's steps, what falls between two of them is left out
            self._frames = int((self.now_ns * 1e-9 + 1e-9) / self._frame_period_s) + 1
        sent = [
            (i, board.step(self.now_ns, state.eta[i], state.nu[i], acceleration[i], supply_v[i], state.tilt[i]))
            for i, board in enumerate(self.boards)
        ]
        for i, board in enumerate(self.boards):
            if board.obeys_ns is not None:
                self._date_back(i, board.obeys_ns)
        return sent

    def _date_back(self, i: int, ordered_ns: int) -> None:
        """Let the i-th board's outputs act as if they were known from the step after their order on, as a simulated board's
        are: what the way to a real board and back took is no part of a robot, whose dead time has not passed yet."""
        pulses_us = self.faults.pulses(self._pulses())[i]
        steps = (self.now_ns - ordered_ns) // self._step_ns - 1
        self._state = self._plant.with_past_pulses(self._state, i, pulses_us, max(steps, 0))
