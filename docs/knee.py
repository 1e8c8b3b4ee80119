"""SHELL: docs/images/knee.png: tracking against smoothness as estimator and weights vary: `python -m docs.knee`."""

from pathlib import Path

import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.ticker import FixedLocator, NullFormatter, ScalarFormatter

from benchmarks.robot_agent.robustness import CURRENTS, flight

NAME, *SETTINGS = CURRENTS["figure-eight, 0.05 m/s"]
BANDWIDTHS = (0.75, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0)
WEIGHTS = (0.01, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0)
RATES = (0.02, 0.05, 0.1, 0.15, 0.25, 0.5)
R = (0.05, 0.05, 8.0)
# Where a force that turns with the robot must not be taken for a current: mass and drag wrong, late and noisy poses.
WRONG = ("sim.plant.mass_error=0.3", "sim.plant.drag_error=-0.3", "sim.latency_s=0.1", "sim.numeric.pose_noise_m=0.005")
SEED = 1


def main() -> None:
    """Fly every point and draw the three curves."""
    figure, panels = plt.subplots(1, 3, figsize=(15, 4.6))
    bandwidths = {w: flight(NAME, [*SETTINGS, f"controller.estimator.bandwidth_radps={w}"], SEED) for w in BANDWIDTHS}
    weights = {w: flight(NAME, [*SETTINGS, f"controller.mpc.r={[w * r for r in R]}"], SEED) for w in WEIGHTS}
    rates = {w: f"controller.estimator.current_rate_radps={w}" for w in RATES}
    for axes, title, flown, default in (
        (panels[0], "observer bandwidth, rad/s", bandwidths, 2.0),
        (panels[1], "weight of input changes, times the default", weights, 1.0),
    ):
        curve(axes, [f[1] for f in flown.values()], [f[0] for f in flown.values()], "#4477aa")
        for value, (tracking, smooth) in flown.items():
            axes.annotate(f"{value:g}", (smooth, tracking), textcoords="offset points", xytext=(6, 5))
        axes.plot(flown[default][1], flown[default][0], "o", markersize=12, markerfacecolor="none", color="#cc3311")
        axes.set(title=title, xlabel="RMS input change, % of the largest allowed", ylabel="tracking after 20 s, mm RMS")
        print(title, flown)
    for label, colour, settings in (
        ("in a current", "#4477aa", SETTINGS),
        ("no current, model wrong by 30 %", "#228833", WRONG),
    ):
        errors = [flight("figure-eight", [*settings, rate], SEED)[0] for rate in rates.values()]
        curve(panels[2], list(rates), errors, colour, label)
        print(label, dict(zip(RATES, errors, strict=True)))
    panels[2].axvline(0.15, color="#cc3311", linewidth=0.8)
    panels[2].set(title="rate at which a side force becomes a current", xlabel="rad/s", ylabel="tracking after 20 s, mm RMS")
    panels[2].legend()
    figure.suptitle("Figure of eight at 0.1 m/s, in a current of 0.05 m/s; red: the default")
    figure.tight_layout()
    figure.savefig(Path(__file__).parent / "images" / "knee.png", dpi=110)


def curve(axes: Axes, x: list[float], y: list[float], colour: str, label: str = "") -> None:
    """One curve on logarithmic axes with plain numbers."""
    axes.plot(x, y, "o-", color=colour, label=label)
    axes.set(xscale="log", yscale="log")
    for axis, ticks in (
        (axes.xaxis, (0.02, 0.05, 0.1, 0.2, 0.5, 2, 3, 5, 10, 20, 30)),
        (axes.yaxis, (2, 3, 5, 10, 20, 30, 50)),
    ):
        axis.set_major_locator(FixedLocator(ticks))
        axis.set_major_formatter(ScalarFormatter())
        axis.set_minor_formatter(NullFormatter())
    axes.grid(True, alpha=0.3)


if __name__ == "__main__":
    main()
