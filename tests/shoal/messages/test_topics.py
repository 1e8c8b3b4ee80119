"""One contract, written three times because three languages need it: topic table, dataclasses, protobuf. They agree."""

import dataclasses
import enum
import math
import re
import subprocess
import sys
from pathlib import Path
from typing import Any, get_args, get_origin, get_type_hints

import pytest
from google.protobuf.descriptor import FieldDescriptor
from google.protobuf.descriptor_pb2 import FileDescriptorProto, FileDescriptorSet

from groundstation.planning.segment import first_segment
from shoal.config.controller import Safety
from shoal.config.experiment import load_experiment
from shoal.messages import codec, fleet_pb2, messages, topics
from shoal.messages.messages import (
    BoardReading,
    Command,
    DriveVelocity,
    Event,
    Frame,
    Message,
    Order,
    OrderTaken,
    Outcome,
    Picture,
    Preview,
    Reply,
    Video,
)
from shoal.messages.topics import TOPICS, Qos, Topic
from tests.shoal.strategies import CLASSES, OWN, example, nested

ROOT = Path(__file__).parents[3]
ENUMS = {
    messages.Track: "TRACK",
    messages.Mode: "MODE",
    messages.Guidance: "GUIDANCE",
    messages.Solve: "SOLVE",
    messages.Order: "ORDER",
    messages.Progress: "PROGRESS",
    messages.CameraHealth: "CAMERA",
}

each_topic = pytest.mark.parametrize("topic", TOPICS, ids=lambda topic: topic.name)


# --- the table


def test_the_table_holds_every_topic_once() -> None:
    defined = [value for value in vars(topics).values() if isinstance(value, Topic)]
    assert len(defined) == len(TOPICS)
    assert set(map(id, defined)) == set(map(id, TOPICS))


def test_no_two_topics_share_a_key() -> None:
    """Also not by way of a wildcard: what subscribes to all robots must not hear another topic."""
    keys = [topic.key() for topic in TOPICS] + [topics.COMMAND_KEY.format(robot="*"), topics.PRESENCE_KEY.format(process="*")]
    patterns = [re.compile("/".join("[^/]+" if part == "*" else re.escape(part) for part in key.split("/"))) for key in keys]
    for key in keys:
        assert sum(pattern.fullmatch(key.replace("*", "7")) is not None for pattern in patterns) == 1, key


@each_topic
def test_a_key_names_one_robot_or_all(topic: Topic) -> None:
    assert re.fullmatch(r"[a-z]+(/([a-z]+|\{robot\}))*", topic.name)
    if "{robot}" in topic.name:
        assert topic.key(3) == topic.name.replace("{robot}", "3")
        assert topic.key() == topic.name.replace("{robot}", "*")
    else:
        assert topic.key(3) == topic.key() == topic.name


@each_topic
def test_a_periodic_topic_may_lose_one_message_and_stay_fresh(topic: Topic) -> None:
    if topic.rate_hz > 0:
        assert 2.0 / topic.rate_hz <= topic.max_age_s < math.inf
    else:
        assert topic.qos in (Qos.EVENT, Qos.JOURNAL) and topic.max_age_s == math.inf


def test_a_maximum_age_set_by_an_experiment_is_the_same_for_all_processes() -> None:
    """Stations and robots used to have a number each, which could drift apart."""
    limited = {topic.limit: topic for topic in TOPICS if topic.limit}
    assert set(limited) == {"pose_hold_s", "plan_max_age_s", "station_hold_s"}
    other = Safety(pose_hold_s=0.3, plan_max_age_s=0.7, station_hold_s=2.0)
    for key, topic in limited.items():
        assert topic.max_age_s == topic.max_age_in(Safety()) == getattr(Safety(), key)
        assert topic.max_age_in(other) == getattr(other, key) != topic.max_age_s
    assert topics.STATE.max_age_in(other) == topics.STATE.max_age_s


@each_topic
def test_recovered_topics_have_a_cache_that_fits_a_boards_memory(topic: Topic) -> None:
    assert (topic.cache_depth > 0) == (topic.qos in topics.RECOVERED)
    path = first_segment(load_experiment("pool")).trajectories[1]
    largest: dict[Topic, Message] = {
        topics.TRAJECTORY: path,
        topics.ORDERS: OrderTaken(0, 0, 1, 1, 0, command=Command(Order.LOAD, 1, trajectory=path)),
        topics.EVENT: Event(2, "agent-1", 500 * "x"),
    }
    each = len(codec.encode(largest.get(topic, example(topic.type))))
    assert topic.cache_depth * each < 8_000_000


@each_topic
def test_a_picture_waits_for_commands(topic: Topic) -> None:
    assert (topic.qos is Qos.IMAGE) == (topic.type in (Frame, Preview, Video, Picture))


