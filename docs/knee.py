"""SHELL: docs/images/knee.png: tracking against smoothness as estimator and weights vary: `python docs/knee.py`."""

from pathlib import Path

import matplotlib.pyplot as plt

from benchmarks.robustness import CURRENTS, flight

NAME, *SETTINGS = CURRENTS["figure-eight, 0.05 m/s"]
BANDWIDTHS = (0.5, 0.75, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0)
WEIGHTS = (0.01, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0)
RATES = (0.0, 0.03, 0.05, 0.1, 0.15, 0.25, 0.5, 1.0)
R = (0.05, 0.05, 8.0)
SEED = 1


def main() -> None:
    """Fly every point and draw the three curves."""
    sweeps = {
        "observer bandwidth, rad/s": {w: f"controller.estimator.bandwidth_radps={w}" for w in BANDWIDTHS},
        "weight of input changes, times the default": {w: f"controller.mpc.r={[w * r for r in R]}" for w in WEIGHTS},
        "rate at which a side force becomes a current, rad/s": {
            w: f"controller.estimator.current_rate_radps={w}" for w in RATES
        },
    }
    defaults = (2.0, 1.0, 0.15)
    figure, panels = plt.subplots(1, 3, figsize=(15, 4.6), sharey=True)
    for axes, (title, points), default in zip(panels, sweeps.items(), defaults, strict=True):
        flown = {value: flight(NAME, [*SETTINGS, setting], SEED) for value, setting in points.items()}
        axes.plot([f[1] for f in flown.values()], [f[0] for f in flown.values()], "o-", color="#4477aa")
        for value, (tracking, smooth) in flown.items():
            axes.annotate(f"{value:g}", (smooth, tracking), textcoords="offset points", xytext=(6, 5))
        axes.plot(flown[default][1], flown[default][0], "o", markersize=12, markerfacecolor="none", color="#cc3311")
        axes.set(title=title, xlabel="RMS input change, % of the largest allowed", xscale="log", yscale="log")
        axes.grid(True, which="both", alpha=0.3)
        print(title, flown)
    panels[0].set_ylabel("tracking after 20 s, mm RMS")
    figure.suptitle("Figure of eight at 0.1 m/s in a current of 0.05 m/s; circled: the default")
    figure.tight_layout()
    figure.savefig(Path(__file__).parent / "images" / "knee.png", dpi=110)


if __name__ == "__main__":
    main()
