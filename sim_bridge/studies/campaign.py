"""A campaign: many flights of one experiment, its keys swept or drawn, its seeds counted up. Pure.

name = "model-errors"
experiment = "pool"
settings = ["duration_s=60"]                    # for every flight
seeds = 20                                      # flights of each combination: seeds 1 to 20
camera = true                                   # all of the system, in lockstep; default: numeric flights

[sweep]                                         # every combination of these
"sim.plant.mass_error" = [-0.2, 0.0, 0.2]

[draw]                                          # drawn anew for every seed
"sim.plant.drag_error" = { uniform = [-0.3, 0.3] }
"sim.plant.current_mps" = { uniform = [[-0.01, -0.01, 0.0], [0.01, 0.01, 0.0]] }
"sim.latency_s" = { choice = [0.03, 0.06, 0.1] }
"""

import itertools
import math
import shlex
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Self

import numpy as np
import tomli_w
from pydantic import Field, model_validator

from shoal.config.loader import Section
from sim_bridge.plant.random_streams import Stream, generator

DIGITS = 6  # significant digits of drawn values, so that commands stay readable

Bound = float | tuple[float, ...]


class Draw(Section):
    """One distribution. Bounds and parameters may be lists, one value for each component of the key."""

    uniform: tuple[Bound, Bound] | None = None  # from, to
    normal: tuple[Bound, Bound] | None = None  # mean, standard deviation
    choice: Annotated[tuple[Any, ...], Field(min_length=1)] | None = None

    @model_validator(mode="after")
    def _is_one_of_them(self) -> Self:
        """Refuse a distribution that is not exactly one of the three, or whose numbers make none."""
        kinds = [kind for kind in ("uniform", "normal", "choice") if getattr(self, kind) is not None]
        if len(kinds) != 1:
            raise ValueError(f"has {' and '.join(kinds) or 'none'} (allowed: one of uniform, normal, choice)")
        pair = self.uniform or self.normal
        if pair is not None and np.shape(pair[0]) != np.shape(pair[1]):
            raise ValueError(f"{kinds[0]}: the two must have as many components as each other")
        if self.uniform is not None and np.any(np.less(self.uniform[1], self.uniform[0])):
            raise ValueError(f"uniform: {list(self.uniform)}: must be from, to (allowed: the second not below the first)")
        if self.normal is not None and np.any(np.less(self.normal[1], 0.0)):
            raise ValueError(f"normal: {list(self.normal)}: must be mean, standard deviation (allowed: the second from 0 on)")
        return self

    def sample(self, random: np.random.Generator) -> Any:
        """Draw one value."""
        if self.choice is not None:
            return self.choice[int(random.integers(len(self.choice)))]
        if self.uniform is not None:
            return _short(random.uniform(*self.uniform))
        assert self.normal is not None
        return _short(random.normal(*self.normal))


class Campaign(Section):
    """The campaign's file."""

    name: Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9-]*$")]
    title: str = ""
    experiment: str
    settings: tuple[str, ...] = ()
    camera: bool = False
    seeds: Annotated[int, Field(ge=1, le=1_000_000)] = 1
    first_seed: Annotated[int, Field(ge=0)] = 1
    sweep: dict[str, Annotated[tuple[Any, ...], Field(min_length=1)]] = Field(default_factory=dict)
    draw: dict[str, Draw] = Field(default_factory=dict)

    @property
    def flights(self) -> int:
        return self.seeds * math.prod(len(values) for values in self.sweep.values())

    @property
    def end_seeds(self) -> tuple[int, int]:
        """The first and the last seed."""
        return self.first_seed, self.first_seed + self.seeds - 1

    @model_validator(mode="after")
    def _each_key_once(self) -> Self:
        doubled = sorted((set(self.sweep) & set(self.draw)) | ({*self.sweep, *self.draw} & {"seed"}))
        if doubled:
            raise ValueError(f"{doubled[0]}: cannot be set twice (seeds count by themselves; a key is swept or drawn)")
        return self


@dataclass(frozen=True)
class CampaignFlight:
    index: int
    seed: int
    values: dict[str, Any]  # of the keys that are swept or drawn

    def settings(self, campaign: Campaign) -> list[str]:
        """Settings for `--set`, without the seed."""
        return [*campaign.settings, *(f"{key}={_toml(value)}" for key, value in self.values.items())]

    def command(self, campaign: Campaign) -> str:
        """The command that flies this flight again, with log and report."""
        sets = "".join(f" --set {shlex.quote(setting)}" for setting in self.settings(campaign))
        command = "sil" if campaign.camera else "numeric"
        options = " --lockstep --one-process --no-web" if campaign.camera else ""
        return f"sim-bridge {command} {shlex.quote(campaign.experiment)}{options} --seed {self.seed}{sets}"


def command_of(campaign: Campaign, row: Mapping[str, Any]) -> str:
    """The command that flies the flight of a result's row again."""
    values = {key: row[key] for key in (*campaign.sweep, *campaign.draw)}
    return CampaignFlight(row["index"], row["seed"], values).command(campaign)


def flights(campaign: Campaign) -> Iterator[CampaignFlight]:
    """All flights, in order. Drawn values depend on the seed alone: every combination of swept keys meets the same draws,
    and a longer campaign begins with the same flights."""
    index = 0
    for seed in range(campaign.first_seed, campaign.first_seed + campaign.seeds):
        random = generator(seed, Stream.DRAWS)
        drawn = {key: draw.sample(random) for key, draw in campaign.draw.items()}
        for combination in itertools.product(*campaign.sweep.values()):
            yield CampaignFlight(index, seed, {**dict(zip(campaign.sweep, combination, strict=True)), **drawn})
            index += 1


def _short(value: Any) -> Any:
    """A number, or a list of them, rounded to DIGITS."""
    if np.ndim(value):
        return tuple(_short(item) for item in np.asarray(value).tolist())
    return float(f"{float(value):.{DIGITS}g}")


def _toml(value: Any) -> str:
    if isinstance(value, tuple | list):
        return f"[{', '.join(map(_toml, value))}]"
    if isinstance(value, dict):  # in one line
        return f"{{{', '.join(f'{_toml(key)} = {_toml(item)}' for key, item in value.items())}}}"
    return tomli_w.dumps({"v": value}).removeprefix("v = ").strip()
