"""Bytes to messages and back: nothing is lost, and nothing that is not a message gets through."""

import contextlib
import dataclasses
import enum
import math
import os
from typing import Any, get_type_hints

import numpy as np
import pytest
from foxglove_schemas_protobuf.Log_pb2 import Log
from google.protobuf.message import DecodeError as ProtobufError
from hypothesis import given
from hypothesis import strategies as st

from shoal.messages import codec
from shoal.messages.codec import DecodeError, Header, decode, encode
from shoal.messages.messages import (
    Command,
    CommandKind,
    CommandTaken,
    Control,
    Event,
    Frame,
    LocalizerStatus,
    Obstacles,
    Outcome,
    Picture,
    Plan,
    Pose,
    Preview,
    Reply,
    RobotState,
    StationHeartbeat,
    StepInputs,
    Trajectory,
    Truth,
    Video,
)
from shoal.messages.schema import nested_message
from tests.shoal.strategies import CLASSES, FOREIGN, OWN, damaged, example, same, valid

pytestmark = pytest.mark.long

each_class = pytest.mark.parametrize("cls", CLASSES, ids=lambda cls: cls.__name__)


def _decode(cls: Any, data: bytes) -> Any:
    return decode(cls, data, "session 7", "some/topic")


def _refused(cls: Any, data: bytes) -> DecodeError:
    with pytest.raises(DecodeError) as caught:
        _decode(cls, data)
    error = caught.value
    assert str(error) == f"from session 7, topic some/topic, field {error.field}: {error.reason}"
    return error


# --- round trips


@given(st.data())
@each_class
def test_an_encoded_message_decodes_to_the_same(cls: Any, data: st.DataObject) -> None:
    message = data.draw(valid(cls))
    assert same(_decode(cls, encode(message)), message)


@each_class
def test_every_field_is_carried(cls: Any) -> None:
    """No field of the example is at its default, so a forgotten one would come back different."""
    message = example(cls)
    assert same(_decode(cls, encode(message)), message)


@given(st.integers(0, 2**63 - 1))
def test_schemas_with_a_time_of_their_own_carry_the_stamp(stamp_ns: int) -> None:
    seconds, nanos = divmod(stamp_ns % (2**31 * 10**9), 10**9)
    for cls in FOREIGN:
        parsed = codec.protobuf_class(cls).FromString(encode(example(cls), seconds * 10**9 + nanos))
        assert (parsed.timestamp.seconds, parsed.timestamp.nanos) == (seconds, nanos)


def test_defaults_survive() -> None:
    assert same(_decode(RobotState, encode(RobotState())), RobotState())
    assert same(_decode(Command, encode(Command(CommandKind.ARM, 1))), Command(CommandKind.ARM, 1))


@pytest.mark.parametrize("cls", OWN, ids=lambda cls: cls.__name__)
def test_encoded_messages_are_those_of_protobufs_own_classes(cls: Any) -> None:
    """Arrays are packed by our own hand. Whoever reads logs has only the schema."""
    message, theirs = example(cls), codec.protobuf_class(cls).FromString(encode(example(cls)))
    assert same(_decode(cls, theirs.SerializeToString()), message)
    for field in dataclasses.fields(cls):
        if "shape" in field.metadata:
            assert list(getattr(theirs, field.name)) == getattr(message, field.name).ravel().tolist()
            assert getattr(theirs, field.name), "an example that shows nothing"


def test_an_array_that_breaks_off_within_a_number_is_refused() -> None:
    plan = Plan(0.05, np.ones((1, 4)), np.ones((1, 4)))
    whole = np.ones(4).tobytes()
    cut = encode(plan).replace(bytes([len(whole)]) + whole, bytes([len(whole) - 1]) + whole[:-1], 1)
    assert _refused(Plan, cut).field == "(all)"


def test_obstacles_that_do_not_all_say_how_long_they_were_unseen_are_refused() -> None:
    message = example(Obstacles)
    for count in (0, len(message.outline) + 1):
        assert _refused(Obstacles, encode(dataclasses.replace(message, unseen_s=np.zeros(count)))).field == "unseen_s"


# --- every field, spoilt


