"""The table of topics holds every topic once, with a message whose schema is complete."""

import math
import re

import pytest
from google.protobuf.descriptor_pb2 import FileDescriptorProto

from groundstation.planning.segment import first_segment
from shoal.config.controller import Safety
from shoal.config.experiment import load_experiment
from shoal.messages import codec, topics
from shoal.messages.messages import (
    BoardReading,
    Command,
    CommandKind,
    CommandTaken,
    Control,
    DriveVelocity,
    Estimate,
    Event,
    Frame,
    Message,
    Outcome,
    Picture,
    Preview,
    Reply,
    StepTiming,
    Video,
)
from shoal.messages.topics import TOPICS, Qos, Topic
from tests.shoal.strategies import CLASSES, example

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
        topics.COMMANDS: CommandTaken(0, 0, 1, 1, 0, command=Command(CommandKind.LOAD, 1, trajectory=path)),
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


PARTS = {BoardReading, Estimate, Control, StepTiming}  # of a robot's state


def test_every_message_has_a_topic_or_is_part_of_another() -> None:
    assert set(CLASSES) == {topic.type for topic in TOPICS} | {Command, DriveVelocity, Outcome, Reply, *PARTS}
    once = [topic for topic in TOPICS if topic is not topics.EXPOSED]  # a tick, which the localizer is told of earlier
    assert len({topic.type for topic in once}) == len(once)


@pytest.mark.parametrize("cls", [Frame, Preview, Video, Picture, Event], ids=lambda cls: cls.__name__)
def test_viewers_know_these_schemas(cls: type) -> None:
    assert codec.descriptor(cls).full_name.startswith("foxglove.")
