"""Motion of a fleet: the rates of one robot's state, and the classical Runge-Kutta method (RK4) for all robots.

`advance` is the one to read first. Robots are computed one after the other, stage by stage, because hulls in contact depend on
each other's places.
"""

import math
from typing import NamedTuple

from shoal.kernels.decorator import kernel
from shoal.kernels.types import Floats, Table
from sim_bridge.plant.actuators import (
    ActuatorCommands,
    Actuators,
    Lapse,
    Motors,
    lapse_of,
    move_actuators,
    set_targets,
    thrusters_wrench,
)
from sim_bridge.plant.battery import BatteryPack, charge_after, thrust_factor
from sim_bridge.plant.contact import BasinContact, basin_force, hulls_force
from sim_bridge.plant.currents_waves import Flow, WaterMotion, gust_motion, water_motion
from sim_bridge.plant.rigid_body import BodyConstants, body_acceleration
from sim_bridge.plant.robot_state import (
    ANGULAR,
    LINEAR,
    PLACE,
    ROLL,
    STATES,
    LevelMotion,
    nu_of,
    place_of,
    rotation_of,
    set_level_acceleration,
    set_motion,
    set_state,
)
from sim_bridge.plant.vectors import SixVector, add, angle_rates, scale, set_row, to_body, to_pool

STAGES = (0.0, 0.5, 0.5, 1.0)  # of RK4: instants of a step at which rates are taken
WEIGHTS = (1.0, 2.0, 2.0, 1.0)
AHEAD = (0.5, 0.5, 1.0, 0.0)  # of a step, from its start: the state for the next stage
AT_ONCE_S = 1e-9  # s after its start at which a step is first evaluated: without lag the force jumps at the start itself


class Parts(NamedTuple):
    """Constants of the equations, by physical part."""

    actuators: Actuators
    battery: BatteryPack
    flow: Flow
    basin: BasinContact
    hull: BodyConstants


class FleetVariables(NamedTuple):
    """Variables of n robots that a step changes."""

    motion: LevelMotion
    motors: Motors
    charge: Floats  # (n,) of the batteries, 0 to 1


class StateTables(NamedTuple):
    """States of n robots within a step, (n, STATES) each."""

    start: Table
    state: Table
    rate: Table
    total: Table  # weighted sum of the rates


class Span(NamedTuple):
    """Some steps of the plant's time."""

    first_step: int
    steps: int
    step_s: float


class Instant(NamedTuple):
    """Quantities of an instant that all robots share."""

    time_s: float
    lapse: Lapse  # of the actuators since the step's start
    gust: WaterMotion


@kernel(part=True)
def set_rate(i: int, parts: Parts, motors: Motors, tables: StateTables, now: Instant) -> None:
    """Write d/dt of the state of robot i: eta' = J(eta) nu, and nu' of the forces of thrusters, contact and disturbance."""
    state, rate, hull = tables.state, tables.rate, parts.hull
    place, turn, nu = place_of(state, i), rotation_of(state, i), nu_of(state, i)
    velocity = to_pool(turn, nu.linear)
    water = water_motion(parts.flow, now.gust, place, now.time_s)
    contact = add(basin_force(parts.basin, place, velocity), hulls_force(parts.basin, state, i))
    thrust, wave = thrusters_wrench(i, motors, parts.actuators, now.lapse), math.sin(hull.disturbance_radps[i] * now.time_s)
    force = add(add(thrust.linear, scale(wave, hull.disturbance.linear)), to_body(turn, contact))
    tau = SixVector(force, add(thrust.angular, scale(wave, hull.disturbance.angular)))
    acceleration = body_acceleration(hull, turn, place.z, nu, tau, water)
    set_row(rate, i, PLACE, velocity)
    set_row(rate, i, ROLL, angle_rates(turn, nu.angular))
    set_row(rate, i, LINEAR, acceleration.linear)
    set_row(rate, i, ANGULAR, acceleration.angular)


@kernel
def advance(fleet: FleetVariables, commands: ActuatorCommands, span: Span, parts: Parts, tables: StateTables) -> None:
    """Move a fleet on by some steps, in place, with constant pulses on the outputs."""
    motion, motors, charge = fleet
    start, state, rate, total = tables
    robots, step_s = len(charge), span.step_s
    for step in range(span.steps):
        begin_s = (span.first_step + step) * step_s
        for i in range(robots):
            factor = thrust_factor(i, parts.battery, charge[i], motors.force_n, commands.lost_v[i])
            set_targets(i, motors, parts.actuators, commands, step, factor)
            set_state(state, motion, i)
        start[:] = state
        total[:] = 0.0
        for stage in range(len(STAGES)):
            since_s = STAGES[stage] * step_s
            time_s = begin_s + since_s
            lapse = lapse_of(parts.actuators, max(since_s, AT_ONCE_S))
            now = Instant(time_s, lapse, gust_motion(parts.flow, time_s))
            for i in range(robots):
                set_rate(i, parts, motors, tables, now)
            for i in range(robots):
                for k in range(STATES):
                    total[i, k] += WEIGHTS[stage] * rate[i, k]
                    state[i, k] = start[i, k] + AHEAD[stage] * step_s * rate[i, k]
        lapse = lapse_of(parts.actuators, step_s)
        for i in range(robots):
            for k in range(STATES):
                state[i, k] = start[i, k] + step_s / 6.0 * total[i, k]
            set_motion(state, motion, i)
            move_actuators(i, motors, parts.actuators, lapse)
            charge[i] = charge_after(i, parts.battery, charge[i], motors.force_n, step_s)


@kernel
def accelerations(
    fleet: FleetVariables, time_s: float, parts: Parts, tables: StateTables, acceleration: Table, wrench: Table
) -> None:
    """d/dt (n, 4) of the level velocities now, and the thrusters' force and moment (n, 6). Motors are where their targets
    are."""
    now = Instant(time_s, lapse_of(parts.actuators, AT_ONCE_S), gust_motion(parts.flow, time_s))
    for i in range(len(fleet.charge)):
        set_state(tables.state, fleet.motion, i)
    for i in range(len(fleet.charge)):
        set_rate(i, parts, fleet.motors, tables, now)
        set_level_acceleration(tables.state, tables.rate, acceleration, i)
        thrust = thrusters_wrench(i, fleet.motors, parts.actuators, now.lapse)
        set_row(wrench, i, 0, thrust.linear)
        set_row(wrench, i, 3, thrust.angular)
