"""The messages that the page gets as TypeScript types, with the comments of their fields."""

import dataclasses
import inspect
from collections.abc import Iterator
from enum import IntEnum
from pathlib import Path
from types import NoneType
from typing import Any, get_args, get_origin, get_type_hints

from groundstation.web.snapshot import OFF_PAGE
from shoal.frames import Array
from shoal.messages.messages import (
    BoardReading,
    CameraHealth,
    Control,
    Estimate,
    Guidance,
    LocalizerStatus,
    Mode,
    Obstacles,
    Pose,
    RobotState,
    Solve,
    StepTiming,
    Track,
)
from tools.messages import field_comments

CHOICES = (Mode, Guidance, Track, Solve, CameraHealth)
MESSAGES = (RobotState, Estimate, Control, BoardReading, StepTiming, Pose, LocalizerStatus, Obstacles)
HEAD = """/** Messages as the page gets them (groundstation/web/snapshot.py), and what they mean. Written by `make docs` from
 * shoal/messages/messages.py; edit that. */

import type { Packed } from "./wire";
"""


def _type(hint: Any) -> str:
    if hint is Array:
        return "Packed"
    if get_origin(hint) is tuple:
        return f"{_type(get_args(hint)[0])}[]"
    if parts := get_args(hint):
        return " | ".join(map(_type, parts))
    return {float: "number", int: "number", str: "string", bool: "boolean", NoneType: "null"}.get(hint) or str(hint.__name__)


def _message(cls: Any) -> Iterator[str]:
    summary = (inspect.getdoc(cls) or "").partition("\n\n")[0].replace("\n", " ")
    yield f"\n/** {summary} */\nexport interface {cls.__name__} {{"
    comments, hints = field_comments(cls), get_type_hints(cls)
    for field in dataclasses.fields(cls):
        if field.name not in OFF_PAGE:
            comment = f" // {comments[field.name]}" if comments[field.name] else ""
            yield f"  {field.name}: {_type(hints[field.name])};{comment}"
    yield "}"


def _choices(cls: type[IntEnum]) -> str:
    names = " | ".join(f'"{member.name}"' for member in cls)
    return f"export type {cls.__name__} = {names};"


def text() -> str:
    """The whole file."""
    return "\n".join([HEAD, *map(_choices, CHOICES), *(line for cls in MESSAGES for line in _message(cls))]) + "\n"


def files() -> dict[Path, str]:
    """The file and its text."""
    page = Path(__file__).parents[1] / "groundstation" / "web" / "page"
    return {page / "src" / "messages.ts": text()}
