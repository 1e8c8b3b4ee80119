"""Cost and reference of a horizon that ends before the robot has turned. Pure.

A robot without side force brings an error across its path back with its heading. A horizon of LONG_S sees the turn and what
comes of it. A shorter one needs three things, the more the shorter it is (`shortness`):

Terminal cost. A thrust that is still on at the last node costs nothing later, so it is not taken back in time, and surge
swings. Beyond the last node each axis counts as a mass with linear drag, brought back to the reference under the weights of
(35), without limits. P is the sum that the Riccati equation gives for STEPS steps:

    s = (place, velocity, wrench) less what the reference needs        cost = shortness s' P s

Surge is taken along the heading at the last node; what lies across has no part in P.

Fading error. Along a heading that is 1 rad off the tangent, surge carries the robot to the nearest point of that line, ahead
of its place on the path. There the needed force reverses, the heading turns over, and the two go on to feed one another. So an
error across the path fades from the reference as fast as the heading can bring it back, instead of being closed by surge.

Thrust that does not turn over. Feedback leaves a part of the force that the path needs along it (heading.py): a robot ahead of
its place waits for it, and does not turn round. Of 16 robots that began 0.3 m off, 5 stopped without, none with it (15 steps).
"""

import math

from wire.frames import Array
from wire.kernels import kernel

LONG_S = 2.5  # horizon that needs none of it; with 2.25 s and none, slow robots left their paths in some flights
SHORT_S = 2.0  # horizon from which on down all count in full; with 1.25 s, 2.25 s flew with 28 mm instead of 5
STEP_S = 0.2  # between changes of the wrench beyond the horizon: the default's last blocks are as long
STEPS = 25  # 5 s: with the default weights, more change P by less than 1 %
FADING_M = 0.3  # most of an error that fades, as far as robots begin from their paths; what lies beyond is worth a rush
TURN_IN_M = 0.2  # way along the path in which the heading brings an error across back; without it fast paths close slowly
HEAVE, YAW = 2, 3  # axes in eta and nu


def shortness(horizon_s: float) -> float:
    """Share, 0 to 1, with which all three count."""
    return min(max((LONG_S - horizon_s) / (LONG_S - SHORT_S), 0.0), 1.0)


@kernel("UniTuple(f8,6)(f8, f8, f8, f8, f8, i8)", part=True)
def cost_to_go(
    mass: float, drag: float, q: float, r: float, step_s: float, steps: int
) -> tuple[float, float, float, float, float, float]:
    """Upper triangle of P (3, 3), row by row: least cost of `steps` steps from (place, velocity, wrench), with a change of the
    wrench at the start of each:

        sum q place+^2 + r change^2        velocity' = (wrench - drag velocity) / mass        place' = velocity

    place+ at a step's end; `drag` in kg/s or kg m^2/s, not zero.
    """
    keep = math.exp(-drag / mass * step_s)
    g = (1.0 - keep) / drag  # velocity for a unit of wrench,
    a, b = 0.5 * step_s * (1.0 + keep), 0.5 * step_s * g  # place for a unit of velocity and of wrench
    p11, p12, p13, p22, p23, p33 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for _ in range(steps):
        p11 += q
        # products under P of the columns of the motion: (1, 0, 0) place + (a, keep, 0) velocity + (b, g, 1) wrench
        pb1, pb2, pb3 = p11 * b + p12 * g + p13, p12 * b + p22 * g + p23, p13 * b + p23 * g + p33
        vb, bb = a * pb1 + keep * pb2, b * pb1 + g * pb2 + pb3
        pv, vv = a * p11 + keep * p12, a * a * p11 + 2.0 * a * keep * p12 + keep * keep * p22
        d = r + bb
        p11, p12, p22 = p11 - pb1 * pb1 / d, pv - pb1 * vb / d, vv - vb * vb / d
        p13, p23, p33 = r * pb1 / d, r * vb / d, r * bb / d
    return p11, p12, p13, p22, p23, p33


@kernel("void(f8, f8, f8, f8, f8, f8[::1], f8[::1], f8, f8, f8, i8, f8[:,::1], f8[::1])", part=True)
def add_axis(
    mass: float,
    drag: float,
    q_place: float,
    r: float,
    share: float,
    place: Array,
    velocity: Array,
    place_goal: float,
    velocity_goal: float,
    wrench_goal: float,
    first: int,
    p: Array,
    q: Array,
) -> None:
    """Add share s' P s of one axis to the cost (halved) b'pb + 2 q'b over the blocks b from `first` on.

    `place`, `velocity` (columns,) at the last node: responses to each block, the free response last. The wrench there is that
    of the axis's own last block, which stands at a third of all.
    """
    p11, p12, p13, p22, p23, p33 = cost_to_go(mass, drag, q_place, r, STEP_S, STEPS)
    free = len(place) - 1
    held = len(p) // 3 - 1
    e, v = place[free] - place_goal, velocity[free] - velocity_goal
    for i in range(free):
        wrench = 1.0 if i == held else 0.0
        on_e = share * (p11 * place[i] + p12 * velocity[i] + p13 * wrench)
        on_v = share * (p12 * place[i] + p22 * velocity[i] + p23 * wrench)
        on_w = share * (p13 * place[i] + p23 * velocity[i] + p33 * wrench)
        q[first + i] += on_e * e + on_v * v - on_w * wrench_goal
        for j in range(free):
            p[first + i, first + j] += on_e * place[j] + on_v * velocity[j]
        p[first + i, first + held] += on_w


