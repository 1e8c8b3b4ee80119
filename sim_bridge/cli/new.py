"""SHELL: `sim-bridge new`: an experiment file to begin with."""

from pathlib import Path
from typing import Annotated

import typer

from shoal.errors import ConfigError, os_errors_as_config_errors
from shoal.runtime.output_files import replace_text

TEMPLATE = Path(__file__).parent / "templates" / "experiment.toml"


def new(
    name: Annotated[str, typer.Argument(metavar="NAME", help="Its name: small letters, digits and -. The file is NAME.toml.")],
    out: Annotated[Path, typer.Option(metavar="FOLDER", help="Where the file goes.")] = Path(),
) -> None:
    """Write an experiment of one's own to begin with: commented, and one that flies (docs/tutorial.md).

    A file that is there already is left as it is, and told.

    Example:  sim-bridge new lab
    """
    from pydantic import TypeAdapter, ValidationError

    from shoal.config.experiment import Name
    from shoal.config.key_reference import schema_line

    try:
        TypeAdapter(Name).validate_python(name)
    except ValidationError:
        raise typer.BadParameter(f"{name!r} is no name (allowed: up to 64 small letters, digits and -)") from None
    text = f"{schema_line('experiment')}\n{TEMPLATE.read_text(encoding='utf-8').replace('NAME', name)}"
    file = out / f"{name}.toml"
    with os_errors_as_config_errors(file):
        try:
            replace_text(file, text, over=False)
        except FileExistsError:
            raise ConfigError(f"{file}: is there already, and would be lost (choose another NAME)") from None
    typer.echo(f"{file}: try  sim-bridge numeric {file}")
