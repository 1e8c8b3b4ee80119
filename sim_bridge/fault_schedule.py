"""The fault timeline at work: what is broken now, and what that means to plant, boards, camera and links. Pure; time is
seconds along the trajectories, so nothing breaks before the robots start. Processes are killed by sim_bridge/sil/launcher.py.
"""

from dataclasses import dataclass

import numpy as np

from sim_bridge.plant.fleet import Harm
from wire.config.experiment import Experiment
from wire.config.fault_injection import THRUSTERS, Break, Fault
from wire.frames import Array
from wire.toml_loader import ConfigError

NUMERIC = ("thruster", "imu", "battery")  # what can break in a numeric flight
BEFORE_S = -1.0  # any time at which the robots have not started


@dataclass(frozen=True)
class LinkTrouble:
    """What happens to datagrams between a robot's computer and its board."""

    cut: bool = False
    loss: float = 0.0  # fraction lost; as much again is doubled, and as much overtaken by what comes later
    delay_s: float = 0.0


class Faults:
    """The faults of an experiment."""

    def __init__(self, experiment: Experiment) -> None:
        self._faults, self._robots = experiment.sim.faults, experiment.robot_ids
        self._active: tuple[Fault, ...] = ()
        self._stuck_us: dict[tuple[int, int], float] = {}
        self._derive()

    @property
    def any(self) -> bool:
        """Whether anything will ever break."""
        return bool(self._faults)

    def at(self, time_s: float) -> list[str]:
        """Move to a time. Returns what has changed, in words."""
        if not self._faults:
            return []
        active = tuple(fault for fault in self._faults if fault.holds(time_s))
        if active == self._active:
            return []
        said = [f"fault: {fault.what}" for fault in active if fault not in self._active]
        said += [f"fault over: {fault.what}" for fault in self._active if fault not in active]
        self._active = active
        self._derive()
        return said

    def pulses(self, pulses_us: Array) -> Array:
        """The pulses (n, 8) that thrusters see, of those on the boards' outputs: one that is stuck sees its last for ever."""
        stuck = {(i, b.thruster - 1) for i, b in self._of("thruster") if b.effect == "stuck"}
        self._stuck_us = {where: self._stuck_us.get(where, float(pulses_us[where])) for where in stuck}
        if not stuck:
            return pulses_us
        seen = pulses_us.copy()
        for where, pulse in self._stuck_us.items():
            seen[where] = pulse
        return seen

    def _of(self, kind: str) -> list[tuple[int, Break]]:
        """Faults of a kind that hold now, each with its robot's index (-1: none)."""
        broken = [fault.broken for fault in self._active if fault.broken.kind == kind]
        return [(self._robots.index(b.robot) if b.robot else -1, b) for b in broken]

    def _derive(self) -> None:
        """What follows from the faults that hold now."""
        n = len(self._robots)
        thrust, sag_v = np.ones((n, THRUSTERS)), np.zeros(n)
        factors = {"dead": 0.0, "reversed": -1.0, "stuck": 1.0}
        for i, b in self._of("thruster"):
            thrust[i, b.thruster - 1] *= factors.get(b.effect, b.value)
        for i, b in self._of("battery"):
            sag_v[i] += b.value
        self.harm = Harm(thrust, sag_v)
        self.imu_error = np.zeros((n, 2))  # heading rad, yaw rate rad/s
        for i, b in self._of("imu"):
            self.imu_error[i, ("heading", "gyro").index(b.effect)] += b.value
        self.bare = frozenset(i for i, _ in self._of("marker"))
        self.camera = tuple(b for _, b in self._of("camera"))
        self.links = [LinkTrouble()] * n
        for i, b in self._of("link"):
            old, is_noisy, is_slow = self.links[i], b.effect == "noisy", b.effect == "slow"
            loss, delay_s = b.value if is_noisy else old.loss, b.value if is_slow else old.delay_s
            self.links[i] = LinkTrouble(old.cut or b.effect == "cut", loss, delay_s)


def only(experiment: Experiment, kinds: tuple[str, ...], why: str) -> None:
    """Raise ConfigError if the timeline asks for what this way of flying cannot break."""
    for i, fault in enumerate(experiment.sim.faults):
        if fault.broken.kind not in kinds:
            raise ConfigError(f"sim.faults.{i}.what = {fault.what!r}: {why} (allowed here: {', '.join(kinds)})")


def never(experiment: Experiment) -> list[str]:
    """In words, the faults whose time does not come in a run as long as the experiment's."""
    late = [fault for fault in experiment.sim.faults if fault.at_s >= experiment.duration_s]
    return [f"never happens: {f.what} at {f.at_s:g} s, for the run ends after {experiment.duration_s:g} s" for f in late]
