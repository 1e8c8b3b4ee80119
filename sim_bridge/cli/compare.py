"""SHELL: `sim-bridge compare` and `sim-bridge tune` on the command line."""

import os
import sys
from collections.abc import Collection
from pathlib import Path
from typing import Annotated

import typer

from shoal.errors import ConfigError
from shoal.runtime.cli_options import Duration, ExperimentName, Settings, finite
from shoal.runtime.output import background, terminal
from shoal.runtime.output_files import COMPARISON, check_output, folder_in_use, run_folder

FIRST_OR_RANGE = "N or FIRST-LAST"
Jobs = Annotated[int | None, typer.Option(min=1, help="Processes that fly; default: one per core.")]


def _list(value: bool) -> None:
    """Print what can be compared, before any argument is missed."""
    if value:
        from sim_bridge.studies.comparison import VARIANTS

        for name, changes in VARIANTS.items():
            typer.echo(f"{name:26} {' '.join(changes)}")
        raise typer.Exit


def compare(
    experiment: ExperimentName,
    laws: Annotated[
        str, typer.Option(metavar="NAMES", help="Whom to compare, with commas: of --list (default: all), or MODULE:NAME.")
    ] = "",
    seeds: Annotated[str, typer.Option(metavar=FIRST_OR_RANGE, help="Seeds; each is flown by everyone.")] = "10",
    scatter: Annotated[
        float, typer.Option(min=0.0, help="Starts are moved by up to this much per seed, m and rad.", callback=finite)
    ] = 0.1,
    duration: Duration = None,
    jobs: Jobs = None,
    out: Annotated[Path | None, typer.Option(help="Folder for the results; default: runs/compare-EXPERIMENT-TIME.")] = None,
    _: Annotated[
        bool, typer.Option("--list", is_eager=True, callback=_list, help="Say what can be compared, and stop.")
    ] = False,
    settings: Settings = None,
) -> None:
    """Compare control laws: fly them on the same seeds without camera and network; print a table, write JSON and a report.

    A seed moves the starts and draws noise and thruster spread. Figures are means over seeds with 95 % bootstrap intervals;
    the column "×" is the ratio of the distance after 20 s to the first law's, on the same seeds. Results do not depend on
    --jobs. Exit code 0 if everything was flown, 1 if not, 2 for a configuration that cannot be.

    Examples:  sim-bridge compare numeric-disturbed --scatter 0.5
               sim-bridge compare pool --laws nmpc,lqr,nmpc-leader-follower --seeds 1-5 --set sim.numeric.pose_noise_m=0.0015
               PYTHONPATH=. sim-bridge compare numeric --laws nmpc,ownlaw:Pd --set "controller.own=[2.0, 6.0]"
    """
    from shoal.config.experiment import NO_CAMERA, experiment_path, load_experiment
    from sim_bridge.studies import comparison as comparing
    from sim_bridge.studies.comparison import VARIANTS

    console, numbers = terminal(background(sys.stdout)), _range(seeds)
    chosen = _names(laws, [*VARIANTS, *(law.strip() for law in laws.split(",") if ":" in law)] if laws else VARIANTS, "--laws")
    overrides = [*(settings or ()), *([f"duration_s={duration}"] if duration is not None else [])]
    name = load_experiment(experiment, [*overrides, NO_CAMERA]).name
    with run_folder(Path("runs"), f"compare-{name}") if out is None else folder_in_use(out) as folder:
        for file in COMPARISON:
            check_output(folder / file, [experiment_path(experiment)], mine=COMPARISON)
        if (folder / COMPARISON[0]).exists():
            raise ConfigError(f"{folder}: holds a comparison already (--out FOLDER makes another)")
        code = comparing.run(experiment, overrides, chosen, numbers, scatter, _cores(jobs), folder, console)
    raise typer.Exit(code)


def tune(
    laws: Annotated[str, typer.Option(metavar="NAMES", help="Which laws, with commas; default: all feedback laws.")] = "",
    scenes: Annotated[str, typer.Option(metavar="NAMES", help="Flown in each trial; default: all there are.")] = "",
    seeds: Annotated[str, typer.Option(metavar=FIRST_OR_RANGE, help="Other seeds than a comparison's.")] = "101-101",
    budget: Annotated[int, typer.Option(min=4, help="Trials per law.")] = 32,
    jobs: Jobs = None,
    settings: Settings = None,
) -> None:
    """Tune the laws that the MPC is compared with: the same search, budget and flights for each; print sections for an
    experiment file.

    With --set vehicle=FILE.toml for another vehicle. Exit code 1 if a search ended before its budget was spent: its best
    gains so far are printed all the same.

    Example:  sim-bridge tune --laws pid,lqr --budget 100 > gains.toml
    """
    from typing import get_args

    from shoal.config.baseline_controllers import LawName
    from sim_bridge.studies import gain_tuning as tuning

    chosen = _names(laws, [name for name in get_args(LawName) if name not in ("eso-mpc-article", "nmpc")], "--laws")
    scene_names = _names(scenes, tuning.SCENES, "--scenes")
    console, code = terminal(background(sys.stderr)), 0
    for tuned in tuning.run(chosen, scene_names, settings or (), _range(seeds), budget, _cores(jobs), console):
        after = f"{tuned.trials} of {budget}" if tuned.cut_short else f"{budget}"
        console.print(f"{tuned.law}: cost {tuned.first:.3f} before, {tuned.best:.3f} after {after} trials", soft_wrap=True)
        if tuned.cut_short:
            code = 1
            console.print(f"{tuned.law}: the search has not ended: {tuned.cut_short}", style="red", soft_wrap=True)
        typer.echo(tuned.toml())
    raise typer.Exit(code)


def _names(text: str, allowed: Collection[str], option: str) -> list[str]:
    """Split a list with commas; empty is everything."""
    names = [name.strip() for name in text.split(",") if name.strip()] or list(allowed)
    for name in names:
        if name not in allowed or names.count(name) > 1:
            raise typer.BadParameter(f"{option}: {name!r} (allowed, once each: {', '.join(allowed)})")
    return names


def _range(text: str) -> list[int]:
    """Seeds of `3`, which are 1 to 3 as in a campaign's file, or of `11-20`."""
    first, dash, last = text.partition("-")
    if not dash:
        first, last = "1", text
    if not (first.isdecimal() and last.isdecimal()) or not int(first) <= int(last) or int(last) < 1:
        raise typer.BadParameter(f"--seeds {text}: must be a number of seeds or a range (allowed: 10, 1-10, 7-7)")
    return list(range(int(first), int(last) + 1))


def _cores(jobs: int | None) -> int:
    return jobs or os.cpu_count() or 1
