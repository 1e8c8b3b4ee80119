"""Faults injected into a simulated run: the timeline under [[sim.faults]], and `--fault` on the command line.

[[sim.faults]]
at_s = 20.0                  # since the flight began; a second flight has the timeline again
for_s = 5.0                  # then it is whole again; without it, never
what = "thruster 2/3 dead"   # the same as --fault "t=20 for=5 thruster 2/3 dead"
"""

import re
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Annotated, Self

from pydantic import Field, model_validator

from shoal.config.loader import Section
from shoal.config.vehicle import OUTPUTS
from shoal.errors import ConfigError


@dataclass(frozen=True)
class Effect:
    """One way to be broken, and its number's meaning, default and range, if it has one."""

    happens: str
    meaning: str = ""
    default: float = 0.0
    low: float = 0.0
    high: float = 0.0


# kind -> (what it happens to, what may happen)
KINDS: dict[str, tuple[str, dict[str, Effect]]] = {
    "thruster": (
        "ROBOT/THRUSTER",
        {
            "dead": Effect("the thruster gives no thrust; the number is its board's output: legs have 1 to 4"),
            "stuck": Effect("it keeps the pulse that it has"),
            "reversed": Effect("it pushes the other way"),
            "weak": Effect("it gives a part of its thrust", "fraction of its thrust", 0.5, 0.0, 1.0),
        },
    ),
    "marker": ("ROBOT", {"lost": Effect("the plate is no longer on the robot")}),
    "camera": (
        "[CAMERA]",
        {
            "gone": Effect("no frames; without CAMERA, of all cameras"),
            "slow": Effect("frames come later, with true stamps", "delay in s", 0.1, 0.0, 2.0),
            "frozen": Effect("the same picture again and again"),
            "dark": Effect("a sixteenth of the light"),
            "occluded": Effect("something covers the picture's left part", "fraction of the picture", 0.4, 0.0, 1.0),
            "glare": Effect("a white disc in the middle", "fraction of the picture", 0.2, 0.0, 1.0),
            "lamp": Effect("the light changes", "times as much light", 0.5, 0.1, 4.0),
            "bubbles": Effect("bright specks rise in front of everything", "streams of bubbles", 10.0, 1.0, 50.0),
            "bump": Effect("the camera is turned: everything moves", "pixels to the right and down", 60.0, 2.0, 1000.0),
        },
    ),
    "water": (
        "",
        {
            "low": Effect("the water's level falls, in the pictures", "metres that its level fell", 0.02, -0.2, 0.2),
            "gust": Effect("the water moves along x besides its current", "m/s", 0.05, -1.0, 1.0),
        },
    ),
    "ball": ("X,Y", {"drops": Effect("a red ball lies at x, y in m, at the path's depth", "radius in m", 0.12, 0.02, 1.0)}),
    "imu": (
        "ROBOT",
        {
            "heading": Effect("an error besides noise and bias", "error in rad", 0.5, -3.2, 3.2),
            "gyro": Effect("the same for the yaw rate", "error in rad/s", 0.1, -10.0, 10.0),
            "scaled": Effect("the yaw rate is multiplied: 0 is dead, -1 reversed", "by how much", 0.0, -10.0, 10.0),
            "stuck": Effect("yaw rate and acceleration stay at what they were"),
            "turned": Effect("it is mounted otherwise, turned about the axis ahead", "rad", 1.6, -3.2, 3.2),
        },
    ),
    "battery": (
        "ROBOT",
        {"sag": Effect("the voltage falls, and the thrust with it", "volts lost", 1.5, 0.0, 20.0)},
    ),
    "link": (
        "ROBOT",
        {
            "cut": Effect("nothing passes between computer and board, both ways"),
            "noisy": Effect("messages are damaged", "fraction lost, and as much again doubled and overtaken", 0.1, 0.0, 1.0),
            "slow": Effect("messages come late", "delay in s", 0.1, 0.0, 5.0),
        },
    ),
    "radio": ("ROBOT", {"dead": Effect("nothing passes between its computer and the fleet, both ways")}),
    "process": (
        "NAME",
        {"killed": Effect("SIGKILL; NAME as in the run's `logs/`"), "stopped": Effect("SIGSTOP: the process is frozen")},
    ),
    "disk": ("", {"full": Effect("the station's log may not grow any more (Linux)")}),
    "clock": (
        "NAME",
        {"step": Effect("the program's wall clock jumps, not its monotonic clock", "by how many seconds", 3600.0, -1e6, 1e6)},
    ),
}
SEEN = frozenset({"camera", "marker"})  # that only a camera tells
OF_PROCESSES = ("process", "disk", "clock")  # by the wall clock, and from outside
_TARGETS = {
    "": "",
    "X,Y": r"(-?[\d.]+),(-?[\d.]+)",
    "[CAMERA]": r".*",
    "ROBOT": r"(\d+)",
    "ROBOT/THRUSTER": r"(\d+)/(\d+)",
    "NAME": r"(\S+)",
}
_LINE = re.compile(r"t=(?P<at>\S+)(?:\s+for=(?P<during>\S+))?\s+(?P<what>\S.*)")