def _fields(wanted: str) -> list[Any]:
    """(class, dotted field, path to it) of every float, array (of rows) or enum field, also inside an optional message."""
    parameters = []

    def walk(top: Any, cls: Any, path: tuple[str, ...]) -> None:
        hints = get_type_hints(cls)
        for field in dataclasses.fields(cls):
            hint, here = hints[field.name], (*path, field.name)
            is_enum = isinstance(hint, type) and issubclass(hint, enum.Enum)
            kind = "array" if "shape" in field.metadata else "float" if hint is float else "enum" if is_enum else ""
            rows = kind == "array" and field.metadata["shape"] != (-1,)  # a list of numbers may be of any length
            if wanted == kind or (rows and wanted == "rows"):
                parameters.append(pytest.param(top, here, id=f"{top.__name__}.{'.'.join(here)}"))
            elif nested_message(hint) is not None:
                walk(top, nested_message(hint), here)

    for cls in OWN:
        walk(cls, cls, ())
    return parameters


def _spoilt(message: Any, path: tuple[str, ...], spoil: Any) -> Any:
    name, *rest = path
    old = getattr(message, name)
    return dataclasses.replace(message, **{name: _spoilt(old, tuple(rest), spoil) if rest else spoil(old)})


BAD = (math.nan, math.inf, -math.inf, 1.01 * codec.LARGEST, -1e308)


@pytest.mark.parametrize("cls,path", _fields("float"))
def test_no_float_but_a_finite_one_gets_through(cls: Any, path: tuple[str, ...]) -> None:
    for bad in BAD:
        error = _refused(cls, encode(_spoilt(example(cls), path, lambda _, bad=bad: bad)))
        assert error.field == ".".join(path)
        assert str(bad) in error.reason


@pytest.mark.parametrize("cls,path", _fields("array"))
def test_no_array_with_a_bad_element_gets_through(cls: Any, path: tuple[str, ...]) -> None:
    for bad in BAD:
        for position in (0, -1):

            def spoil(old: Any, bad: float = bad, position: int = position) -> Any:
                new = old.copy()
                new.flat[position] = bad
                return new

            assert _refused(cls, encode(_spoilt(example(cls), path, spoil))).field == ".".join(path)


@pytest.mark.parametrize("cls,path", _fields("rows"))
def test_no_array_of_another_size_gets_through(cls: Any, path: tuple[str, ...]) -> None:
    for size in (1, -1):
        error = _refused(cls, encode(_spoilt(example(cls), path, lambda old, size=size: np.resize(old, old.size + size))))
        second = {"wrench": "wrench_step"}.get(path[-1])  # of four: with another size than the first one, it is refused
        assert error.field in (".".join(path), ".".join([*path[:-1], second or ""]))
        assert "shape" in error.reason


def test_a_wrench_has_three_numbers_or_four_with_sway_in_all_of_a_message() -> None:
    """Messages of robots without side thrust, and of logs from before there was any, have three."""
    names = ("wrench", "wrench_step", "wrench_wanted", "wrench_delivered")
    with_sway = dataclasses.replace(example(Control), **{name: np.arange(4.0) for name in names})
    assert _decode(Control, encode(with_sway)).wrench.tolist() == [0.0, 1.0, 2.0, 3.0]
    for name in names[1:]:
        mixed = dataclasses.replace(with_sway, **{name: np.arange(3.0)})
        assert _refused(Control, encode(mixed)).field == name
    truth = example(Truth)
    both = [dataclasses.replace(truth, wrench=np.ones((2, axes))) for axes in (3, 4)]
    assert [_decode(Truth, encode(message)).wrench.shape for message in both] == [(2, 3), (2, 4)]
    assert _refused(Truth, encode(dataclasses.replace(truth, wrench=np.ones((2, 5))))).field == "wrench"


def test_arrays_of_one_message_have_one_length() -> None:
    """A reference whose velocities end before its positions would be noticed only when a robot gets there."""
    rows = np.ones((3, 4))
    error = _refused(Trajectory, encode(Trajectory("t", 0.05, rows, rows[:2], rows)))
    assert (error.field, error.reason) == ("velocity", "2 rows, but eta has 3")
    error = _refused(Command, encode(dataclasses.replace(example(Command), trajectory=Trajectory("t", 0.05, rows, rows))))
    assert error.field == "trajectory.acceleration"


