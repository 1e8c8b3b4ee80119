"""Reference heading: the direction in which thrust produces the force that the reference needs.

The robot has no side force, so its heading is the direction in which it can push, as for a quadrotor. With the sway-aware
model the heading is that of the force F, so that no part of it is left along the body's y axis j:

    F = M (a_ref + kp e_position + kd e_velocity - Gamma_v j) + d_v(|V|) V        V = V_ref - current

This holds the crab angle of a turn, leans into a current, looks ahead along a bend, and steers back to the path. Of Gamma only
the side force counts: surge thrust compensates a surge disturbance. (With the whole of Gamma a robot with a strong thruster
oscillated by 0.4 rad.) The opposite heading is as good: thrust reverses. kp and kd grow with the speed through the water: a
slow robot turns far for a small force, and with a fast one's gains it swings.

The article keeps the path's tangent, and never corrects a lateral error at walking pace: 0.33 m on its own circle. Its model
without sway moves where it points, so there the heading is that of the velocity V + (kp / kd) e_position.
"""

import cmath
import math

import numpy as np

from robot_agent.guidance.reference import Reference
from shoal.config.controller import GuidanceConfig
from shoal.config.vehicle import Vehicle
from shoal.frames import Array, wrap
from shoal.kernels.decorator import kernel

FAST_MPS = 0.06  # from here on through the water a force aside costs little heading, and feedback is
QUICKER = 1.6  # so many times as quick. Twice as quick swings in a current, and slow robots swing at 1.4
CALM = 2.0  # slight feedback is filtered so many times as slowly in addition, on a path that asks for little:
SLIGHT, LITTLE = 2.5, 10.0  # in forces worth a turn: 50 mN, where noise makes some 15; 0.2 N, the drag at 5 cm/s
HOLD_RADPS = 0.3  # station keeping turns no faster: at 1.2 rad/s a robot kept spinning on the side force of its own spin


@kernel("f8(c16, f8, f8, f8)", part=True)
def off_tangent(force: complex, direction: float, worth: float, limit_rad: float) -> float:
    """Angle of a force, along + i across the path's tangent, by which to turn from the tangent, ahead or astern
    (`direction` 1 or -1). Forces well below `worth` are not worth a turn."""
    angle = math.atan(direction * force.imag / max(direction * force.real, worth))
    return min(max(angle, -limit_rad), limit_rad)


@kernel("UniTuple(f8,2)(f8[:,::1], f8[:,::1], f8[:,::1], c16, b1, f8, f8, f8, c16, f8, f8, f8, f8, f8)", part=True)
def headings(
    eta: Array,
    velocity: Array,
    acceleration: Array,
    current: complex,
    sway: bool,
    mass: float,
    linear: float,
    quadratic: float,
    feedback: complex,
    worth: float,
    limit_rad: float,
    keep: float,
    direction: float,
    jump: float,
) -> tuple[float, float]:
    """Headings of a reference (rows, 4 each), in the place of the tangents of `eta`, from the force needed, row by row:

        F = m a + d(|V|) V + feedback      V = velocity - current      d = linear + quadratic |V|

    turned into the tangent's frame, in which `feedback` is given; without `sway` in the model F is the velocity along it.
    Returns the direction of thrust and what is left of a jump: where the force reverses, so does thrust.
    """
    for k in range(len(eta)):
        back = complex(math.cos(eta[k, 3]), -math.sin(eta[k, 3]))
        v = complex(velocity[k, 0], velocity[k, 1])
        if sway:
            v -= current
            force = back * (mass * complex(acceleration[k, 0], acceleration[k, 1]) + (linear + quadratic * abs(v)) * v)
        else:
            force = complex((back * v).real, 0.0)
        force += feedback
        if k == 0:
            if direction * force.real < -worth:
                jump += off_tangent(force, direction, worth, limit_rad) - off_tangent(force, -direction, worth, limit_rad)
                direction = -direction
            jump *= keep
        eta[k, 3] = off_tangent(force, direction, worth, limit_rad) + eta[k, 3] + jump
    return direction, jump


