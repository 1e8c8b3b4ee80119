"""SHELL: a vehicle: inertia, drag, limits, legs or thrusters, thrust curve. Loaded from a TOML file, checked key by key."""

from collections.abc import Iterator
from functools import cached_property
from pathlib import Path
from typing import Annotated, Self

import numpy as np
from pydantic import Field, model_validator

from shoal.config.loader import Section, check, read_toml
from shoal.errors import ConfigError
from shoal.frames import Array

VEHICLES = Path(__file__).parent / "vehicles"

LEGS = 4  # of every vehicle that has legs: allocation, boards and simulator know no other number
OUTPUTS = 8  # of a board: thrusters and ankles of four legs, or up to eight thrusters that do not turn
AXES = ("surge", "heave", "yaw", "sway")  # order of a wrench. A vehicle without side thrust has the first three
SAME_M = 1e-5  # of legs: nearer than any vehicle is built
REACHED = 1e-6  # of an axis: thrusters that come nearer to giving it alone do give it

Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]
Fraction = Annotated[float, Field(ge=0, le=1)]
Microseconds = Annotated[int, Field(ge=500, le=2500)]


class Mass(Section):
    """Rigid body, flooded water and added mass together, per axis of motion."""

    surge_kg: Positive
    """Mass along x of the body."""
    sway_kg: Positive
    """Mass along y of the body."""
    heave_kg: Positive
    """Mass along z of the body."""
    yaw_kg_m2: Positive
    """Inertia about z of the body."""


class Drag(Section):
    """force = linear * v + quadratic * |v| v, for [surge, sway, heave, yaw]."""

    linear: tuple[Positive, Positive, Positive, Positive]
    """N s/m, and N m s for yaw."""
    quadratic: tuple[NotNegative, NotNegative, NotNegative, NotNegative]
    """kg/m, and N m s^2 for yaw."""


Wrench3 = tuple[Positive, Positive, Positive]
Wrench4 = tuple[Positive, Positive, Positive, Positive]


class Limits(Section):
    """The limits of the controller. Wrenches are [surge N, heave N, yaw N m], and sway N if thrusters push sideways too. Their
    rates are the same per second."""

    wrench: Wrench3 | Wrench4
    """Largest wrench, N, N and N m (39); a fourth number is the largest side force, N."""
    wrench_rate_per_s: Wrench3 | Wrench4
    """Largest change of the wrench per second (40)."""
    speed_mps: Positive
    """Largest horizontal speed."""
    heave_mps: Positive
    """Largest vertical speed."""
    yaw_rate_radps: Positive
    """Largest yaw rate."""

    @model_validator(mode="after")
    def _same_axes(self) -> Self:
        if len(self.wrench) != len(self.wrench_rate_per_s):
            raise ValueError(
                f"wrench_rate_per_s: has {len(self.wrench_rate_per_s)} numbers, wrench has {len(self.wrench)} (both: surge, "
                "heave, yaw, and sway where thrusters push sideways)"
            )
        return self

    @property
    def has_sway(self) -> bool:
        """True if thrusters push sideways."""
        return len(self.wrench) == len(AXES)

    def wrench_step(self, period_s: float) -> tuple[float, ...]:
        """The largest change per control step, (40): N, N, N m, and N."""
        per_s = 1.0 / period_s  # 6 N/s over 20 Hz is 0.3 N to the last bit; 6 N/s times 0.05 s is not
        return tuple(rate / per_s for rate in self.wrench_rate_per_s)


class Legs(Section):
    """Four legs whose ankles turn the thrusters in the vertical plane (the article's "H" propulsion)."""

    position_m: tuple[tuple[float, float], ...]
    """Thrusters x ahead, y to starboard in the body frame: front left, front right, rear left, rear right."""
    ankle_range_rad: Annotated[float, Field(gt=0, le=np.pi)]
    """Largest turn of an ankle from ahead, either way."""
    ankle_rate_radps: Positive
    """Largest rate of an ankle."""
    ankle_dead_time_s: NotNegative
    """Time before an ankle begins to turn."""
    ankle_us: tuple[Microseconds, Microseconds]
    """Pulse widths at -ankle_range_rad and at +ankle_range_rad."""
    idle_thrust_n: NotNegative
    """Thrust with which front and rear legs work against each other, so that small forces stay clear of the dead zone."""

    @model_validator(mode="after")
    def _ankles_can_turn(self) -> Self:
        if self.ankle_us[0] >= self.ankle_us[1]:
            raise ValueError(f"ankle_us = {list(self.ankle_us)}: must rise: at -ankle_range_rad, at +ankle_range_rad")
        return self

    @model_validator(mode="after")
    def _stand_in_a_rectangle(self) -> Self:
        if len(self.position_m) != LEGS:
            raise ValueError(
                f"position_m: has {len(self.position_m)} legs (allowed: exactly {LEGS}; this version models four "
                "steerable legs: docs/vehicle.md)"
            )
        x, y = np.abs(self.position_m).T
        if np.ptp(x) > SAME_M or np.ptp(y) > SAME_M or len(set(self.position_m)) != 4:
            positions = [list(position) for position in self.position_m]
            raise ValueError(f"position_m = {positions}: must be the corners of a rectangle around the centre")
        return self


