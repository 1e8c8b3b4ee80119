"""SHELL: `robot-agent identify`: a vehicle's numbers from measurements on a bench."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from robot_agent.host.params import ParameterSession, WhichRobot, talk
from shoal.errors import ConfigError, os_errors_as_config_errors
from shoal.runtime.cli_options import LinkInsecure, LinkKey, finite
from shoal.system.regular_files import read_regular

if TYPE_CHECKING:
    from robot_agent.preflight.thrust_curve import ThrustFit

cli = typer.Typer(help="A vehicle's numbers from measurements on a bench (docs/hardware.md).")


@cli.callback()
def main() -> None:
    """A vehicle's numbers from measurements on a bench (docs/hardware.md)."""


@cli.command()
def thrust(
    file: Annotated[Path, typer.Argument(metavar="CSV", help="Readings: a head pulse_us,grams; grams negative astern.")],
    vehicle: Annotated[
        str, typer.Option(help="The vehicle that has the thruster: a shipped one, or a path ending in .toml.")
    ] = ("spherical"),
    lever: Annotated[
        float, typer.Option(min=0.01, max=100.0, help="Thrust divided by the force on the scale.", callback=finite)
    ] = 1.0,
    still_g: Annotated[
        float, typer.Option(min=0.0, max=1000.0, help="Readings up to this count as no thrust.", callback=finite)
    ] = 3.0,
    link: Annotated[str | None, typer.Option("--link", help="Also write it to the thruster board at this address.")] = None,
    robot: WhichRobot = None,
    key: LinkKey = None,
    insecure: LinkInsecure = False,
) -> None:
    """Fit a thruster's curve to what a kitchen scale showed; print it for an experiment, and write it to a board.

    Exit code 2 for readings that no thruster makes, naming the line.

    Example:  robot-agent identify thrust scale.csv --lever 0.5 --link serial:/dev/serial/by-id/NAME
    """
    from robot_agent.preflight.thrust_curve import fit, read_rows
    from shoal.config.loader import MOST_BYTES, check
    from shoal.config.vehicle import Thruster, load_vehicle
    from shoal.mavlink.agent_link import STANDARD_GRAVITY_MPS2

    with os_errors_as_config_errors(file):
        try:
            lines = read_regular(file, MOST_BYTES).decode("utf-8-sig").splitlines()
        except UnicodeDecodeError as error:
            raise ConfigError(f"{file}: cannot be read: {error} (save it as CSV in UTF-8)") from None
    readings = read_rows(lines, str(file), lever)
    like = load_vehicle(vehicle).thruster
    curve_fit = fit(readings, str(file), len(like.curve), still_g * 1e-3 * STANDARD_GRAVITY_MPS2 * lever)
    largest_n = min(like.max_thrust_n, curve_fit.curve[-1][1])
    check(Thruster, {**like.model_dump(), "curve": curve_fit.curve, "max_thrust_n": largest_n}, str(file))
    typer.echo(toml(curve_fit, vehicle, largest_n, len(readings)))
    if link is not None:
        with talk(link, robot, key, insecure) as session:
            typer.echo(f"{write_curve(session, curve_fit)} parameters of the board at {link} changed", err=True)


def toml(curve_fit: "ThrustFit", vehicle: str, largest_n: float, readings: int) -> str:
    """The curve as an experiment's lines."""
    worst = f"at worst {curve_fit.worst_n:.3f} N in line {curve_fit.worst.line} ({curve_fit.worst.pulse_us} us)"
    points = ", ".join(f"[{pulse}, {force:g}]" for pulse, force in curve_fit.curve)
    return (
        f"# {readings} readings; {curve_fit.rms_n:.3f} N RMS from the curve, {worst}\n"
        f'[vehicle]\nlike = "{vehicle}"\n\n[vehicle.thruster]\nmax_thrust_n = {largest_n:g}\ncurve = [{points}]'
    )


def write_curve(session: ParameterSession, curve_fit: "ThrustFit") -> int:
    """Set the curve's parameters on the board; returns how many were changed. A value that does not fit the others yet is
    tried again when others have changed. Raises ConfigError if one is refused for good, if the board's curve has another
    number of points, or if the board does not tell all that it has."""
    client = session.client
    if not session.until(lambda: client.complete, client.ask_all):
        raise ConfigError(f"the board told {len(client.values)} parameters, and then no more: nothing of it was changed")
    rows = sum(name.startswith("CRV") and name.endswith("_US") for name in client.values)
    if rows != len(curve_fit.curve):
        raise ConfigError(
            f"the board's curve has {rows} points, and the measurement gives {len(curve_fit.curve)} (measure at more pulses)"
        )
    values: dict[str, float] = {}
    for i, (pulse_us, force_n) in enumerate(curve_fit.curve, 1):
        values |= {f"CRV{i:02}_US": float(pulse_us), f"CRV{i:02}_N": float(force_n)}
    wanted = {name: value for name, value in values.items() if not session.has(name, value)}
    changed = 0
    while wanted:
        before = len(wanted)
        for name, value in list(wanted.items()):
            if session.set(name, value):
                del wanted[name]
                changed += 1
        if len(wanted) == before:
            name, value = next(iter(wanted.items()))
            raise ConfigError(f"{name} = {value:g}: {client.last_words or 'the board does not answer'}")
    return changed
