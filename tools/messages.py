"""Reference of topics and messages, from the contract itself."""

import ast
import dataclasses
import enum
import inspect
import itertools
import math
import types
from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_args, get_origin, get_type_hints

from shoal.messages import messages, topics
from shoal.messages.messages import Message
from shoal.messages.topics import TOPICS, Qos, Topic

HEAD = """# Messages and topics

Written by `make docs` from `shoal/messages/topics.py` and `shoal/messages/messages.py`. In the log a message's schema is
`fleet.NAME` ([fleet.proto](fleet.proto)). Frames and units: [frames-and-units.md](../frames-and-units.md).

A topic's key stands below the fleet's name (`--fleet`, default `shoal`). A header of 28 bytes travels as Zenoh attachment:
session u64, sequence u32, stamp i64 in ns, age i64 in ns, little-endian (`shoal/messages/codec.py`).
"""
TOPICS_HEAD = """`*`: not recorded. `†`: no robot may read it. A number after the way of sending: so many messages are kept for
a subscriber that comes later.
"""

MESSAGES_HEAD = """
## Messages

`[int]` is a list, `float64[n,4]` an array of n rows; a type with `?` may be missing. The source explains the fields of
messages without a list here: the lockstep's clock, and records by which a step is repeated.
"""


def field_comments(cls: type) -> dict[str, str]:
    """The comments beside the fields or members of a class."""
    source = inspect.getsource(cls)
    body = ast.parse(source).body[0]
    assert isinstance(body, ast.ClassDef)
    comments = {}
    for node in body.body:
        target = node.target if isinstance(node, ast.AnnAssign) else node.targets[0] if isinstance(node, ast.Assign) else None
        if isinstance(target, ast.Name):
            lines = source.splitlines()[node.lineno - 1 : (node.end_lineno or node.lineno) + 1]
            here, below = lines[-2 if len(lines) > 1 else -1], lines[-1].strip()
            _, _, comment = here.partition("#")
            comments[target.id] = comment.strip() or (below.removeprefix("#").strip() if below.startswith("#") else "")
    return comments


def _type(hint: Any, metadata: Any) -> str:
    if "shape" in metadata:
        return f"float64[{','.join('n' if n == -1 else str(n) for n in metadata['shape'])}]"
    if get_origin(hint) is tuple:
        return f"[{get_args(hint)[0].__name__}]"
    if get_origin(hint) is types.UnionType:
        (present,) = (part for part in get_args(hint) if part is not types.NoneType)
        return f"{present.__name__}?"
    return str(getattr(hint, "__name__", None) or "uint8[height,width]")


def _topic_row(topic: Topic) -> str:
    rate = f"{topic.rate_hz:g} Hz" if topic.rate_hz else "events"
    age = f"{topic.max_age_s:g} s" if math.isfinite(topic.max_age_s) else "never"
    name = topic.type.__name__
    cells = (
        f"`{topic.name}`{'' if topic.recorded else '*'}{'' if topic.audience == 'everyone' else '†'}",
        f"[{name}](#{name.lower()})",
        topic.publisher,
        rate,
        age,
        f"{topic.qos.name} {topic.cache_depth}" if topic.cache_depth else topic.qos.name,
    )
    return f"| {' | '.join(cells)} |"


def _message(cls: Any) -> Iterator[str]:
    yield f"\n### {cls.__name__}\n\n{inspect.getdoc(cls)}\n"
    hints, comments = get_type_hints(cls), field_comments(cls)
    if any(topic.type is cls and (topic.qos is Qos.JOURNAL or topic in (topics.TICK, topics.EXPOSED)) for topic in TOPICS):
        return  # its fields are of use beside the code that repeats a step, or keeps step
    fields = [
        (_type(hints[field.name], field.metadata), comments[field.name], field.name) for field in dataclasses.fields(cls)
    ]
    for (kind, comment), group in itertools.groupby(fields, key=lambda field: field[:2]):
        every = [name for *_, name in group]
        for names in [[name] for name in every] if comment else [every]:  # names without a comment share a line
            yield f"* {', '.join(f'`{name}`' for name in names)} {kind}{f': {comment}' if comment else ''}"


def _choices(cls: type[enum.IntEnum]) -> Iterator[str]:
    comments = {name: comment.rstrip(".") for name, comment in field_comments(cls).items()}
    members = [f"{m.value} {m.name}{f' ({comments[m.name]})' if comments[m.name] else ''}" for m in cls]
    yield f"\n### {cls.__name__}\n\n{inspect.getdoc(cls)}\n\n{', '.join(members)}"


def _enums() -> list[type[enum.IntEnum]]:
    enums = (v for v in vars(messages).values() if isinstance(v, type) and issubclass(v, enum.IntEnum))
    return [cls for cls in enums if cls is not enum.IntEnum]


def page() -> str:
    """The whole page."""
    lines = [HEAD, "## Topics\n", TOPICS_HEAD]
    lines += ["| Key | Message | From | Rate | Stale after | Sent as |", "|---|---|---|---|---|---|"]
    lines += [_topic_row(topic) for topic in TOPICS]
    lines += [f"\n`{topics.COMMAND_KEY}` is a query: a [Command](#command) in, a [Reply](#reply) out."]
    camera = topics.POSE.of_camera("NAME").name
    lines += [
        f"Where there are several cameras, each has its own of {', '.join(f'`{topic.name}`' for topic in topics.OF_CAMERAS)} "
        f"below `camera/NAME/`, for example `{camera}`; those above are fused from them, without pictures."
    ]
    lines += [
        f"`{topics.PRESENCE_KEY}` is a liveliness token: there, not necessarily well. `{topics.CLAIM_KEY}` is one of a",
        "session that wants (`candidate`) or has (`holder`) a name: each name is one process's.",
        "\n### How a topic is sent\n",
    ]
    lines += [f"* **{qos.name}**: {qos.value}." for qos in Qos]
    lines += [
        MESSAGES_HEAD,
        *(line for cls in get_args(Message) for line in _message(cls)),
    ]
    lines += ["\n## Choices", *(line for cls in _enums() for line in _choices(cls))]
    return "\n".join(lines) + "\n"


def files() -> dict[Path, str]:
    """The page and its text."""
    return {Path(__file__).parents[1] / "docs" / "reference" / "messages.md": page()}
