"""The state of a robot as the equations of motion have it: 12 numbers in a row of a table, and what they are on level axes.

x, y, z, roll, pitch, yaw    place m and attitude rad in the pool frame
u, v, w, p, q, r             velocity over ground m/s and rad/s, on the body's axes
"""

from typing import NamedTuple

from shoal.kernels.decorator import kernel
from shoal.kernels.types import Table
from sim_bridge.plant.vectors import (
    Rotation,
    SixVector,
    Vector,
    add,
    angle_rates,
    angular_velocity,
    cross,
    from_level,
    rotation,
    row_vector,
    set_row,
    to_level,
    to_pool,
)

STATES = 12
PLACE, ROLL, PITCH, YAW, LINEAR, ANGULAR = 0, 3, 4, 5, 6, 9  # columns; vectors begin there
SURGE, SWAY, HEAVE, TURN = 0, 1, 2, 3  # columns of eta and nu on level axes, which turn with the heading
ROLL_RATE, PITCH_RATE = 2, 3  # columns of tilt, after roll and pitch


class LevelMotion(NamedTuple):
    """Poses, velocities and tilts of n robots. Velocities are over ground, on level axes that turn with the heading:
    eta' = J(yaw) nu holds for any tilt."""

    eta: Table  # (n, 4) x, y, z, yaw
    nu: Table  # (n, 4)
    tilt: Table  # (n, 4) roll, pitch, and d/dt of them


@kernel(inline=True, part=True)
def place_of(states: Table, i: int) -> Vector:
    """Place of robot i."""
    return row_vector(states, i, PLACE)


@kernel(inline=True, part=True)
def rotation_of(states: Table, i: int) -> Rotation:
    """Attitude of robot i."""
    return rotation(states[i, ROLL], states[i, PITCH], states[i, YAW])


@kernel(inline=True, part=True)
def nu_of(states: Table, i: int) -> SixVector:
    """Velocity of robot i over ground, on its axes."""
    return SixVector(row_vector(states, i, LINEAR), row_vector(states, i, ANGULAR))


@kernel(part=True)
def pool_velocity(states: Table, i: int) -> Vector:
    """Velocity of robot i in the pool frame."""
    return to_pool(rotation_of(states, i), row_vector(states, i, LINEAR))


@kernel(part=True)
def set_state(states: Table, motion: LevelMotion, i: int) -> None:
    """Write the state of robot i from its motion on level axes."""
    eta, nu, tilt = motion
    states[i, ROLL], states[i, PITCH], states[i, YAW] = tilt[i, 0], tilt[i, 1], eta[i, TURN]
    turn = rotation_of(states, i)
    set_row(states, i, PLACE, row_vector(eta, i, 0))
    set_row(states, i, LINEAR, from_level(turn, row_vector(nu, i, 0)))
    rates = Vector(tilt[i, ROLL_RATE], tilt[i, PITCH_RATE], nu[i, TURN])
    set_row(states, i, ANGULAR, angular_velocity(turn, rates))


@kernel(part=True)
def set_motion(states: Table, motion: LevelMotion, i: int) -> None:
    """Write the motion of robot i on level axes from its state: the inverse of `set_state`."""
    eta, nu, tilt = motion
    attitude = rotation_of(states, i)
    velocity = nu_of(states, i)
    rates = angle_rates(attitude, velocity.angular)
    set_row(eta, i, 0, place_of(states, i))
    eta[i, TURN] = states[i, YAW]
    set_row(nu, i, 0, to_level(attitude, velocity.linear))
    nu[i, TURN] = rates.z
    tilt[i, 0] = states[i, ROLL]
    tilt[i, 1] = states[i, PITCH]
    tilt[i, ROLL_RATE] = rates.x
    tilt[i, PITCH_RATE] = rates.y


@kernel(part=True)
def set_level_acceleration(states: Table, rates: Table, acceleration: Table, i: int) -> None:
    """Write d/dt (n, 4) of the level velocity of robot i.

    With Q = Ry Rx: d/dt (Q v) = Q (v' + omega x v) - yaw' z x Q v, and cos(pitch) yaw' = sin(roll) q + cos(roll) r.
    """
    turn, (v, omega) = rotation_of(states, i), nu_of(states, i)
    angles = angle_rates(turn, omega)
    v_level = to_level(turn, v)
    v_rate = to_level(turn, add(row_vector(rates, i, LINEAR), cross(omega, v)))
    omega_rate = row_vector(rates, i, ANGULAR)
    turning = turn.sin_roll * omega_rate.y + turn.cos_roll * omega_rate.z + angles.x * angles.y
    acceleration[i, SURGE] = v_rate.x + angles.z * v_level.y
    acceleration[i, SWAY] = v_rate.y - angles.z * v_level.x
    acceleration[i, HEAVE] = v_rate.z
    acceleration[i, TURN] = (turning + angles.z * turn.sin_pitch * angles.y) / turn.cos_pitch
