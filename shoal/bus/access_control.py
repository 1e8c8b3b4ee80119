"""The router's access control, derived from the topic table. Pure.

The router denies everything that no rule allows. It knows a member by the common name of its certificate and looks at each
message twice: on its way in from the sender and on its way out to the receiver. Who comes through the station's door has no
certificate, and an operator's rights. A rule covers a message if one of its keys
includes the message's key, so a robot that may write `robot/1/state` may not write `robot/*/state`.

Zenoh's parts are finer than ours: to publish means to put, and to be told who subscribes (without that a session keeps its
messages to itself); to serve means to declare a queryable and to reply. Events, which are recovered after an outage, need a
cache that is asked, a beat that tells the newest number, and tokens by which the two sides find each other; these live below
the event's key, behind a part that begins with `@` and that no wildcard covers.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from shoal.messages.messages import WHOLE_FLEET
from shoal.messages.topics import (
    CLAIM_KEY,
    COMMAND_KEY,
    COMMANDERS,
    OF_CAMERAS,
    OPERATORS,
    PRESENCE_KEY,
    RECOVERED,
    TOPICS,
    Role,
    Topic,
    localizer_name,
    process_name,
)

INSECURE = "INSECURE: the network is open, every program on it can command the robots"  # said where there are no keys

# Zenoh's protocol of the station's door, which this machine's user alone can open (groundstation/gate/gate.py).
DOOR = "unixsock-stream"

CACHE, FOLLOWER = "@adv/pub/**", "@adv/sub/**"  # below an event's key: the publisher's side and the subscriber's


@dataclass(frozen=True)
class Member:
    """One certificate of the fleet: whose it is, and by which name the router knows it."""

    role: Role
    common_name: str
    robot: int = 0  # a robot's number


AT_THE_DOOR = Member(
    Role.OPERATOR, "operator at the door"
)  # no certificate has such a name: groundstation/deploy/certificate_authority.py


@dataclass(frozen=True)
class Grants:
    """Keys below the fleet's name, by what may be done with them."""

    write: tuple[Topic, ...]
    read: tuple[Topic, ...]
    serve: tuple[str, ...]
    ask: tuple[str, ...]
    announce: tuple[str, ...]


def grants(member: Member) -> Grants:
    """The rights of a member."""
    names = [process_name(member.role, member.robot)]
    names += [localizer_name("$*")] if member.role is Role.LOCALIZER else []  # one of several cameras
    every = (*TOPICS, *(topic.of_camera("*") for topic in OF_CAMERAS))
    of_fleet = COMMAND_KEY.format(robot=WHOLE_FLEET)  # requests, which the station serves
    serve: tuple[str, ...] = ()
    if member.role is Role.ROBOT:
        serve = (COMMAND_KEY.format(robot=member.robot),)
    elif member.role is Role.STATION:
        serve = (of_fleet,)
    ask: tuple[str, ...] = ()
    if member.role in COMMANDERS:
        ask = (COMMAND_KEY.format(robot="*"),)
    elif member.role in OPERATORS:
        ask = (of_fleet,)
    return Grants(
        write=tuple(topic for topic in every if member.role in topic.writers),
        read=tuple(topic for topic in every if member.role in topic.readers),
        serve=serve,
        ask=ask,
        announce=tuple(
            key.format(process=name, state="*", session="*") for name in names for key in (PRESENCE_KEY, CLAIM_KEY)
        ),
    )


def access_control(fleet: str, members: Iterable[Member]) -> dict[str, Any]:
    """Zenoh's `access_control` section for a fleet of these members, an operator at the station's door, and no others."""
    rules: list[dict[str, Any]] = []
    subjects, policies = [], []
    for member in (AT_THE_DOOR, *members):
        own = _rules(fleet, member)
        rules += own
        known_by = {"link_protocols": [DOOR]} if member is AT_THE_DOOR else {"cert_common_names": [member.common_name]}
        subjects.append({"id": member.common_name, **known_by})
        policies.append({"rules": [rule["id"] for rule in own], "subjects": [member.common_name]})
    return {"enabled": True, "default_permission": "deny", "rules": rules, "subjects": subjects, "policies": policies}


def listed(access: Mapping[str, Any]) -> tuple[str, ...]:
    """The common names that this section lets through."""
    return tuple(name for subject in access["subjects"] for name in subject.get("cert_common_names", ()))


def _rules(fleet: str, member: Member) -> list[dict[str, Any]]:
    """The router's rules for one certificate: keys it may write, read, and ask for what it missed."""
    may = grants(member)
    robot = member.robot if member.role is Role.ROBOT else None

    def keys(names: Iterable[str]) -> list[str]:
        return [f"{fleet}/{name}" for name in names]

    def below(topics: Iterable[Topic], number: int | None, part: str) -> list[str]:
        return keys(f"{topic.key(number)}/{part}" for topic in topics if topic.qos in RECOVERED)

    written, read = keys(topic.key(robot) for topic in may.write), keys(topic.key() for topic in may.read)
    cached = keys(topic.key(robot) for topic in may.write if topic.qos in RECOVERED)
    recovered = keys(topic.key() for topic in may.read if topic.qos in RECOVERED)
    cache, follows = below(may.write, robot, CACHE), below(may.read, None, FOLLOWER)
    caches, followers = below(may.read, None, CACHE), below(may.write, robot, FOLLOWER)
    presence = keys(key.format(process="*", state="*", session="*") for key in (PRESENCE_KEY, CLAIM_KEY))
    anything = [f"{fleet}/**", f"{fleet}/**/@adv/**"]
    serve, ask = keys(may.serve), keys(may.ask)
    listens = ["declare_liveliness_subscriber", "liveliness_query"]
    rules: list[tuple[str, str, list[str], Sequence[str]]] = [
        ("writes", "ingress", ["put"], written + cache),
        ("reads", "ingress", ["declare_subscriber"], read + caches),
        ("hears", "egress", ["put"], read + caches),
        ("serves", "ingress", ["declare_queryable"], serve + cache),
        ("is-asked", "egress", ["query"], serve + cache),
        ("answers", "ingress", ["reply"], serve + cached),
        ("asks", "ingress", ["query"], ask + caches),
        ("is-answered", "egress", ["reply"], ask + recovered),
        ("is-there", "ingress", ["liveliness_token"], keys(may.announce) + cache + follows),
        ("watches", "ingress", listens, presence + caches + followers),
        ("sees", "egress", ["liveliness_token"], presence + caches + followers),
        # Subscriptions, queryables and watches are no secret; messages are.
        ("is-told", "egress", ["declare_subscriber", "declare_queryable", *listens], anything),
    ]
    return [
        {
            "id": f"{member.common_name} {name}",
            "permission": "allow",
            "flows": [flow],
            "messages": messages,
            "key_exprs": list(key_exprs),
        }
        for name, flow, messages, key_exprs in rules
        if key_exprs
    ]