@kernel(
    "void(f8[:,::1], f8, f8[::1], f8[::1], f8[::1], c16, f8[:,:,::1], f8[:,:,::1], f8[:,:,::1], f8[:,::1], f8[::1],"
    " f8[::1], f8, f8[::1], f8[:,::1], f8[::1])"
)
def add_terminal_cost(
    model: Array,
    dt: float,
    asked: Array,
    delivered: Array,
    gamma: Array,
    current: complex,
    nominal: Array,
    planar: Array,
    axial: Array,
    reference: Array,
    weight: Array,
    r: Array,
    share: float,
    along: Array,
    p: Array,
    q: Array,
) -> None:
    """Add to `p` (3 blocks, 3 blocks) and `q` (3 blocks,) what the errors at the last node go on to cost.

    Arrays as in linearisation.py; `r` (3,) weighs a change of surge, heave, yaw. Needed is the wrench that keeps up the
    reference's velocity at the end, at the heading there; surge counts the less the farther that is from the reference's.
    `along` (2 blocks + 1,) is scratch.
    """
    last, n = len(reference) - 1, axial.shape[2] - 1
    heading = nominal[0, last, 3]
    cos, sin = math.cos(heading), math.sin(heading)
    turned = max(math.cos(heading - reference[last, 3]), 0.0)
    pace_x, pace_y = reference[last, 0] - reference[last - 1, 0], reference[last, 1] - reference[last - 1, 1]
    for i in range(len(along)):
        along[i] = cos * planar[0, last, i] + sin * planar[1, last, i]
    goal = cos * reference[last, 0] + sin * reference[last, 1]
    ahead = cos * (pace_x / dt - current.real) + sin * (pace_y / dt - current.imag)
    drag = model[1, 0] + model[2, 0] * abs(ahead)
    turning = model[0, 1] * nominal[1, last, 1] * nominal[1, last, 3]
    needed = drag * ahead - model[0, 0] * gamma[0] - turning - (delivered[0] - asked[0])
    per_step = STEP_S / dt
    q_ahead = per_step * turned**2 * (cos**2 * weight[0] + sin**2 * weight[1])
    add_axis(model[0, 0], drag, q_ahead, r[0], share, along, planar[2, last], goal, ahead, needed, 0, p, q)
    for axis, channel, row, first in ((YAW, 2, 1, n), (HEAVE, 1, 0, 2 * n)):
        pace = (reference[last, axis] - reference[last - 1, axis]) / dt
        drag = model[1, axis] + model[2, axis] * abs(pace)
        needed = drag * pace - model[0, axis] * gamma[axis] - (delivered[channel] - asked[channel])
        add_axis(
            model[0, axis], drag, per_step * weight[axis], r[channel], share, axial[row, last], axial[row + 2, last],
            reference[last, axis], pace, needed, first, p, q,
        )  # fmt: skip


@kernel("void(f8[:,::1], f8[:,::1], f8[::1], f8, f8, f8, f8[:,::1])")
def let_error_fade(
    path: Array, velocity: Array, at: Array, rate: float, period_s: float, share: float, command: Array
) -> None:
    """Add to the places of `command` (rows, 4), whose headings are given, the part of the error across that is left to them:

        share sin^2(heading - tangent) error e^(-(rate + |V| / TURN_IN_M) k period_s)        row k > 0, along its normal

    The error is that of the robot `at` (4,) from row 0, which stays. `path` (rows, 4) has its tangents for headings, V is its
    `velocity` (rows, 4). At most FADING_M of the error counts.
    """
    cos, sin = math.cos(path[0, 3]), math.sin(path[0, 3])
    across = min(max(cos * (at[1] - command[0, 1]) - sin * (at[0] - command[0, 0]), -FADING_M), FADING_M)
    across *= share * math.sin(command[0, 3] - path[0, 3]) ** 2
    speed = math.hypot(velocity[0, 0], velocity[0, 1])
    keep = math.exp(-(rate + speed / TURN_IN_M) * period_s)
    for k in range(1, len(path)):
        across *= keep
        command[k, 0] -= math.sin(path[k, 3]) * across
        command[k, 1] += math.cos(path[k, 3]) * across