@kernel("c16(f8[:,::1], f8[:,::1], f8[::1], f8[::1], f8, b1, f8, f8, f8)")
def correction(
    eta: Array, velocity: Array, at: Array, nu: Array, side: float, sway: bool, mass: float, stiff: float, damp: float
) -> complex:
    """Feedback part of F, x + iy in the pool frame, of a reference (rows, 4 each), for a robot `at` (4,) with the velocity
    `nu` (4,) over ground; `side` is Gamma_v, `stiff` and `damp` are kp and kd. Without `sway` it is that of the velocity."""
    error = complex(eta[0, 0] - at[0], eta[0, 1] - at[1])
    if not sway:
        return stiff / max(damp, 1e-6) * error
    ahead = complex(math.cos(at[3]), math.sin(at[3]))
    slip = complex(velocity[0, 0], velocity[0, 1]) - ahead * complex(nu[0], nu[1])
    return mass * (stiff * error + damp * slip - 1j * side * ahead)


@kernel("void(f8[:,::1], f8[:,::1], f8[:,::1], f8[::1], f8[::1], f8, c16, b1, f8[::1], f8[::1])")
def headings_along(
    eta: Array,
    velocity: Array,
    acceleration: Array,
    at: Array,
    nu: Array,
    side: float,
    current: complex,
    sway: bool,
    settings: Array,
    memory: Array,
) -> None:
    """Headings of a reference (rows, 4 each), written into `eta`, for a robot `at` (4,): `headings`, with the `correction`
    filtered.

    `settings` (8,): mass, linear and quadratic drag, kp, kd, the filter's share that stays, force worth a turn, largest angle.
    kp, kd and the filter are those of a robot at rest: a fast one has them QUICKER, if there is sway in the model.
    `memory` (5,) is written: the filtered correction x, y; direction of thrust; rest of a jump; 1 until the first call, which
    takes what is not slight as it is: from zero on, a robot 0.15 m off first turned away. The correction is filtered in the
    tangent's frame: what feeds back in a bend, model errors above all, turns with it. Slight news is mostly noise, and where
    the path asks for little force noise turns the robot far: there the filter is slower.
    """
    mass, stiff, damp, keep, worth = settings[0], settings[3], settings[4], settings[5], settings[6]
    speed = abs(complex(velocity[0, 0], velocity[0, 1]) - current)
    needed = speed  # without sway a velocity stands for a force
    if sway:
        needed = (settings[1] + settings[2] * speed) * speed
        pace = 1.0 + (QUICKER - 1.0) * speed**4 / (speed**4 + FAST_MPS**4)
        stiff *= pace**2
        damp *= pace
        keep **= pace
    asked = correction(eta, velocity, at, nu, side, sway, mass, stiff, damp)
    asked *= complex(math.cos(-eta[0, 3]), math.sin(-eta[0, 3]))
    news = asked - complex(memory[0], memory[1])
    loud = abs(news) / (SLIGHT * worth)
    needed /= LITTLE * worth
    if memory[4] == 0.0:
        slower = 1.0 + CALM / (1.0 + loud * loud + needed * needed)
        left_out = keep ** (1.0 / slower)
    else:
        left_out, keep = 1.0 / (1.0 + loud * loud), 0.0
    asked -= left_out * news
    memory[0], memory[1], memory[4] = asked.real, asked.imag, 0.0
    memory[2], memory[3] = headings(
        eta, velocity, acceleration, current, sway, mass, settings[1], settings[2], asked, settings[6], settings[7],
        keep, memory[2], memory[3],
    )  # fmt: skip


