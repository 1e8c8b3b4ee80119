"""SHELL: command line options that all four programs share, so that they read the same everywhere, and how a shell completes
them."""

import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer

from shoal.errors import ConfigError
from shoal.runtime.output_files import RUN
from shoal.runtime.version import code

DEFAULT_STATION = "tcp/127.0.0.1:7447"
DEFAULT_FLEET = "shoal"
DEFAULT_WEB = "127.0.0.1:8000"
REPLAY_PREFIX = "replay/"  # of the fleet that a recorded run is put on the bus as: no program of ours can join it


def caution(*texts: str) -> None:
    """Say on the standard error what is known to go wrong."""
    for text in texts:
        typer.echo(f"warning: {text}", err=True)


def fleet_name(fleet: str) -> str:
    """A fleet's name, if it can be one: keys on the bus and certificates begin with it. Raises ValueError."""
    if fleet.startswith(REPLAY_PREFIX):
        raise ValueError(f"{fleet!r} is a recorded run, which no program can join")
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,31}", fleet):
        raise ValueError(f"{fleet!r} is no fleet's name (allowed: up to 32 letters, digits, _ . and -)")
    return fleet


def live_fleet(fleet: str | None) -> str | None:
    """`fleet_name` as an option has it."""
    try:
        return fleet if fleet is None else fleet_name(fleet)
    except ValueError as error:
        raise typer.BadParameter(str(error)) from None


def finite(value: Any) -> Any:
    """Refuse a number, or one of several, that is none: with NaN every limit holds. The callback of each option for a
    number."""
    for number in value if isinstance(value, list | tuple) else (value,):
        if number is not None and not math.isfinite(number):
            raise typer.BadParameter(f"{number:g} (allowed: finite numbers)")
    return value


def _limit_of(key: str) -> Callable[[Any], Any]:
    """Callback of an option for one key of the experiment: the same limits, told of the option."""

    def checked(value: Any) -> Any:
        from pydantic import TypeAdapter, ValidationError

        from shoal.config.experiment import Experiment

        if finite(value) is not None:
            field = Experiment.model_fields[key]
            allowed = TypeAdapter[Any](Annotated[field.annotation, *field.metadata])  # type: ignore[arg-type]
            try:
                allowed.validate_python(value)
            except ValidationError as error:
                raise typer.BadParameter(f"{value:g}: {error.errors()[0]['msg']}") from None
        return value

    return checked


def as_run(named: Any) -> Any:
    """Runs as a person names them, by folder or by log. Raises ConfigError for what is none."""
    return [_run_folder(one) for one in named] if isinstance(named, list | tuple) else named and _run_folder(named)


def _run_folder(named: Path) -> Path:
    folder = named.parent if named.name == RUN[0] and named.is_file() else named
    if not folder.is_dir():
        raise ConfigError(f"{named}: {'is no folder' if named.exists() else 'no such folder'} {_A_RUN}")
    if not any((folder / file).exists() for file in RUN[:2]):
        raise ConfigError(f"{named}: {' and '.join(RUN[:2])} are missing there {_A_RUN}")
    return folder


_A_RUN = f"(allowed: a run's folder, such as runs/pool-20260101-120000, or its {RUN[0]})"


def experiments(begun: str) -> list[str]:
    """Completions of an experiment's name: the shipped ones, and files and folders here."""
    from shoal.config.experiment import EXPERIMENTS

    folder, _, name = begun.rpartition("/")
    here = Path(folder or ("/" if begun.startswith("/") else "."))
    shipped = [path.stem for path in EXPERIMENTS.glob(f"{begun}*.toml")] if "/" not in begun else []
    files = [path for path in here.glob(f"{name}*") if path.is_dir() or path.suffix == ".toml"] if here.is_dir() else []
    return sorted(shipped) + sorted(f"{path}/" if path.is_dir() else str(path) for path in files)


def _say_version(is_requested: bool) -> None:
    if is_requested:
        typer.echo(str(code()))
        raise typer.Exit


Version = Annotated[
    bool, typer.Option("--version", callback=_say_version, is_eager=True, help="Say which version and commit this is.")
]
ExperimentName = Annotated[
    str,
    typer.Argument(
        metavar="EXPERIMENT",
        help="A shipped experiment, for example `pool`, or a path ending in .toml.",
        autocompletion=experiments,
    ),
]
RunFolder = Annotated[Path, typer.Argument(metavar="RUN", help="Folder of a run.", callback=as_run)]
Seed = Annotated[
    int | None, typer.Option(help="Seed of everything random; default: the experiment's.", callback=_limit_of("seed"))
]
Duration = Annotated[
    float | None, typer.Option(help="Seconds to fly; default: the experiment's.", callback=_limit_of("duration_s"))
]
Settings = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="Change one key of the experiment, e.g. --set duration_s=30. Repeatable."),
]
FaultLines = Annotated[
    list[str] | None,
    typer.Option(
        "--fault", metavar="LINE", help='Break something: "t=20 for=5 thruster 2/3 dead". Repeatable (docs/simulator.md).'
    ),
]
StationAddress = Annotated[
    str, typer.Option("--station", metavar="ENDPOINT", help="Where the ground station's router listens (Zenoh endpoint).")
]
FleetName = Annotated[
    str, typer.Option("--fleet", callback=live_fleet, help="Name of the fleet: fleets of different names ignore each other.")
]

KeyRing = Annotated[
    Path | None,
    typer.Option(
        "--keys",
        metavar="FOLDER",
        envvar="SHOAL_KEYS",
        help="The fleet's key ring: mutual TLS, access control (docs/security.md).",
    ),
]
Insecure = Annotated[
    bool,
    typer.Option("--insecure", help="Off this machine without keys: every program on the network can command the robots."),
]
CameraName = Annotated[str, typer.Option("--camera", metavar="NAME", help="One of the experiment's several cameras.")]
FrameRingOption = Annotated[
    int | None,
    typer.Option(
        "--frame-ring", metavar="DESCRIPTOR", help="Frames by shared memory: an open file that `sim-bridge sil` hands on."
    ),
]
LinkKey = Annotated[
    Path | None, typer.Option("--link-key", metavar="FILE", help="Sign the link to the board with this key (mode 0600).")
]
LinkInsecure = Annotated[
    bool, typer.Option("--link-insecure", help="Let an unsigned link to the board leave this machine over UDP.")
]
AsJson = Annotated[bool, typer.Option("--json", help="Print it as JSON, for a script.")]
ListenAddress = Annotated[str, typer.Option("--listen", metavar="ENDPOINT", help="Where the fleet's Zenoh router listens.")]
ExternalRouter = Annotated[bool, typer.Option(help="Connect to a router that runs elsewhere at --listen.")]
WebAddress = Annotated[str, typer.Option("--web", metavar="HOST:PORT", help="Where the operator's page is served.")]
Verbose = Annotated[bool, typer.Option("--verbose", "-v", help="Log details too.")]