def test_an_obstacle_without_a_number_is_not_passed_over() -> None:
    """Readers go through numbers and outlines together: what has no number would be nowhere."""
    two = Obstacles(ids=(7,), outline=np.zeros((2, 12, 2)), velocity=np.zeros((2, 2)), unseen_s=np.zeros(2), watched=1.0)
    assert _refused(Obstacles, encode(two)).reason == "1 numbers for 2 rows of outline"
    assert _refused(Obstacles, encode(dataclasses.replace(two, ids=(7, 8, 9)))).field == "ids"
    assert _decode(Obstacles, encode(dataclasses.replace(two, ids=(7, 8)))).ids == (7, 8)


@pytest.mark.parametrize("period_s", [0.0, -0.05, -0.0])
def test_a_period_is_positive(period_s: float) -> None:
    assert _refused(Plan, encode(Plan(period_s))).field == "period_s"
    trajectory = dataclasses.replace(example(Trajectory), period_s=period_s)
    assert (
        _refused(Command, encode(dataclasses.replace(example(Command), trajectory=trajectory))).field == "trajectory.period_s"
    )


@pytest.mark.parametrize("cls,path", _fields("enum"))
def test_no_unknown_choice_gets_through(cls: Any, path: tuple[str, ...]) -> None:
    for bad in (99, -1):
        error = _refused(cls, encode(_spoilt(example(cls), path, lambda _, bad=bad: bad)))
        assert error.field == ".".join(path)
        assert str(bad) in error.reason and "allowed: 0 " in error.reason


@pytest.mark.parametrize("cls", [Pose, Plan, RobotState, Trajectory], ids=lambda cls: cls.__name__)
def test_an_empty_message_is_not_a_message_of_zeros(cls: Any) -> None:
    """An empty payload is valid protobuf. Where a pose would become the origin, it must not pass."""
    _refused(cls, b"")


# --- pictures, previews, events


def _picture(**changes: Any) -> bytes:
    image = codec.protobuf_class(Frame).FromString(encode(Frame(np.zeros((4, 6), np.uint8))))
    for name, value in changes.items():
        setattr(image, name, value)
    data: bytes = image.SerializeToString()
    return data


@pytest.mark.parametrize(
    ("changes", "field"),
    [
        ({"encoding": "rgb8"}, "encoding"),
        ({"encoding": "x" * 10_000}, "encoding"),
        ({"width": 5}, "step"),
        ({"step": 7}, "step"),
        ({"width": 0, "step": 0}, "step"),
        ({"width": 2**31, "step": 2**31, "height": 2**31}, "step"),
        ({"height": 3}, "data"),
        ({"data": b""}, "data"),
    ],
)
def test_a_picture_must_be_what_it_says(changes: dict[str, Any], field: str) -> None:
    error = _refused(Frame, _picture(**changes))
    assert error.field == field
    assert len(str(error)) < 200


@given(st.integers(1, 3), st.sampled_from([1, 100, 127, 128, 16383, 16384]), st.booleans())
def test_a_picture_is_what_any_protobuf_reader_expects(height: int, width: int, transposed: bool) -> None:
    """The fast encoder against protobuf itself, at every length of the length; also for pixels that lie scattered."""
    pixels = np.arange(height * width, dtype=np.uint64).astype(np.uint8).reshape(height, width)
    pixels = np.asfortranarray(pixels) if transposed else pixels
    image = codec.protobuf_class(Frame)(
        frame_id="camera", width=width, height=height, step=width, encoding="bayer_rggb8", data=pixels.tobytes()
    )
    image.timestamp.seconds = 5
    assert codec.protobuf_class(Frame).FromString(encode(Frame(pixels), 5 * 10**9)) == image


def test_protobuf_reads_the_pictures_that_we_write_and_we_read_its_own() -> None:
    ours = encode(Frame(np.arange(24, dtype=np.uint8).reshape(4, 6)))
    image = codec.protobuf_class(Frame).FromString(ours)
    assert (image.width, image.height, image.data) == (6, 4, bytes(range(24)))
    assert _decode(Frame, image.SerializeToString()).pixels.tobytes() == bytes(range(24))


