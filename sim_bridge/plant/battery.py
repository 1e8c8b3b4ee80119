"""The robots' batteries: voltage by charge and load, its effect on thrust, and their discharge."""

import math
from typing import NamedTuple

import numpy as np

from shoal.config.experiment import Experiment
from shoal.frames import Array
from shoal.kernels.decorator import kernel
from shoal.kernels.types import Floats, Table
from sim_bridge.plant.actuators import interpolate

# Open-circuit voltage of a lithium-polymer cell against its charge (typical discharge curve at a tenth of capacity per hour).
CHARGE = np.array([0.0, 0.05, 0.1, 0.2, 0.4, 0.6, 0.8, 1.0])
CELL_V = np.array([3.0, 3.45, 3.65, 3.73, 3.80, 3.90, 4.04, 4.20])
J_PER_WH = 3600.0
THRUST_EXPONENT = 1.2  # of thrust over voltage (OpenThruster's A2212 data at 10 to 12.6 V)


class BatteryPack(NamedTuple):
    is_ideal: bool
    charge: Floats
    cell_v: Floats
    cells: float
    beyond_v: float  # of a start voltage beyond the ends of the cells' curve
    curve_v: float  # at which the thrusters' curve was measured
    load_v: float  # by which the voltage falls at full thrust
    max_thrust_n: float
    thruster_w: float
    electronics_w: float
    capacity_j: float


@kernel(part=True)
def thrust_factor(i: int, battery: BatteryPack, charge: float, force_n: Table, lost_v: float) -> float:
    """Thrust of robot i over the static curve's: (voltage / curve's voltage)^1.2. The voltage falls with the thrusters' mean
    load, and by `lost_v` besides. An ideal battery falls by that alone."""
    voltage = battery.curve_v
    if not battery.is_ideal:
        load_n = 0.0
        for k in range(force_n.shape[1]):
            load_n += abs(force_n[i, k])
        load = load_n / (force_n.shape[1] * battery.max_thrust_n)
        cell_v = interpolate(charge, battery.charge, battery.cell_v)
        voltage = cell_v * battery.cells + battery.beyond_v - battery.load_v * load
    return float(max((voltage - lost_v) / battery.curve_v, 0.0) ** THRUST_EXPONENT)


@kernel(part=True)
def charge_after(i: int, battery: BatteryPack, charge: float, force_n: Table, seconds: float) -> float:
    """Charge that is left of robot i's when its thrusters push for so long. Their power goes with |thrust|^1.5 (momentum
    theory); the electronics need theirs too."""
    if battery.is_ideal:
        return charge
    power_w = battery.electronics_w
    for k in range(force_n.shape[1]):
        load = abs(force_n[i, k]) / battery.max_thrust_n
        power_w += battery.thruster_w * load * math.sqrt(load)
    return max(charge - power_w * seconds / battery.capacity_j, 0.0)


class BatteryModel:
    """The batteries of every robot of an experiment. One without a capacity is ideal: it neither drains nor sags."""

    def __init__(self, experiment: Experiment) -> None:
        battery, vehicle, sensors = experiment.sim.plant.battery, experiment.vehicle, experiment.sim.sensors
        cells = vehicle.battery.cells
        cell_v = sensors.battery_v / cells
        self._start_charge, self._start_v = float(np.interp(cell_v, CELL_V, CHARGE)), sensors.battery_v
        self.constants = BatteryPack(
            battery.capacity_wh == 0,
            CHARGE,
            CELL_V,
            float(cells),
            sensors.battery_v - float(np.interp(cell_v, CELL_V, CELL_V)) * cells,
            battery.curve_v,
            sensors.battery_sag_v,
            vehicle.thruster.max_thrust_n,
            battery.thruster_w,
            battery.electronics_w,
            battery.capacity_wh * J_PER_WH,
        )

    def start(self, robots: int) -> Array:
        """Charge (robots,), 0 to 1, of batteries that have the experiment's voltage at rest."""
        return np.full(robots, self._start_charge)

    def rest_v(self, charge: Array) -> Array:
        """Voltage (n,) without load."""
        if self.constants.is_ideal:
            return np.full(len(charge), self._start_v)
        return np.asarray(np.interp(charge, CHARGE, CELL_V) * self.constants.cells + self.constants.beyond_v)
