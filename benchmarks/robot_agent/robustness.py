"""Flights in water that is not as the controller was told, or that streams. All errors are against the plant's truth.

A sample is a flight: p50 is the middle one of the seeds, max the worst. Accuracy is the RMS of the worst axis of the worst
robot after 20 s; smoothness the RMS of the worst input's change per step, in percent of the largest change allowed.
"""

import sys
from collections.abc import Iterator, Sequence

import numpy as np

from benchmarks.harness import Row
from groundstation.analysis.comparison import wrenches
from shoal.config.experiment import load_experiment
from tests.flights.scene_flights import flown

BENCHMARK = "robustness"
SEEDS = (1, 2, 3)
OPEN = "pool.walls=false"
SHORT = "duration_s=70"
ARTICLE = ("controller.estimator.sway=false", "safety.off_path_m=9")  # else it is soon stopped
HARD = ("sim.latency_s=0.1", "sim.plant.thruster_lag_s=0.1", "sim.numeric.pose_noise_m=0.005")

# Currents across a line, and on bends, up to half of the speed that is flown.
CURRENTS: dict[str, tuple[str, ...]] = {
    "pool, 0.007 m/s": ("pool", SHORT, OPEN, "sim.plant.current_mps=[0,0.007,0]"),
    "pool, 0.05 m/s, 3.5 times its speed": ("pool", SHORT, OPEN, "sim.plant.current_mps=[0,0.05,0]"),
    "figure-eight, 0.01 m/s": ("figure-eight", OPEN, "sim.plant.current_mps=[0,0.01,0]"),
    "figure-eight, 0.05 m/s": ("figure-eight", OPEN, "sim.plant.current_mps=[0,0.05,0]"),
    "straight at 0.02 m/s, 0.01 m/s": ("straight", "path.speed_mps=0.02", "sim.plant.current_mps=[0,0.01,0]"),
    "straight at 0.1 m/s, 0.05 m/s": ("straight", "sim.plant.current_mps=[0,0.05,0]"),
    "straight at 0.3 m/s, 0.15 m/s": ("straight", "path.speed_mps=0.3", "sim.plant.current_mps=[0,0.15,0]"),
    "straight at 0.4 m/s, 0.2 m/s": ("straight", "path.speed_mps=0.4", "sim.plant.current_mps=[0,0.2,0]"),
}
VARIANTS: dict[str, tuple[str, ...]] = {"ours": (), "no sway and no current in the estimate": ARTICLE}
# Both ways wrong, late and noisy at once.
ERRORS: dict[str, tuple[str, ...]] = {
    f"{scene}, mass {mass:+.0%}, drag {drag:+.0%}, 100 ms, 5 mm": (
        *((scene, SHORT) if scene == "pool" else (scene,)),
        *HARD,
        f"sim.plant.mass_error={mass}",
        f"sim.plant.drag_error={drag}",
    )
    for scene in ("pool", "figure-eight")
    for mass in (-0.3, 0.3)
    for drag in (-0.3, 0.3)
}


def flight(name: str, settings: Sequence[str], seed: int) -> tuple[float, float]:
    """Accuracy in mm and smoothness in percent of one flight."""
    experiment = load_experiment(name, [*settings, f"seed={seed}"])
    flight = flown(experiment)
    stopped = {state.fault for states in flight.states for state in states if state.fault}
    if stopped:
        print(f"{name} {' '.join(settings)} seed={seed}: not flown to the end: {', '.join(stopped)}", file=sys.stderr)
    after = [states[flight.settled :] for states in flight.states]
    change = wrenches(after, "wrench_step", len(experiment.wrench_step))
    rms = np.sqrt(np.mean(flight.error[flight.settled :, :, :3] ** 2, axis=0)).max()
    smooth = (np.sqrt(np.mean(change**2, axis=1)) / experiment.wrench_step).max()
    return 1e3 * float(rms), 100.0 * float(smooth)


def rows(case: str, subject: str, name: str, settings: Sequence[str]) -> list[Row]:
    """Both figures over all seeds."""
    flights = [flight(name, settings, seed) for seed in SEEDS]
    units = ("mm RMS after 20 s", "% of the largest input change, RMS")
    return [Row.of(BENCHMARK, case, subject, unit, [f[i] for f in flights]) for i, unit in enumerate(units)]


def run() -> Iterator[Row]:
    """Currents with and without the estimator's means against them; then errors of model, timing and localisation at once."""
    for case, (name, *settings) in CURRENTS.items():
        for subject, more in VARIANTS.items():
            yield from rows(case, subject, name, [*settings, *more])
    for case, (name, *settings) in ERRORS.items():
        yield from rows(case, "ours", name, settings)