@given(st.integers(0, 2**35), st.binary(max_size=40), st.permutations(range(4)))
def test_a_picture_is_read_as_protobuf_reads_it_in_any_order(unknown: int, spare: bytes, order: list[int]) -> None:
    """The fast decoder against protobuf itself: a field that we do not know, pixels twice, and pixels before other fields."""
    image = codec.protobuf_class(Frame)
    parts = [
        encode(Frame(np.arange(24, dtype=np.uint8).reshape(4, 6))),
        image(data=spare).SerializeToString(),
        image(frame_id="lens", width=6).SerializeToString(),
        codec.protobuf_class(RobotState)(heard=[unknown % 2**31], fault="x").SerializeToString(),
    ]
    wire = b"".join(parts[i] for i in order)
    try:
        expected = image.FromString(wire)
    except ProtobufError:
        _refused(Frame, wire)
        return
    if len(expected.data) != 24:
        assert _refused(Frame, wire).field == "data"
    else:
        assert _decode(Frame, wire).pixels.tobytes() == expected.data


def test_a_picture_is_not_copied_and_not_writable() -> None:
    frame = _decode(Frame, encode(Frame(np.arange(24, dtype=np.uint8).reshape(4, 6))))
    assert not frame.pixels.flags.writeable
    assert not frame.pixels.flags.owndata


def test_a_preview_is_a_jpeg() -> None:
    png = codec.protobuf_class(Preview)(format="png", data=b"x").SerializeToString()
    assert _refused(Preview, png).field == "format"


@pytest.mark.parametrize("level", [0, 6, -1])
def test_an_event_has_a_level_that_viewers_know(level: int) -> None:
    assert _refused(Event, codec.protobuf_class(Event)(level=level).SerializeToString()).field == "level"


# --- anything at all


@given(st.binary(max_size=300))
@each_class
def test_any_bytes_are_a_message_or_a_decode_error(cls: Any, data: bytes) -> None:
    with contextlib.suppress(DecodeError):
        assert isinstance(_decode(cls, data), cls)


def _floats(message: Any) -> list[float]:
    values: list[float] = []
    for field in dataclasses.fields(message):
        value = getattr(message, field.name)
        if isinstance(value, float):
            values.append(value)
        elif isinstance(value, np.ndarray) and value.dtype == np.float64:
            values.extend(value.ravel().tolist())
        elif dataclasses.is_dataclass(value):
            values.extend(_floats(value))
    return values


def _bombard(cls: Any, count: int) -> tuple[int, int]:
    """Damaged payloads: how many got through and how many were refused. What got through is finite."""
    random = np.random.default_rng(1)
    data, passed = encode(example(cls)), 0
    for _ in range(count):
        try:
            message = _decode(cls, damaged(data, random, edits=3, longest=8))
        except DecodeError:
            continue
        passed += 1
        assert all(abs(value) <= codec.LARGEST for value in _floats(message))
    return passed, count - passed


@each_class
def test_damaged_messages_are_messages_or_decode_errors(cls: Any) -> None:
    passed, refused = _bombard(cls, 500)
    assert passed > 0 and refused > 0