class FixedThruster(Section):
    """A thruster that does not turn. Its curve is that of all thrusters."""

    position_m: tuple[float, float, float]
    """Place in the body frame: x ahead, y to starboard, z down from the hull's centre."""
    direction: tuple[float, float, float]
    """Direction of the force on the robot by positive thrust, in the body frame; of any length."""
    channel: Annotated[int, Field(ge=1, le=OUTPUTS)]
    """The board's output, from 1, that its speed controller is connected to."""

    @model_validator(mode="after")
    def _pushes_somewhere(self) -> Self:
        if not np.isfinite([*self.position_m, *self.direction]).all() or np.linalg.norm(self.direction) < SAME_M:
            raise ValueError(f"direction = {list(self.direction)}: must be a vector with a length")
        return self


class Thruster(Section):
    """One thruster with its speed controller: static curve (microseconds to newtons) and dynamics."""

    max_thrust_n: Positive
    """Largest thrust that allocation asks for."""
    lag_s: NotNegative
    """Time constant, first order."""
    dead_time_s: NotNegative
    """Time from an order of the robot's computer until thrust begins to change, mean: link, board and half a period of the
    pulses in it."""
    neutral_us: Microseconds
    """Pulse width at which it stands still."""
    curve: Annotated[tuple[tuple[Microseconds, float], ...], Field(min_length=4)]
    """Pulse width in microseconds and thrust in newtons, rising; negative is reverse."""

    @model_validator(mode="after")
    def _curve_is_usable(self) -> Self:
        points = np.array(self.curve)
        if np.any(np.diff(points[:, 0]) <= 0) or np.any(np.diff(points[:, 1]) < 0):
            raise ValueError("curve must rise: microseconds strictly, newtons never falling")
        if not (points[0, 1] < 0 < points[-1, 1]):
            raise ValueError("curve must reach from reverse (negative newtons) to forward thrust")
        if self.force_n(np.array(float(self.neutral_us))) != 0.0:
            raise ValueError(f"neutral_us = {self.neutral_us} must lie in the curve's dead zone (0 N)")
        if self.max_thrust_n > points[-1, 1]:
            raise ValueError(f"max_thrust_n = {self.max_thrust_n} is more than the curve's {points[-1, 1]} N full ahead")
        return self

    @cached_property
    def _points(self) -> tuple[Array, Array]:
        points = np.array(self.curve, dtype=np.float64)
        return points[:, 0], points[:, 1]

    @cached_property
    def _branches(self) -> tuple[Array, Array, Array, Array]:
        """(newtons, microseconds) of the reverse and of the forward branch, each from its edge of the dead zone."""
        us, force = self._points
        last_reverse = int(np.flatnonzero(force < 0)[-1]) + 1
        first_forward = int(np.flatnonzero(force > 0)[0]) - 1
        return (
            force[: last_reverse + 1],
            us[: last_reverse + 1],
            force[first_forward:],
            us[first_forward:],
        )

    def force_n(self, pulse_us: Array) -> Array:
        """Steady thrust in N for a pulse width in us (any shape), by the nominal curve."""
        us, force = self._points
        return np.asarray(np.interp(pulse_us, us, force))

    def pulse_us(self, force_n: Array) -> Array:
        """Pulse width in us (float, any shape) for a thrust in N, clipped to the curve's ends. The inverse of `force_n`:
        a force of any size is put just outside the dead zone, exactly zero is neutral."""
        reverse_force, reverse_us, forward_force, forward_us = self._branches
        forward = np.interp(force_n, forward_force, forward_us)
        reverse = np.interp(force_n, reverse_force, reverse_us)
        return np.where(force_n > 0, forward, np.where(force_n < 0, reverse, float(self.neutral_us)))


class Battery(Section):
    """Thresholds in volts at the battery, and the hysteresis before a warning is taken back."""

    cells: Annotated[int, Field(gt=0)]
    """Cells in series."""
    full_v: Positive
    """Voltage when charged."""
    warn_v: Positive
    """Below it, an alarm."""
    no_arm_v: Positive
    """Below it, a robot does not arm."""
    neutral_v: Positive
    """Below it, thrusters go to neutral."""
    hysteresis_v: NotNegative
    """Rise above a threshold at which a warning is taken back."""

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if not self.full_v > self.warn_v > self.no_arm_v > self.neutral_v:
            raise ValueError("must fall in this order: full_v > warn_v > no_arm_v > neutral_v")
        return self


