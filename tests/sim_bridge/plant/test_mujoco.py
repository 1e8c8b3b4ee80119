"""A second opinion: the same manoeuvres in MuJoCo, a physics engine that knows nothing of ours.

MuJoCo is given a rigid body whose added mass is the same along every axis, so that a body in vacuum can have it; what an
uneven one adds (Munk's moment) is compared in test_rigid_body.py. Gravity, inertia, attitude and integration are MuJoCo's;
drag, buoyancy and thrust are put on it as forces.
"""

from collections.abc import Callable
from dataclasses import replace

import mujoco
import numpy as np
import pytest

from shoal.config.experiment import load_experiment
from shoal.frames import Array
from sim_bridge.plant.fleet import Plant, PlantState

MASS_KG, INERTIA_KG_M2, RIGHTING_NM, GRAVITY_MPS2 = 12.0, 0.12, 1.9, 9.81
LINEAR = np.array([3.0, 3.0, 3.0, 0.08, 0.08, 0.08])
QUADRATIC = np.array([20.0, 20.0, 20.0, 0.10, 0.10, 0.10])
EVEN = (
    "pool.walls=false",
    "sim.plant.buoyancy_n=0",
    "sim.plant.thruster_spread=0",
    "sim.plant.battery.capacity_wh=0",
    "vehicle.mass.heave_kg=12",
    "vehicle.drag.linear=[3.0,3.0,3.0,0.08]",
    "vehicle.drag.quadratic=[20.0,20.0,20.0,0.10]",
    "vehicle.thruster.dead_time_s=0",
    "sim.plant.thruster_lag_s=0",
)
APART = np.array([[-40.0, 0.0, 5.0, 0.0], [40.0, 0.0, 5.0, 0.0]])

# z points down, as in the pool. The weight acts at the centre of mass, the buoyancy at the origin: MuJoCo has no water, so the
# test applies it. Inertia about the centre of mass is what is left of that about the origin.
DEPTH_M = RIGHTING_NM / GRAVITY_MPS2 / MASS_KG
TILTED = INERTIA_KG_M2 - MASS_KG * DEPTH_M**2
MODEL = f"""
<mujoco>
  <option gravity="0 0 {GRAVITY_MPS2}" timestep="0.001" integrator="RK4"/>
  <worldbody>
    <body name="robot">
      <freejoint/>
      <inertial pos="0 0 {DEPTH_M}" mass="{MASS_KG}" diaginertia="{TILTED} {TILTED} {INERTIA_KG_M2}"/>
    </body>
  </worldbody>
</mujoco>"""


class Peer:
    """The robot in MuJoCo."""

    def __init__(self, force_body: Array, moment_body: Array) -> None:
        self.model = mujoco.MjModel.from_xml_string(MODEL)
        self.data = mujoco.MjData(self.model)
        self._force, self._moment = force_body, moment_body
        mujoco.mj_forward(self.model, self.data)

    @property
    def turn(self) -> Array:
        """Body to pool."""
        return np.array(self.data.body("robot").xmat, dtype=np.float64).reshape(3, 3)

    def run(self, seconds: float) -> None:
        """Step on; forces are renewed at every step."""
        for _ in range(round(seconds / self.model.opt.timestep)):
            turn = self.turn
            nu = np.concatenate(
                [turn.T @ self.data.qvel[:3], self.data.qvel[3:]]
            )  # MuJoCo turns in the body, moves in the world
            speed = np.abs(nu)
            speed[:2] = np.hypot(nu[0], nu[1])
            drag = -(LINEAR + QUADRATIC * speed) * nu
            force = turn @ (self._force + drag[:3]) + [0.0, 0.0, -MASS_KG * GRAVITY_MPS2]
            moment = turn @ (self._moment + drag[3:])
            self.data.qfrc_applied[:] = 0.0
            mujoco.mj_applyFT(self.model, self.data, force, moment, self.data.qpos[:3].copy(), 1, self.data.qfrc_applied)
            mujoco.mj_step(self.model, self.data)


def attitude(state: PlantState, robot: int = 0) -> Array:
    """Body to pool."""
    (cr, cp, cy), (sr, sp, sy) = (f(np.array([*state.tilt[robot, :2], state.eta[robot, 3]])) for f in (np.cos, np.sin))
    return np.array(
        [
            [cp * cy, sr * sp * cy - cr * sy, cr * sp * cy + sr * sy],
            [cp * sy, sr * sp * sy + cr * cy, cr * sp * sy - sr * cy],
            [-sp, sr * cp, cr * cp],
        ]
    )


def ours(pulses: list[float], seconds: float, start: Callable[[PlantState], PlantState] = lambda state: state) -> PlantState:
    fleet = Plant(load_experiment("pool", EVEN), 1)
    state = start(fleet.start(APART))
    for _ in range(round(seconds / 0.005)):
        state = fleet.step(state, np.tile([*pulses, *[1500.0] * 4], (2, 1)))
    return state


def agree(peer: Peer, state: PlantState, place_m: float, attitude_rad: float) -> None:
    moved = peer.data.qpos[:3] + APART[0, :3]
    assert state.eta[0, :3] == pytest.approx(moved, abs=place_m)
    assert attitude(state) == pytest.approx(peer.turn, abs=attitude_rad)


def test_free_decay_equals_mujocos() -> None:
    """Let go at 23 degrees of roll and 17 of pitch, turning and drifting: it swings, slides and comes to rest alike."""
    roll, pitch = 0.4, -0.3
    state = ours([1500.0] * 4, 4.0, lambda s: replace(s, tilt=np.tile([roll, pitch, 0.0, 0.0], (2, 1))))
    peer = Peer(np.zeros(3), np.zeros(3))
    quaternion = np.zeros(4)
    mujoco.mju_mat2Quat(quaternion, attitude(replace(state, eta=APART, tilt=np.tile([roll, pitch, 0, 0], (2, 1)))).ravel())
    peer.data.qpos[3:] = quaternion
    mujoco.mj_forward(peer.model, peer.data)
    peer.run(4.0)
    agree(peer, state, 5e-4, 2e-3)
    assert np.abs(state.tilt[0, :2]).max() > 0.01  # still swinging: the comparison is of motion, not of rest


def test_motion_at_constant_thrust_equals_mujocos() -> None:
    """All four ahead: the bow lifts by the thrusters' lever, and speed settles."""
    thrust = 4 * 1.22
    state = ours([1700.0] * 4, 10.0)
    peer = Peer(np.array([thrust, 0.0, 0.0]), np.array([0.0, 0.05 * thrust, 0.0]))
    peer.run(10.0)
    agree(peer, state, 2e-3, 1e-3)
    assert state.eta[0, 0] - APART[0, 0] > 3.0 and state.tilt[0, 1] > 0.05


@pytest.mark.long
def test_circle_equals_mujocos() -> None:
    """Port thrusters harder than starboard: a circle, slid through sideways, heeled outwards. Twenty seconds of it."""
    port, starboard = 0.478, 0.207
    state = ours([1600.0, 1550.0, 1600.0, 1550.0], 20.0)
    ahead, turning = 2 * (port + starboard), 2 * (port - starboard) * 0.0833
    peer = Peer(np.array([ahead, 0.0, 0.0]), np.array([0.0, 0.05 * ahead, turning]))
    peer.run(20.0)
    agree(peer, state, 2e-3, 2e-3)
    assert state.eta[0, 3] > 4.0 and abs(state.nu[0, 1]) > 0.005
