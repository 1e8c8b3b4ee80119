"""Reference of topics and messages, from the contract itself."""

import ast
import inspect
import math
from pathlib import Path
from typing import Any, get_args

from shoal.messages import codec, topics
from shoal.messages.messages import Message
from shoal.messages.topics import EVERYONE, TOPICS, Qos, Topic

HEAD = """# Messages and topics

Written by `make docs` from `shoal/messages/topics.py` and `shoal/messages/messages.py`. In the log a message's schema is
`fleet.NAME` ([fleet.proto](fleet.proto)). Frames and units: [frames-and-units.md](../frames-and-units.md).

A topic's key stands below the fleet's name (`--fleet`, default `shoal`). A header of 28 bytes travels as Zenoh attachment:
session u64, sequence u32, stamp i64 in ns, age i64 in ns, little-endian (`shoal/messages/codec.py`).
"""
TOPICS_HEAD = """`*`: not recorded. `†`: no robot and no localizer may read it. A number after the way of sending: so many
messages are kept for a subscriber that comes later.
"""

MESSAGES_HEAD = """
## Messages

[fleet.proto](fleet.proto) has every message, field and choice with its meaning. Those of Foxglove are:
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


def _topic_row(topic: Topic) -> str:
    rate = f"{topic.rate_hz:g} Hz" if topic.rate_hz else "events"
    age = f"{topic.max_age_s:g} s" if math.isfinite(topic.max_age_s) else "never"
    name = topic.type.__name__
    cells = (
        f"`{topic.name}`{'' if topic.recorded else '*'}{'' if topic.readers == EVERYONE else '†'}",
        name,
        topic.publisher,
        rate,
        age,
        f"{topic.qos.name} {topic.cache_depth}" if topic.cache_depth else topic.qos.name,
    )
    return f"| {' | '.join(cells)} |"


def _message(cls: Any) -> str:
    """The message's name and meaning in a line."""
    return f"* **{cls.__name__}**: {' '.join((inspect.getdoc(cls) or '').split())}"


def page() -> str:
    """The whole page."""
    lines = [HEAD, "## Topics\n", TOPICS_HEAD]
    lines += ["| Key | Message | From | Rate | Stale after | Sent as |", "|---|---|---|---|---|---|"]
    lines += [_topic_row(topic) for topic in TOPICS]
    lines += [f"\n`{topics.COMMAND_KEY}` is a query: a Command in, a Reply out."]
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
    lines += [MESSAGES_HEAD, *(_message(cls) for cls in get_args(Message) if cls not in codec.OWN)]
    return "\n".join(lines) + "\n"


def files() -> dict[Path, str]:
    """The page and its text."""
    return {Path(__file__).parents[1] / "docs" / "reference" / "messages.md": page()}