class Marker(Section):
    """Marker on top of the robot, its upper edge ahead; the id is the experiment's, the dictionary the localizer's."""

    side_m: Positive
    """Side of the marker's black square."""
    height_m: NotNegative
    """Height of the plate above the robot's centre."""


class Righting(Section):
    """Weight below buoyancy keeps the hull level while thrusters below its centre push it."""

    moment_nm: Positive
    """Righting moment per sine of the tilt."""
    thrusters_below_m: NotNegative
    """Thrusters' distance below the centre."""
    swing_s: Positive
    """Period of a free swing."""


THRUSTERS_EXAMPLE = [{"position_m": [0.1, -0.1, 0.0], "direction": [1.0, 1.0, 0.0], "channel": 1}]


class Vehicle(Section):
    """Everything about one kind of robot that the controller, the localizer or the board must know."""

    name: str
    """Name of the vehicle."""
    radius_m: Positive
    """Radius of the hull, a sphere around the centre."""
    mass: Mass
    """Mass."""
    drag: Drag
    """Drag."""
    limits: Limits
    """Limits."""
    legs: Legs | None = None
    """Legs whose ankles turn the thrusters; a vehicle has these, or `thrusters`."""
    thrusters: Annotated[tuple[FixedThruster, ...], Field(examples=[THRUSTERS_EXAMPLE])] = ()
    """Thrusters that do not turn."""
    thruster: Thruster
    """Thrusters."""
    battery: Battery
    """Battery."""
    marker: Marker
    """Marker."""
    righting: Annotated[Righting | None, Field(examples=[{"moment_nm": 1.9, "thrusters_below_m": 0.05, "swing_s": 1.6}])] = (
        None
    )
    """Righting moment. Left out: thrust does not tilt the hull."""

    @model_validator(mode="after")
    def _has_thrusters(self) -> Self:
        if (self.legs is None) == (not self.thrusters):
            system = "neither" if self.legs is None else "both"
            raise ValueError(f"thrusters: has {system} (allowed: a table [legs], or tables [[thrusters]])")
        if self.legs is not None:
            if self.limits.has_sway:
                raise ValueError("limits.wrench: has a fourth number, but legs do not push sideways (allowed: 3 numbers)")
            return self
        channels = [thruster.channel for thruster in self.thrusters]
        if len(set(channels)) != len(channels):
            twice = next(channel for channel in channels if channels.count(channel) > 1)
            raise ValueError(f"thrusters: channel {twice} is given twice")
        forces = np.linalg.pinv(self.mixing)  # (outputs, 4) for one newton, or one newton metre, of each axis
        reached = self.mixing @ forces
        least_n = min(self.thruster.max_thrust_n, -self.thruster.curve[0][1])  # that a thruster gives both ways
        for axis, limit in enumerate(self.limits.wrench):
            if abs(reached[axis, axis] - 1.0) > REACHED or np.abs(np.delete(reached[:, axis], axis)).max() > REACHED:
                raise ValueError(f"thrusters: cannot give {AXES[axis]} without another axis (limits.wrench claims it)")
            most = least_n / np.abs(forces[:, axis]).max()
            if limit > most * (1.0 + REACHED):
                raise ValueError(
                    f"limits.wrench: {limit:g} of {AXES[axis]} is more than the thrusters give alone, {most:.3g} (of "
                    f"{least_n:g} N each, both ways)"
                )
        return self

    @cached_property
    def thruster_table(self) -> Array:
        """Place m and direction, of length 1, of the fixed thruster on each output (8, 6); zero for an output without one."""
        table = np.zeros((OUTPUTS, 6))
        for thruster in self.thrusters:
            direction = np.array(thruster.direction)
            table[thruster.channel - 1] = *thruster.position_m, *(direction / np.linalg.norm(direction))
        return table

    @cached_property
    def mixing(self) -> Array:
        """Wrench (4,) in the order of AXES by a newton of the fixed thruster on each output, (4, 8)."""
        place, way = self.thruster_table[:, :3], self.thruster_table[:, 3:]
        return np.stack([way[:, 0], way[:, 2], place[:, 0] * way[:, 1] - place[:, 1] * way[:, 0], way[:, 1]])

    @property
    def thruster_count(self) -> int:
        """Number of the outputs, from the first on, that are thrusters'; the others are ankles'."""
        return LEGS if self.legs is not None else OUTPUTS

    @property
    def thruster_channels(self) -> tuple[int, ...]:
        """The board's outputs, from 1, that have a thruster."""
        return tuple(range(1, LEGS + 1)) if self.legs is not None else tuple(sorted(t.channel for t in self.thrusters))

    @property
    def thruster_places(self) -> list[list[float]]:
        """Place m and direction of each thruster by output, as in `thruster_table`; a leg's is ahead, with its ankle level."""
        if self.legs is None:
            return [list(map(float, row)) for row in self.thruster_table]
        return [[x, y, 0.0, 1.0, 0.0, 0.0] for x, y in self.legs.position_m]

    def thruster_name(self, output: int) -> str:
        """Name of the thruster on an output (from 0) by its place: front left, and so on."""
        ahead, starboard, _, along, across, down = self.thruster_places[output]
        if not (along or across or down):
            return f"output {output + 1}"
        upright = ", vertical" if abs(down) > max(abs(along), abs(across)) else ""
        return f"{'front' if ahead > 0 else 'rear'} {'right' if starboard > 0 else 'left'}{upright}"

    @property
    def ranges_us(self) -> tuple[tuple[int, int], ...]:
        """Least and most pulse of each output: a thruster's curve, an ankle's range."""
        curve, ankles = self.thruster.curve, () if self.legs is None else (self.legs.ankle_us,) * LEGS
        return ((curve[0][0], curve[-1][0]),) * self.thruster_count + ankles

    @property
    def neutral_us(self) -> tuple[int, ...]:
        """Pulses of all outputs with which no thruster turns and every ankle is level."""
        still = (self.thruster.neutral_us,)
        return still * OUTPUTS if self.legs is None else still * LEGS + (round(0.5 * sum(self.legs.ankle_us)),) * LEGS

    @cached_property
    def inertia(self) -> Array:
        """Diagonal of the mass matrix for nu = [surge, sway, heave, yaw], shape (4,): kg, kg, kg, kg m^2."""
        m = self.mass
        return np.array([m.surge_kg, m.sway_kg, m.heave_kg, m.yaw_kg_m2])

    @cached_property
    def drag_linear(self) -> Array:
        """Linear drag of nu = [surge, sway, heave, yaw], shape (4,): N s/m, and N m s for yaw."""
        return np.array(self.drag.linear)

    @cached_property
    def drag_quadratic(self) -> Array:
        """Quadratic drag of nu = [surge, sway, heave, yaw], shape (4,): kg/m, and N m s^2 for yaw."""
        return np.array(self.drag.quadratic)

    def demands(self, velocity: Array, acceleration: Array) -> Iterator[tuple[str, str, int, float, Array]]:
        """The demands of a motion: name, unit, power of the speed with which it grows, limit, values (n,).

        `velocity` and `acceleration` are those of the pose in the pool frame, (n, 4).
        """
        speed = np.hypot(velocity[:, 0], velocity[:, 1])
        yield "speed", "m/s", 1, self.limits.speed_mps, speed
        yield "heave", "m/s", 1, self.limits.heave_mps, np.abs(velocity[:, 2])
        yield "yaw rate", "rad/s", 1, self.limits.yaw_rate_radps, np.abs(velocity[:, 3])
        flow = np.column_stack([speed, speed, np.abs(velocity[:, 2]), np.abs(velocity[:, 3])])
        force = self.inertia * acceleration + (self.drag_linear + self.drag_quadratic * flow) * velocity
        surge_n, heave_n, yaw_nm, *sway_n = self.limits.wrench
        # no side thruster: in a bend the robot turns inwards until surge gives the side force too. With one, the weaker counts
        yield "thrust", "N", 2, min([surge_n, *sway_n]), np.hypot(force[:, 0], force[:, 1])
        yield "heave thrust", "N", 2, heave_n, np.abs(force[:, 2])
        yield "yaw moment", "N m", 2, yaw_nm, np.abs(force[:, 3])


def load_vehicle(name_or_path: str, relative_to: Path | None = None) -> Vehicle:
    """The vehicle of a shipped file (`spherical`) or of a path ending in .toml. Raises ConfigError."""
    if name_or_path.endswith(".toml"):
        path = (relative_to or Path()) / name_or_path
    else:
        path = VEHICLES / f"{name_or_path}.toml"
        if not path.is_file():
            names = ", ".join(sorted(p.stem for p in VEHICLES.glob("*.toml")))
            raise ConfigError(
                f"vehicle = {name_or_path!r}: no such vehicle (allowed: {names}, or a path ending in .toml: docs/vehicle.md)"
            )
    return check(Vehicle, read_toml(path), str(path))
