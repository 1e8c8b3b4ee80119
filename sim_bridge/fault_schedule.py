"""The fault timeline: the faults that hold now, and their effects on plant, boards, camera and links. Pure.

Time is seconds since the newest flight began, so no fault of the timeline begins before the robots start, and each flight of a
session has the timeline. A person's fault begins at once, and lasts by the plant's time, also into the next flight. Faults of
processes are applied by sim_bridge/sil/fault_injector.py.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from shoal.config.experiment import Experiment
from shoal.config.fault_injection import Break, Fault
from shoal.config.simulation import Drifter
from shoal.config.vehicle import OUTPUTS
from shoal.errors import ConfigError
from shoal.frames import Array

# Faults that a numeric flight can have: kinds, or one of a kind.
NUMERIC = ("thruster", "imu", "battery", "radio", "ball", "water gust")
ROUNDING_S = 1e-6  # s by which a change is looked for early, as times are sums of rounded numbers
BEFORE_S = -1.0  # a time before the robots' start


@dataclass(frozen=True, eq=False)
class ActuatorFaults:
    """Effects of the faults on thrusters and batteries."""

    thrust: Array  # (n, 8): each thruster's force as a fraction of the healthy one's
    sag_v: Array  # (n,): voltage that each battery has lost


@dataclass(frozen=True)
class LinkFaults:
    """Effect of the faults on datagrams between a robot's computer and its board."""

    cut: bool = False
    loss: float = 0.0  # fraction lost; the same fraction is duplicated, and the same is overtaken by later datagrams
    delay_s: float = 0.0

    def with_effect(self, broken: Break) -> "LinkFaults":
        """These faults and one more."""
        match broken.effect:
            case "cut":
                return replace(self, cut=True)
            case "noisy":
                return replace(self, loss=broken.value)
            case _:
                return replace(self, delay_s=broken.value)


@dataclass(frozen=True)
class ImuFaults:
    """Effect of the faults on a board's gyroscope, accelerometer and heading."""

    heading_rad: float = 0.0  # errors
    rate_radps: float = 0.0
    rate_share: float = 1.0  # of the true rate, that it measures
    is_stuck: bool = False  # rate and force stay what they were
    turned_rad: float = 0.0  # about the body's axis ahead

    def with_effect(self, broken: Break) -> "ImuFaults":
        """These faults and one more."""
        match broken.effect:
            case "heading":
                return replace(self, heading_rad=self.heading_rad + broken.value)
            case "gyro":
                return replace(self, rate_radps=self.rate_radps + broken.value)
            case "scaled":
                return replace(self, rate_share=self.rate_share * broken.value)
            case "turned":
                return replace(self, turned_rad=self.turned_rad + broken.value)
            case _:
                return replace(self, is_stuck=True)