@dataclass(frozen=True)
class Break:
    """A parsed fault."""

    kind: str
    effect: str
    value: float = 0.0
    robot: int = 0  # 0: none
    thruster: int = 0  # the board's output that it is on, from 1: legs are 1 to 4 in the vehicle file's order
    process: str = ""
    place_m: tuple[float, float] = (0.0, 0.0)  # of a ball
    camera: str = ""  # one of several cameras; "": all of them


def read_what(text: str) -> Break:
    """The meaning of `thruster 2/3 weak 0.5`. Raises ValueError that says what is allowed."""
    kind, *words = text.split() or [""]
    if kind not in KINDS:
        raise ValueError(f"{kind!r} cannot be broken (allowed: {', '.join(KINDS)})")
    target, effects = KINDS[kind]
    usages = "|".join(_usage(name, effect) for name, effect in effects.items())
    malformed = ValueError("must read: " + " ".join(part for part in (kind, target, usages) if part))
    is_left_out = target == "[CAMERA]" and words and words[0] in effects
    target_text = words.pop(0) if target and words and not is_left_out else ""
    match = re.fullmatch(_TARGETS[target], target_text)
    if match is None or not words or words[0] not in effects:
        raise malformed
    name, *numbers = words
    effect = effects[name]
    if len(numbers) > (1 if effect.meaning else 0):
        raise malformed
    broken = Break(kind, name, _number(numbers[0], effect) if numbers else effect.default)
    if target == "NAME":
        return replace(broken, process=target_text)
    if target == "[CAMERA]":
        return replace(broken, camera=target_text)
    if target == "X,Y":
        return replace(broken, place_m=(float(match[1]), float(match[2])))
    if not target:
        return broken
    robot, thruster = int(match[1]), int(match[2]) if target == "ROBOT/THRUSTER" else 0
    if robot < 1:
        raise ValueError(f"robot {robot}: no robot has this number (allowed: 1 and more)")
    if target == "ROBOT/THRUSTER" and not 1 <= thruster <= OUTPUTS:
        raise ValueError(f"thruster {thruster} of robot {robot}: no such thruster (allowed: 1 to {OUTPUTS})")
    return replace(broken, robot=robot, thruster=thruster)


BY_HAND = "by hand: "  # begins the log's line about a fault that a person made, written as --fault takes it


def no_target(broken: Break, robots: Collection[int], thrusters: Collection[int], cameras: Sequence[str]) -> str:
    """Reason for which nothing here can break so: no such robot, none of its `thrusters`, or none of several `cameras`; empty
    if it can."""
    if broken.robot and broken.robot not in robots:
        return f"no robot {broken.robot} (allowed: {', '.join(map(str, robots))})"
    if broken.thruster and broken.thruster not in thrusters:
        allowed = ", ".join(map(str, thrusters))
        return f"thruster {broken.thruster} of robot {broken.robot}: no such thruster (allowed: {allowed})"
    if broken.camera and broken.camera not in cameras:
        return f"no camera {broken.camera!r} (allowed: {', '.join(cameras) or 'no name: there is one camera'})"
    return ""


