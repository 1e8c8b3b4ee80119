"""Reference heading of the linear laws: the direction in which thrust produces the force that the reference needs.

The robot has no side force, so its heading is the direction in which it can push, as for a quadrotor:

    F = M (a_ref + kp e_position + kd e_velocity - Gamma) + d_v(|V|) V        V = V_ref - current

Of Gamma only the side force counts on a path, where surge thrust compensates the rest; all of it counts while the robot keeps
station, so that in a current it ends up in line with it. The opposite heading is as good, because thrust reverses: at rest the
nearer one is taken, on a path the one ahead. F is filtered, and where it is small it turns no robot, because of noise. Where
drag alone needs more force than noise makes, an error turns the robot less: there kp is larger.

The article keeps the path's tangent, and never corrects a lateral error at walking pace. It has this heading only away from
its path: on HOLD, and on a way around others.
"""

import cmath
import math

from robot_agent.guidance.reference import Reference
from robot_agent.vehicle.dynamics import Model
from robot_agent.vehicle.estimate import Observation
from shoal.frames import wrap

FILTER_S = 1.0  # twice as long overshoots by 4 cm
WORTH_N = 0.02  # forces well below are not worth a turn
LOUD_N, QUICKER = 0.2, 1.6  # beside a drag well above, ten times what noise makes, errors fade so many times as fast
DAMPING = 0.9
PATH_RADPS, HOLD_RADPS = 0.8, 0.3  # fastest turns: at 1.2 rad/s a robot kept spinning on the side force of its own spin


class HeadingReference:
    """The heading's angle to the path's tangent, with its memory."""

    def __init__(self, model: Model, period_s: float, gain_per_s2: float) -> None:
        self._model, self._period_s = model, period_s
        self.tune(gain_per_s2)
        self.reset()

    def tune(self, gain_per_s2: float) -> None:
        """Use another gain kp from now on; kd damps it as well."""
        self._stiff_per_s2, self._damp_per_s = gain_per_s2, 2.0 * DAMPING * math.sqrt(gain_per_s2)

    def reset(self) -> None:
        """Start anew, from the reference's own heading."""
        self.off_rad = 0.0
        self._force_n = 0j  # filtered, along and across the path's tangent

    def turn(self, reference: Reference, estimate: Observation, is_resting: bool) -> float:
        """Angle from the path's tangent to the heading, one step on: the module's equation, in the pool's plane."""
        masses, linear_drags, quadratic_drags = self._model.coefficients.tolist()
        mass, linear, quadratic = masses[0], linear_drags[1], quadratic_drags[1]  # of surge; the drag of sway
        (x, y, _, tangent_rad), (x_mps, y_mps, *_), (x_mps2, y_mps2, *_) = (rows[0].tolist() for rows in reference)
        velocity, acceleration = complex(x_mps, y_mps), complex(x_mps2, y_mps2)
        heading = cmath.rect(1.0, estimate.eta.item(3))
        error_m = complex(x, y) - complex(*estimate.eta[:2].tolist())
        error_mps = velocity - heading * complex(*estimate.nu[:2].tolist())
        surge, sway, *_ = estimate.disturbance.tolist()
        gamma = heading * complex(surge if is_resting else 0.0, sway)

        in_water = velocity - estimate.current
        force = (linear + quadratic * abs(in_water)) * in_water
        quicker = 1.0 + (QUICKER - 1.0) * abs(force) ** 2 / (abs(force) ** 2 + LOUD_N**2)
        feedback = quicker**2 * self._stiff_per_s2 * error_m + quicker * self._damp_per_s * error_mps
        force += mass * (acceleration + feedback - gamma)

        to_tangent = cmath.rect(1.0, -tangent_rad)  # filtered on the path's axes: what feeds back in a bend turns with it
        self._force_n += -math.expm1(-self._period_s / FILTER_S) * (to_tangent * force - self._force_n)
        is_astern = self._force_n.real < 0.0
        wanted_rad = cmath.phase(-self._force_n if is_astern and not is_resting else self._force_n)
        turn_rad = wanted_rad - self.off_rad
        if is_resting:  # to the nearer of this heading and its opposite
            turn_rad = 0.5 * wrap(2.0 * turn_rad)
        size = abs(self._force_n) ** 4
        turn_rad *= size / (size + WORTH_N**4)
        most_rad = self._period_s * (HOLD_RADPS if is_resting else PATH_RADPS)
        self.off_rad += min(max(turn_rad, -most_rad), most_rad)
        return self.off_rad
