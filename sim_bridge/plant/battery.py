"""The robots' batteries: voltage by charge and load, and their discharge. All arrays (n,)."""

import numpy as np

from shoal.config.experiment import Experiment
from shoal.frames import Array

# Open-circuit voltage of a lithium-polymer cell against its charge (typical discharge curve at a tenth of capacity per hour).
CHARGE = np.array([0.0, 0.05, 0.1, 0.2, 0.4, 0.6, 0.8, 1.0])
CELL_V = np.array([3.0, 3.45, 3.65, 3.73, 3.80, 3.90, 4.04, 4.20])
J_PER_WH = 3600.0


class BatteryModel:
    """The batteries of every robot of an experiment. One without a capacity is ideal: it neither drains nor sags."""

    def __init__(self, experiment: Experiment) -> None:
        battery, vehicle, sensors = experiment.sim.plant.battery, experiment.vehicle, experiment.sim.sensors
        cells = vehicle.battery.cells
        cell_v = sensors.battery_v / cells
        self._start_charge = float(np.interp(cell_v, CELL_V, CHARGE))
        # offset of a start voltage that the experiment asks for beyond the ends of the curve
        self._beyond_v = sensors.battery_v - float(np.interp(cell_v, CELL_V, CELL_V)) * cells
        self._is_ideal, self._cells, self._start_v = battery.capacity_wh == 0, float(cells), sensors.battery_v
        self.constants = (
            self._is_ideal,
            CHARGE,
            CELL_V,
            self._cells,
            self._beyond_v,
            battery.curve_v,
            sensors.battery_sag_v,
            vehicle.thruster.max_thrust_n,
            battery.thruster_w,
            battery.electronics_w,
            battery.capacity_wh * J_PER_WH,
            vehicle.thruster_count,
        )

    def start(self, robots: int) -> Array:
        """Charge, 0 to 1, of batteries that have the experiment's voltage at rest."""
        return np.full(robots, self._start_charge)

    def rest_v(self, charge: Array) -> Array:
        """Voltage without load."""
        if self._is_ideal:
            return np.full(len(charge), self._start_v)
        return np.asarray(np.interp(charge, CHARGE, CELL_V) * self._cells + self._beyond_v)