@each_topic
def test_a_recorded_topic_has_a_schema(topic: Topic) -> None:
    """Its file descriptor must be complete: a log with a schema that refers to a missing file does not open."""
    if topic.recorded:
        descriptor = codec.descriptor(topic.type)
        parsed = FileDescriptorProto.FromString(descriptor.file.serialized_pb)
        assert descriptor.name in [message.name for message in parsed.message_type]
        assert len(parsed.dependency) == len(descriptor.file.dependencies)


def test_every_message_has_a_topic_or_is_part_of_another() -> None:
    assert set(CLASSES) == {topic.type for topic in TOPICS} | {Command, DriveVelocity, Outcome, Reply, BoardReading}
    once = [topic for topic in TOPICS if topic is not topics.EXPOSED]  # a tick, which the localizer is told of earlier
    assert len({topic.type for topic in once}) == len(once)


# --- dataclasses and protobuf


@pytest.mark.parametrize("cls", [Frame, Preview, Video, Picture, Event], ids=lambda cls: cls.__name__)
def test_viewers_know_these_schemas(cls: type) -> None:
    assert codec.descriptor(cls).full_name.startswith("foxglove.")


@pytest.mark.parametrize("cls", OWN, ids=lambda cls: cls.__name__)
def test_fields_have_the_same_names_in_both(cls: Any) -> None:
    ours = {field.name for field in dataclasses.fields(cls)}
    assert ours == set(codec.descriptor(cls).fields_by_name)


def _expected(hint: Any, metadata: Any) -> tuple[set[int], bool, str | None]:
    """Protobuf types that fit a dataclass field, whether it is repeated, and the name of its enum or message."""
    integers = {FieldDescriptor.TYPE_UINT32, FieldDescriptor.TYPE_UINT64, FieldDescriptor.TYPE_INT64}
    if "shape" in metadata:
        return {FieldDescriptor.TYPE_DOUBLE}, True, None
    if nested(hint) is not None:
        return {FieldDescriptor.TYPE_MESSAGE}, False, nested(hint).__name__
    if get_origin(hint) is tuple:
        return {FieldDescriptor.TYPE_STRING} if get_args(hint)[0] is str else integers, True, None
    if isinstance(hint, type) and issubclass(hint, enum.Enum):
        return {FieldDescriptor.TYPE_ENUM}, False, hint.__name__
    simple = {
        float: {FieldDescriptor.TYPE_DOUBLE},
        bool: {FieldDescriptor.TYPE_BOOL},
        str: {FieldDescriptor.TYPE_STRING},
        int: integers,
    }
    return simple[hint], False, None


@pytest.mark.parametrize("cls", OWN, ids=lambda cls: cls.__name__)
def test_fields_have_the_same_types_in_both(cls: Any) -> None:
    hints, theirs = get_type_hints(cls), codec.descriptor(cls).fields_by_name
    for field in dataclasses.fields(cls):
        kinds, repeated, refers_to = _expected(hints[field.name], field.metadata)
        found = theirs[field.name]
        assert found.type in kinds, field.name
        assert found.is_repeated == repeated, field.name
        other = found.enum_type or found.message_type
        assert (other.name if other is not None else None) == refers_to, field.name


def test_protobuf_has_no_message_and_no_enum_more() -> None:
    assert set(fleet_pb2.DESCRIPTOR.message_types_by_name) == {cls.__name__ for cls in OWN}
    assert set(fleet_pb2.DESCRIPTOR.enum_types_by_name) == {choices.__name__ for choices in ENUMS}
    ours = [
        value
        for value in vars(messages).values()
        if isinstance(value, enum.EnumMeta) and value.__module__ == "shoal.messages.messages"
    ]
    assert set(ours) == set(ENUMS)


@pytest.mark.parametrize("choices", ENUMS, ids=lambda choices: choices.__name__)
def test_enums_have_the_same_values_in_both(choices: type[enum.IntEnum]) -> None:
    theirs = fleet_pb2.DESCRIPTOR.enum_types_by_name[choices.__name__].values_by_name
    assert {name: value.number for name, value in theirs.items()} == {
        f"{ENUMS[choices]}_{member.name}": member.value for member in choices
    }


def test_the_generated_code_is_current(tmp_path: Path) -> None:
    """fleet_pb2.py is what the compiler makes of fleet.proto today; otherwise: make proto."""
    out = tmp_path / "fleet.pb"
    compiler = [sys.executable, "-m", "grpc_tools.protoc", "-I.", f"--descriptor_set_out={out}", "shoal/messages/fleet.proto"]
    subprocess.run(compiler, cwd=ROOT, check=True)
    compiled = FileDescriptorSet.FromString(out.read_bytes()).file[0]
    generated = FileDescriptorProto.FromString(fleet_pb2.DESCRIPTOR.serialized_pb)
    for file in (compiled, generated):
        for message in file.message_type:
            for field in message.field:
                field.ClearField("json_name")
    assert compiled == generated