class HeadingReference:
    """One robot's reference heading, with its memory: filtered request, direction of thrust, rest of a jump."""

    def __init__(self, vehicle: Vehicle, config: GuidanceConfig, period_s: float, sway: bool) -> None:
        self._sway, self._period_s = sway, period_s
        self._mass = vehicle.mass.surge_kg
        self._linear, self._quadratic = vehicle.drag.linear[1], vehicle.drag.quadratic[1]
        self._per_force = 1.0 if sway else 1.0 / vehicle.drag.linear[0]
        self.tune(config)
        self.reset()

    def tune(self, config: GuidanceConfig) -> None:
        """Use other gains from now on; the memory stays."""
        self._config = config
        self._keep = math.exp(-self._period_s / config.filter_s)
        worth = config.turning_force_n * self._per_force
        self._settings = np.array((
            self._mass, self._linear, self._quadratic, config.position_gain_per_s2, config.velocity_gain_per_s, self._keep,
            worth, config.max_correction_rad,
        ))  # fmt: skip

    def adapt(self, model: Array, pace: float) -> None:
        """Use mass and drag of a `model` (3, 4), and feed back at `pace` of the rate that the gains are for: no faster than
        the estimate, which is slower where poses are worse. With 5 mm of noise and the gains for 1.5, `pool` swings."""
        config = self._config
        self._mass, self._linear, self._quadratic = float(model[0, 0]), float(model[1, 1]), float(model[2, 1])
        self._settings[:3] = self._mass, self._linear, self._quadratic
        self._settings[3], self._settings[4] = config.position_gain_per_s2 * pace**2, config.velocity_gain_per_s * pace
        self._keep = self._settings[5] = math.exp(-pace * self._period_s / config.filter_s)

    def reset(self) -> None:
        """Start anew, from the goal's own heading."""
        # filtered request x, y; thrust ahead 1, astern -1; rest of a jump; 1: nothing yet
        self._memory = np.array((0.0, 0.0, 1.0, 0.0, 1.0))
        self._hold_yaw: float | None = None

    def turn_along(
        self, command: Array, reference: Reference, eta: Array, nu: Array, disturbance: Array, current: complex = 0j
    ) -> None:
        """Turn the poses `command` (rows, 4), now, then all nodes, which have the path's tangents for headings and the motion
        of `reference`. `eta`, `nu` over ground, Gamma (4,), and the water's velocity x + iy are estimates."""
        headings_along(
            command, reference.velocity, reference.acceleration, eta, nu, disturbance[1], current, self._sway, self._settings,
            self._memory,
        )  # fmt: skip

    def heading_on_hold(self, reference: Reference, eta: Array, nu: Array, disturbance: Array, current: complex = 0j) -> Array:
        """Headings (rows,) for keeping station: the line of the needed force, ahead or astern, whichever is nearer; unchanged
        while the robot is near and no force is needed. Here all of Gamma counts: a robot in a current ends up in line with it.
        (A heading towards the point makes the robot circle it: it drifts on for 4 s after each turn.)"""
        if self._hold_yaw is None:
            self._hold_yaw = float(eta[3])
        radius = self._config.hold_radius_m
        distance = math.hypot(float(reference.eta[0, 0] - eta[0]), float(reference.eta[0, 1] - eta[1]))
        care = min(max(2.0 * distance / radius - 1.0, 0.0), 1.0)  # none within half the radius, all from the radius on
        drag = (self._linear + self._quadratic * abs(current)) * current
        unexplained = self._mass * complex(disturbance[0], disturbance[1]) * cmath.rect(1.0, float(eta[3]))
        _, _, _, stiff, damp, *_ = self._settings.tolist()
        asked = correction(reference.eta, reference.velocity, eta, nu, 0.0, True, self._mass, stiff, damp)
        x_n, y_n, *_ = self._memory.tolist()
        force = self._keep * complex(x_n, y_n) + (1.0 - self._keep) * (care * asked - unexplained - drag)
        self._memory[:2] = force.real, force.imag
        size = abs(force) ** 2
        turn = 0.5 * wrap(2.0 * (cmath.phase(force) - self._hold_yaw))
        rate = turn / self._config.filter_s * size / (size + self._config.turning_force_n**2)
        self._hold_yaw += self._period_s * min(max(rate, -HOLD_RADPS), HOLD_RADPS)
        return np.full(len(reference.eta), self._hold_yaw)