def read_request(
    text: str, robots: Collection[int], thrusters: Collection[int], cameras: Sequence[str] = (), uses_camera: bool = True
) -> tuple[str, float]:
    """Read a person's `thruster 2/3 dead for 5`: what breaks, and for how long in s (0: for ever); of `repair` nothing.
    `thrusters`: those of each robot; `cameras`: names of several; `uses_camera` False: there is none. Raises ValueError that
    says what is allowed."""
    what, _, during = text.strip().partition(" for ")
    if what == "repair":
        return "", 0.0
    broken = read_what(what)
    if broken.kind in OF_PROCESSES or (broken.kind, broken.effect) == ("water", "low"):
        raise ValueError(f"{what}: only by the timeline, with --fault before the run")
    if reason := no_target(broken, robots, thrusters, cameras):
        raise ValueError(f"{what}: {reason}")
    if broken.kind in SEEN and not uses_camera:
        raise ValueError(f"{what}: no camera sees it in this run (localizer.uses_camera)")
    for_s = _seconds(during) if during else 0.0
    return what, for_s


def _seconds(text: str) -> float:
    """Parse the length of a fault. Raises ValueError."""
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0.0 < value <= 86_400.0:
        raise ValueError(f"for {text}: must be seconds, more than 0")
    return value


def _usage(name: str, effect: Effect) -> str:
    return f"{name} [{effect.meaning}]" if effect.meaning else name


def _number(text: str, effect: Effect) -> float:
    """Parse the number of a fault's effect, within the effect's range. Raises ValueError."""
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not effect.low <= value <= effect.high:
        raise ValueError(f"{text}: must be the {effect.meaning}, {effect.low:g} to {effect.high:g}")
    return value


class Fault(Section):
    """A fault of the timeline: the part that breaks, in which way, when, and for how long."""

    at_s: Annotated[float, Field(ge=0, examples=[20.0])]
    """Time of the flight: 0 is when the robots start. Each flight of a session has the timeline."""
    for_s: Annotated[float | None, Field(gt=0, examples=[5.0])] = None
    """Time after which it is whole again; left out: when the next flight begins."""
    what: Annotated[str, Field(examples=["thruster 2/3 dead"])]
    """The fault, as in --fault without its times."""

    @model_validator(mode="after")
    def _can_be_read(self) -> Self:
        if self.broken.effect == "killed" and self.for_s is not None:
            raise ValueError("for_s: what is killed does not come back (leave it out, or write `stopped`)")
        return self

    @cached_property
    def broken(self) -> Break:
        """The parsed text of `what`."""
        try:
            return read_what(self.what)
        except ValueError as error:
            raise ValueError(f"what = {self.what!r}: {error}") from None

    def holds(self, time_s: float) -> bool:
        """True if the fault is present at this time of the flight."""
        return time_s >= self.at_s and (self.for_s is None or time_s < self.at_s + self.for_s)


def fault_table(line: str) -> dict[str, float | str]:
    """`--fault "t=20 for=5 thruster 2/3 dead"` as a table of [[sim.faults]]. Raises ConfigError."""
    match = _LINE.fullmatch(line.strip())
    try:
        if match is None:
            raise ValueError
        table: dict[str, float | str] = {"at_s": float(match["at"]), "what": match["what"]}
        if match["during"] is not None:
            table["for_s"] = float(match["during"])
    except ValueError:
        raise ConfigError(
            f'--fault {line}: write it as "t=SECONDS [for=SECONDS] WHAT", e.g. "t=20 thruster 2/3 dead"'
        ) from None
    return table
