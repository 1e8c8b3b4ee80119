"""The robots' batteries: voltage by charge and load, and their discharge. All arrays (n,)."""

import numpy as np

from wire.config.experiment import Experiment
from wire.frames import Array

# Open-circuit voltage of a lithium-polymer cell against its charge (typical discharge curve at a tenth of capacity per hour).
CHARGE = np.array([0.0, 0.05, 0.1, 0.2, 0.4, 0.6, 0.8, 1.0])
CELL_V = np.array([3.0, 3.45, 3.65, 3.73, 3.80, 3.90, 4.04, 4.20])
THRUST_EXPONENT = 1.2  # of thrust over voltage (OpenThruster's A2212 data at 10 to 12.6 V)
POWER_EXPONENT = 1.5  # of a propeller's power over thrust (momentum theory)
J_PER_WH = 3600.0


class BatteryModel:
    """The batteries of every robot of an experiment."""

    def __init__(self, experiment: Experiment) -> None:
        battery, vehicle = experiment.sim.plant.battery, experiment.vehicle
        self.ideal = battery.capacity_wh == 0
        self._capacity_j = battery.capacity_wh * J_PER_WH
        self._thruster_w, self._electronics_w = battery.thruster_w, battery.electronics_w
        self._curve_v, self._cells = battery.curve_v, vehicle.battery.cells
        self._start_v = experiment.sim.sensors.battery_v
        # offset of a start voltage that the experiment asks for beyond the ends of the curve
        self._beyond_v = self._start_v - float(np.interp(self._start_v / self._cells, CELL_V, CELL_V)) * self._cells
        self._sag_v = experiment.sim.sensors.battery_sag_v
        self._max_thrust_n = vehicle.thruster.max_thrust_n

    def start(self, robots: int) -> Array:
        """Charge, 0 to 1, of batteries that have the experiment's voltage at rest."""
        return np.full(robots, np.interp(self._start_v / self._cells, CELL_V, CHARGE))

    def rest_v(self, charge: Array) -> Array:
        """Voltage without load."""
        if self.ideal:
            return np.full(charge.shape, self._start_v)
        return np.asarray(np.interp(charge, CHARGE, CELL_V) * self._cells + self._beyond_v)

    def thrust_factor(self, charge: Array, force_n: Array, sag_v: Array) -> Array:
        """Thrust as a fraction of the curve's, with thrusters at these forces (n, 4) and `sag_v` lost besides."""
        if self.ideal:
            return np.maximum(1.0 - sag_v / self._curve_v, 0.0) ** THRUST_EXPONENT
        load = np.abs(force_n).mean(axis=1) / self._max_thrust_n
        voltage = self.rest_v(charge) - self._sag_v * load - sag_v
        return np.asarray(np.maximum(voltage / self._curve_v, 0.0) ** THRUST_EXPONENT)

    def drained(self, charge: Array, force_n: Array, seconds: float) -> Array:
        """Charge left after thrusters have worked at these forces (n, 4) for this long."""
        if self.ideal:
            return charge
        thrusters_w = self._thruster_w * ((np.abs(force_n) / self._max_thrust_n) ** POWER_EXPONENT).sum(axis=1)
        return np.asarray(np.maximum(charge - (thrusters_w + self._electronics_w) * seconds / self._capacity_j, 0.0))