class FaultSchedule:
    """The faults of an experiment, and their effects at the time to which `advance` moved it last.

    Experiments' faults live by the time of the flight, those of a person by the plant's: they may come before the
    robots start.
    """

    def __init__(self, experiment: Experiment) -> None:
        self._faults, self._robots = experiment.sim.faults, experiment.robot_ids
        self._depth_m = experiment.path.depth_m
        self._by_hand: tuple[tuple[Fault, float], ...] = ()  # of a person, with the plant's time in s at which each ends
        self._active: tuple[Fault, ...] = ()
        self._stuck_us: dict[tuple[int, int], float] = {}  # by (robot's index, output): the pulse that it keeps
        self._derive_effects()

    def advance(self, time_s: float, plant_s: float = 0.0) -> list[str]:
        """Move to `time_s` of the flight, which is `plant_s` of the plant's time. Returns a line of text for each
        fault that began or ended since the last call."""
        if not (self._faults or self._by_hand or self._active):
            return []
        self._by_hand = tuple((fault, end_s) for fault, end_s in self._by_hand if plant_s < end_s - ROUNDING_S)
        active = (*(fault for fault in self._faults if fault.holds(time_s)), *(fault for fault, _ in self._by_hand))
        if active == self._active:
            return []
        texts = [f"fault: {fault.what}" for fault in active if fault not in self._active]
        texts += [f"fault over: {fault.what}" for fault in self._active if fault not in active]
        self._active = active
        self._derive_effects()
        return texts

    def add(self, what: str, for_s: float, time_s: float, plant_s: float = 0.0) -> str:
        """Begin a person's fault `what` now, for `for_s` (0: for good); an empty `what` ends all faults of persons.

        Returns the fault as --fault takes it, so that a flight can be repeated. A fault of limited length that begins before
        the robots start cannot be repeated that way, and is returned as text.
        """
        if not what:
            mended, self._by_hand = self._by_hand, ()
            return "; ".join(f"mended at {time_s:.3f} s: {fault.what}" for fault, _ in mended)
        fault = Fault.model_construct(at_s=time_s, for_s=for_s or None, what=what)
        self._by_hand += ((fault, plant_s + for_s if for_s else math.inf),)
        during = f" for={for_s:g}" if for_s else ""
        return f"before the start{during} {what}" if for_s and time_s < 0.0 else f"t={max(time_s, 0.0):.3f}{during} {what}"

    def quiet_steps(self, time_s: float, step_s: float, most: int, plant_s: float = 0.0) -> int:
        """Number of plant steps, 1 to `most`, before the next fault begins or ends. `time_s` is the flight's, as the
        experiment's faults are; `plant_s` is the plant's, as those of a person are."""
        if not (self._faults or self._by_hand):
            return most
        begins_s = [fault.at_s for fault in self._faults]
        ends_s = [fault.at_s + fault.for_s for fault in self._faults if fault.for_s is not None]
        until_s = [change_s - time_s for change_s in (*begins_s, *ends_s)]
        until_s += [end_s - plant_s for _, end_s in self._by_hand]
        next_s = min((left_s for left_s in until_s if left_s > 0.0), default=math.inf)
        return most if next_s >= most * step_s else max(math.ceil((next_s - ROUNDING_S) / step_s), 1)

    def pulses(self, pulses_us: Array) -> Array:
        """The pulses (n, 8) that thrusters get, from those on the boards' outputs: a stuck one keeps its last."""
        if not (self._active or self._stuck_us):
            return pulses_us
        stuck = {(i, b.thruster - 1) for i, b in self._active_of("thruster") if b.effect == "stuck"}
        self._stuck_us = {output: self._stuck_us.get(output, float(pulses_us[output])) for output in stuck}
        if not stuck:
            return pulses_us
        outputs_us = pulses_us.copy()
        for output, pulse_us in self._stuck_us.items():
            outputs_us[output] = pulse_us
        return outputs_us

    def _active_of(self, kind: str) -> list[tuple[int, Break]]:
        """Faults of a kind that hold now, each with its robot's index (-1: none)."""
        broken = [fault.broken for fault in self._active if fault.broken.kind == kind]
        return [(self._robots.index(b.robot) if b.robot else -1, b) for b in broken]

    def _derive_effects(self) -> None:
        """Derive the effects of the active faults on thrusters, batteries, IMUs, camera, water and links."""
        n = len(self._robots)
        thrust, sag_v = np.ones((n, OUTPUTS)), np.zeros(n)
        factors = {"dead": 0.0, "reversed": -1.0, "stuck": 1.0}
        for i, b in self._active_of("thruster"):
            thrust[i, b.thruster - 1] *= factors.get(b.effect, b.value)
        for i, b in self._active_of("battery"):
            sag_v[i] += b.value
        self.actuators = ActuatorFaults(thrust, sag_v)
        self.imu = [ImuFaults()] * n
        for i, b in self._active_of("imu"):
            self.imu[i] = self.imu[i].with_effect(b)
        self.unmarked = frozenset(i for i, _ in self._active_of("marker"))
        self.camera = tuple(b for _, b in self._active_of("camera"))
        water = [b for _, b in self._active_of("water")]
        self.water_drop_m = next((b.value for b in reversed(water) if b.effect == "low"), 0.0)
        self.gust_mps = sum(b.value for b in water if b.effect == "gust")
        self.balls = tuple(Drifter(radius_m=b.value, start_m=(*b.place_m, self._depth_m)) for _, b in self._active_of("ball"))
        self.without_radio = frozenset(b.robot for _, b in self._active_of("radio"))
        self.links = [LinkFaults()] * n
        for i, b in self._active_of("link"):
            self.links[i] = self.links[i].with_effect(b)


def is_among(broken: Break, kinds: tuple[str, ...]) -> bool:
    """True if a fault is of one of these kinds, or is one that is named with its kind: `water gust`."""
    return broken.kind in kinds or f"{broken.kind} {broken.effect}" in kinds


def require_kinds(experiment: Experiment, kinds: tuple[str, ...], why: str) -> None:
    """Raise ConfigError if the timeline has a fault of a kind that this way of flying cannot have."""
    for i, fault in enumerate(experiment.sim.faults):
        if not is_among(fault.broken, kinds):
            raise ConfigError(f"sim.faults.{i}.what = {fault.what!r}: {why} (allowed here: {', '.join(kinds)})")


def faults_after_the_end(experiment: Experiment) -> list[str]:
    """Lines of text for the faults that begin after the end of the experiment's run."""
    late = [fault for fault in experiment.sim.faults if fault.at_s >= experiment.duration_s]
    return [f"never happens: {f.what} at {f.at_s:g} s, for the run ends after {experiment.duration_s:g} s" for f in late]