@pytest.mark.slow
@each_class
def test_a_million_damaged_messages(cls: Any) -> None:
    passed, refused = _bombard(cls, 1_000_000 // len(CLASSES))
    assert passed > 0 and refused > 0


@each_class
def test_a_message_of_another_type_is_a_message_or_a_decode_error(cls: Any) -> None:
    for other in CLASSES:
        with contextlib.suppress(DecodeError):
            _decode(cls, encode(example(other)))


@each_class
def test_an_oversized_payload_is_refused_before_it_is_parsed(cls: Any) -> None:
    limit = codec.max_bytes(cls)
    large = limit == codec.MAX_MESSAGE_BYTES
    assert large == (cls in (Trajectory, Command, CommandTaken, Preview, Picture, Video))
    error = _refused(cls, bytes(limit + 1))
    assert (error.field, error.reason) == ("(size)", f"{limit + 1} bytes, more than the allowed {limit}")


def test_the_largest_messages_that_a_fleet_sends_get_through() -> None:
    nodes, robots, obstacles = (
        200,
        49,
        200,
    )  # a horizon's and a fleet's bounds in shoal/config/controller.py and shoal/config/experiment.py
    ids = tuple(range(robots))
    for message in (
        Plan(0.05, np.ones((nodes, 4)), np.ones((nodes, 4))),
        Truth(ids, np.ones((robots, 4)), np.ones((robots, 4)), np.ones((robots, 3)), np.ones((robots, 4))),
        StepInputs(1, plan_robots=ids, plan_sessions=ids, plan_sequences=ids, plan_instants_ns=(2**62,) * robots),
        Obstacles(tuple(range(obstacles)), np.ones((obstacles, 12, 2)), np.ones((obstacles, 2)), unseen_s=np.ones(obstacles)),
    ):
        assert same(_decode(type(message), encode(message)), message)


def _spoilt_wire(message: Any, **fields: Any) -> bytes:
    """A message's wire form with some of its protobuf fields replaced."""
    theirs = codec.protobuf_class(type(message)).FromString(encode(message))
    for name, value in fields.items():
        setattr(theirs, name, value)
    return bytes(theirs.SerializeToString())


@pytest.mark.parametrize(
    ("cls", "data", "says"),
    [
        (
            Trajectory,
            lambda: encode(dataclasses.replace(example(Trajectory), period_s=0.0)),
            "period_s: 0.0 is not more than 0",
        ),
        (RobotState, lambda: _spoilt_wire(RobotState(), mode=99), "mode: 99 is not allowed (allowed: 0 DISARMED, 1 ARMED, "),
        (Event, lambda: _spoilt_wire(Event(2, "x", "y"), level=0), "level: 0 is not allowed (allowed: 1 to 5)"),
        (Preview, lambda: _spoilt_wire(Preview(b""), format="png"), "format: 'png' is not allowed (allowed: jpeg)"),
        (
            Frame,
            lambda: _spoilt_wire(Frame(np.zeros((2, 2), np.uint8)), encoding="rgb8"),
            "encoding: 'rgb8' is not allowed (allowed: bayer_rggb8)",
        ),
        (
            Frame,
            lambda: _spoilt_wire(Frame(np.zeros((2, 2), np.uint8)), step=3),
            "step: 2 x 2 with step 3 is no packed picture",
        ),
        (
            Frame,
            lambda: _spoilt_wire(Frame(np.zeros((2, 2), np.uint8)), height=3),
            "data: 4 bytes, must be 6",
        ),
        (Plan, lambda: _plan_cut(1), "(all): no valid fleet.Plan: "),
        (Plan, lambda: _plan_cut(8), "eta: 3 values do not fill the shape (-1, 4)"),
        (Plan, lambda: encode(Plan(0.05, np.ones((2, 4)), np.ones((1, 4)))), "eta_reference: 1 rows, but eta has 2"),
        (Plan, lambda: b"\xff", "(all): no valid fleet.Plan: "),
    ],
    ids=lambda value: value[:20] if isinstance(value, str) else "",
)
def test_a_refusal_names_the_field_what_it_holds_and_what_is_allowed(cls: Any, data: Any, says: str) -> None:
    assert f"field {says}" in str(_refused(cls, data()))


def _plan_cut(less: int) -> bytes:
    """A plan of one node whose first array lacks so many bytes."""
    whole = np.ones(4).tobytes()
    plan = encode(Plan(0.05, np.ones((1, 4)), np.ones((1, 4))))
    return plan.replace(bytes([len(whole)]) + whole, bytes([len(whole) - less]) + whole[: len(whole) - less], 1)


@pytest.mark.parametrize("cls", [Pose, LocalizerStatus, RobotState, StationHeartbeat])
def test_a_status_of_megabytes_is_none(cls: Any) -> None:
    assert _refused(cls, bytes(codec.MAX_SMALL_BYTES + 1)).field == "(size)"


def test_a_line_of_the_log_is_cut_where_people_stop_reading() -> None:
    """By the sender, and again by who hears it: a sender may be anybody with a robot's certificate."""
    sent = encode(Event(2, "me", "x" * 100_000))
    assert len(sent) < 1100
    long = Log(level=Log.Level.INFO, name="n" * 5000, message="x" * 5000).SerializeToString()
    event = _decode(Event, long)
    assert (len(event.source), len(event.message), event.message[-1]) == (codec.LONGEST_LINE, codec.LONGEST_LINE, "…")
    assert _refused(Event, Log(level=Log.Level.INFO, message="x" * 20_000).SerializeToString()).field == "(size)"


def test_an_overlong_text_is_cut_by_the_sender_and_refused_by_the_receiver() -> None:
    sent = _decode(Reply, encode(Reply(1, False, "x" * 100_000)))
    assert len(sent.reason) == codec.LONGEST_TEXT
    foreign = codec.protobuf_class(Reply)(robot=1, reason="x" * (codec.LONGEST_TEXT + 1)).SerializeToString()
    assert _refused(Reply, foreign).field == "reason"


def test_the_name_of_a_file_that_is_no_text_is_sent_escaped() -> None:
    """Linux allows any bytes in a name; Python has them as lone surrogates, which protobuf refuses."""
    name = os.fsdecode(b"caf\xe9 \xe2\x82\xac")
    shown = "caf\\udce9 €"
    assert _decode(Event, encode(Event(4, name, name))).message == shown
    outcome = Outcome(1, reason=name, waiting=(1,), why=(name,))
    assert _decode(Outcome, encode(outcome)).why == (shown,)
    assert _decode(Reply, encode(Reply(1, False, name))).reason == shown


def test_deep_nesting_is_refused() -> None:
    """Groups within groups: what overflows the stack of a naive parser."""
    _refused(RobotState, b"\x0b" * 100_000)


# --- the header

headers = st.builds(
    Header,
    session=st.integers(0, 2**64 - 1),
    sequence=st.integers(0, 2**32 - 1),
    stamp_ns=st.integers(-codec.FARTHEST_NS, codec.LATEST_NS),
    age_ns=st.integers(0, codec.FARTHEST_NS),
)


@given(headers)
def test_a_header_comes_back(header: Header) -> None:
    assert Header.decode(header.encode(), "p", "t") == header


def test_the_headers_layout_is_fixed() -> None:
    """Other programs read it too: 28 bytes, little-endian."""
    expected = "080706050403020109000000feffffffffffffff0300000000000000"
    assert Header(0x0102030405060708, 9, -2, 3).encode().hex() == expected


@given(st.binary(max_size=40))
def test_any_bytes_are_a_header_or_a_decode_error(data: bytes) -> None:
    try:
        assert Header.decode(data, "p", "t").age_ns >= 0
        assert len(data) == 28
    except DecodeError as error:
        assert error.field.startswith("header")


@pytest.mark.parametrize(
    ("header", "says"),
    [
        (Header(1, 1, 0, -1), r"header.age_ns: -1 is not allowed \(allowed: 0 to"),
        (Header(1, 1, 0, codec.FARTHEST_NS + 1), r"header.age_ns: 1152921504606846977 is not allowed"),
        (Header(1, 1, codec.LATEST_NS + 1), r"header.stamp_ns: 4611686018427387905 is not allowed"),
        (Header(1, 1, -codec.FARTHEST_NS - 1), r"header.stamp_ns: -1152921504606846977 is not allowed"),
    ],
)
def test_a_time_that_no_clock_shows_is_refused(header: Header, says: str) -> None:
    with pytest.raises(DecodeError, match=f"from p, topic t, field {says}"):
        Header.decode(header.encode(), "p", "t")


@pytest.mark.parametrize("size_px", [(1, 1), (8, 16), (127, 1), (128, 1), (120, 160), (1, 16384), (960, 1280)])
def test_the_pixels_of_a_raw_picture_are_found_without_a_copy(size_px: tuple[int, int]) -> None:
    """Sizes on both sides of each length of a varint: protobuf reads the same, but copies, which takes 1 ms."""
    pixels = np.random.default_rng(1).integers(0, 256, size_px, np.uint8)
    data = encode(Frame(pixels), 7)
    pixels_read = decode(Frame, data, "test", "frame").pixels
    assert np.array_equal(pixels_read, pixels) and np.shares_memory(pixels_read, np.frombuffer(data, np.uint8))
    assert codec.protobuf_class(Frame).FromString(data).data == pixels.tobytes()
