"""Vectors of rigid bodies as records, and the attitude that turns them. Pure.

Axes: a body's are ahead, to starboard, down. Level axes have the body's heading, but no roll and no pitch. The pool frame has
z down. R = Rz(yaw) Ry(pitch) Rx(roll) turns from the body to the pool (Fossen 2021, section 2.2).
"""

import math
from typing import NamedTuple

from shoal.kernels.decorator import kernel
from shoal.kernels.types import Table


class Vector(NamedTuple):
    """Three numbers along or about the axes of a frame."""

    x: float
    y: float
    z: float


class SixVector(NamedTuple):
    """A quantity on a body's six axes: surge, sway, heave, and roll, pitch, yaw about them."""

    linear: Vector  # velocity u, v, w, momentum, or force X, Y, Z
    angular: Vector  # velocity p, q, r, angular momentum, or moment K, M, N


class Rotation(NamedTuple):
    """An attitude: sines and cosines of roll, pitch and yaw."""

    sin_roll: float
    cos_roll: float
    sin_pitch: float
    cos_pitch: float
    sin_yaw: float
    cos_yaw: float


NO_VECTOR = Vector(0.0, 0.0, 0.0)


@kernel(inline=True, part=True)
def row_vector(table: Table, row: int, first: int) -> Vector:
    """Three numbers of a table's row, from column `first` on."""
    return Vector(table[row, first], table[row, first + 1], table[row, first + 2])


@kernel(inline=True, part=True)
def set_row(table: Table, row: int, first: int, value: Vector) -> None:
    """Write three numbers of a table's row, from column `first` on."""
    table[row, first], table[row, first + 1], table[row, first + 2] = value.x, value.y, value.z


@kernel(inline=True, part=True)
def add(a: Vector, b: Vector) -> Vector:
    """a + b."""
    return Vector(a.x + b.x, a.y + b.y, a.z + b.z)


@kernel(inline=True, part=True)
def subtract(a: Vector, b: Vector) -> Vector:
    """a - b."""
    return Vector(a.x - b.x, a.y - b.y, a.z - b.z)


@kernel(inline=True, part=True)
def scale(factor: float, a: Vector) -> Vector:
    """factor * a."""
    return Vector(factor * a.x, factor * a.y, factor * a.z)


@kernel(inline=True, part=True)
def dot(a: Vector, b: Vector) -> float:
    """a . b."""
    return a.x * b.x + a.y * b.y + a.z * b.z


@kernel(inline=True, part=True)
def cross(a: Vector, b: Vector) -> Vector:
    """a x b."""
    return Vector(a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x)


@kernel(inline=True, part=True)
def rotation(roll: float, pitch: float, yaw: float) -> Rotation:
    """The rotation R by roll, pitch and yaw in rad."""
    return Rotation(math.sin(roll), math.cos(roll), math.sin(pitch), math.cos(pitch), math.sin(yaw), math.cos(yaw))


@kernel(inline=True, part=True)
def to_level(turn: Rotation, v: Vector) -> Vector:
    """Ry(pitch) Rx(roll) v: from the body's to level axes."""
    down = turn.sin_roll * v.y + turn.cos_roll * v.z
    side = turn.cos_roll * v.y - turn.sin_roll * v.z
    return Vector(turn.cos_pitch * v.x + turn.sin_pitch * down, side, turn.cos_pitch * down - turn.sin_pitch * v.x)


@kernel(inline=True, part=True)
def from_level(turn: Rotation, v: Vector) -> Vector:
    """The inverse of `to_level`: from level axes to the body's."""
    ahead = turn.cos_pitch * v.x - turn.sin_pitch * v.z
    down = turn.sin_pitch * v.x + turn.cos_pitch * v.z
    return Vector(ahead, turn.cos_roll * v.y + turn.sin_roll * down, turn.cos_roll * down - turn.sin_roll * v.y)


@kernel(inline=True, part=True)
def to_pool(turn: Rotation, v: Vector) -> Vector:
    """R v: from the body's axes to the pool frame."""
    level = to_level(turn, v)
    along, across = turn.cos_yaw * level.x - turn.sin_yaw * level.y, turn.sin_yaw * level.x + turn.cos_yaw * level.y
    return Vector(along, across, level.z)


@kernel(inline=True, part=True)
def to_body(turn: Rotation, v: Vector) -> Vector:
    """R^T v: from the pool frame to the body's axes."""
    ahead, side = turn.cos_yaw * v.x + turn.sin_yaw * v.y, turn.cos_yaw * v.y - turn.sin_yaw * v.x
    return from_level(turn, Vector(ahead, side, v.z))


@kernel(inline=True, part=True)
def angle_rates(turn: Rotation, omega: Vector) -> Vector:
    """Rates d/dt of roll, pitch and yaw at an angular velocity p, q, r on the body's axes (Fossen 2021, eq. 2.31)."""
    yaw_rate = (turn.sin_roll * omega.y + turn.cos_roll * omega.z) / turn.cos_pitch
    pitch_rate = turn.cos_roll * omega.y - turn.sin_roll * omega.z
    return Vector(omega.x + turn.sin_pitch * yaw_rate, pitch_rate, yaw_rate)


@kernel(inline=True, part=True)
def angular_velocity(turn: Rotation, rates: Vector) -> Vector:
    """Angular velocity p, q, r on the body's axes at rates d/dt of roll, pitch and yaw: the inverse of `angle_rates`."""
    level_yaw_rate = turn.cos_pitch * rates.z
    return Vector(
        rates.x - turn.sin_pitch * rates.z,
        turn.cos_roll * rates.y + turn.sin_roll * level_yaw_rate,
        turn.cos_roll * level_yaw_rate - turn.sin_roll * rates.y,
    )
