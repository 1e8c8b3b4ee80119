"""A board's parameters as they come, what is asked for, and what is said where no board answers. No wires."""

import math
from pathlib import Path
from typing import Any

import pytest
from pymavlink.dialects.v20 import common as dialect

from shoal.mavlink import board_address
from shoal.mavlink.board_address import missing_port, number_in_name, serial_trouble
from shoal.mavlink.framing import Sender
from shoal.mavlink.parameter_list import ASKED_AT_ONCE, ParameterList
from shoal.mavlink.parameters import ParameterClient
from shoal.mavlink.signing import Key

KEY, OTHER = Key(bytes(32), 0), Key(bytes([1]) * 32, 0)


def _value(name: str, value: float, count: int, index: int) -> Any:
    return dialect.MAVLink_param_value_message(name.encode(), value, dialect.MAV_PARAM_TYPE_REAL32, count, index)


def _listed(*indices: int, count: int = 12) -> ParameterList:
    parameters = ParameterList()
    for index in indices:
        parameters.note_value(_value(f"P{index}", 1.0, count, index))
    return parameters


def test_a_list_is_complete_when_each_place_has_come_once() -> None:
    assert not ParameterList().is_complete
    parameters = _listed(*range(11), 3)
    assert (parameters.count, parameters.value_count, parameters.is_complete) == (12, 12, False)
    parameters.note_value(_value("named", 2.0, 12, 12))  # behind the list: an answer by name
    assert not parameters.is_complete and parameters.values["named"] == 2.0
    parameters.note_value(_value("P11", math.nan, 12, 11))
    assert not parameters.is_complete and parameters.value_count == 13
    parameters.note_value(_value("P11", 0.0, 12, 11))
    assert parameters.is_complete and parameters.requests(1, 1) == []


def test_a_request_is_for_all_parameters_or_the_first_few_that_are_missing() -> None:
    (whole,) = ParameterList().requests(3, 1)
    assert whole.get_type() == "PARAM_REQUEST_LIST" and (whole.target_system, whole.target_component) == (3, 1)
    requests = _listed(0, 2).requests(3, 1)
    assert [message.param_index for message in requests] == [1, 3, 4, 5, 6, 7, 8, 9] and len(requests) == ASKED_AT_ONCE
    assert {(m.get_type(), m.target_system, m.target_component) for m in requests} == {("PARAM_REQUEST_READ", 3, 1)}
    assert [message.param_index for message in _listed(*range(11)).requests(3, 1)] == [11]


def _heard(client: ParameterClient, sender: Sender, *messages: Any) -> ParameterClient:
    client.receive(b"".join(map(sender.pack, messages)), 0)
    return client


HEARTBEAT = dialect.MAVLink_heartbeat_message(dialect.MAV_TYPE_SUBMARINE, dialect.MAV_AUTOPILOT_GENERIC, 0, 0, 0, 3)
PILOT = dialect.MAVLink_heartbeat_message(dialect.MAV_TYPE_SUBMARINE, dialect.MAV_AUTOPILOT_PX4, 0, 0, 0, 3)


def test_a_board_answers_values_errors_and_words() -> None:
    client, board = ParameterClient(), Sender((4, 1))
    assert (client.robot_id, client.autopilot, client.has_answered) == (None, None, False)
    _heard(
        client, board, HEARTBEAT, _value("A", 1.0, 2, 0), _value("B", 2.0, 2, 1), dialect.MAVLink_statustext_message(6, b"hi")
    )
    assert (client.robot_id, client.autopilot, client.values, client.value_count) == (4, "", {"A": 1.0, "B": 2.0}, 2)
    assert client.complete and client.last_words == "hi" and client.objection() == client.silence("cut") == ""
    for system, component, error in ((255, 190, ("A", 3)), (254, 190, None), (255, 191, None)):
        client.ask("A")
        _heard(client, board, dialect.MAVLink_param_error_message(system, component, b"A", -1, 3))
        assert client.error == error
    client.ask("A")
    assert client.error is None
    _heard(client, board, dialect.MAVLink_param_error_message(255, 190, b"A", -1, 3))
    client.set("A", 1.0)
    assert client.error is None
    assert "no thruster board" in _heard(ParameterClient(), board, PILOT).objection()


def test_a_request_names_parameter_and_value() -> None:
    client, parser = ParameterClient(7), dialect.MAVLink(None)
    read, written = parser.decode(bytearray(client.ask("A"))), parser.decode(bytearray(client.set("B", 0.5)))
    given = parser.decode(bytearray(client.give(OTHER, 99)))
    assert (read.get_type(), read.param_id, read.param_index, read.target_system) == ("PARAM_REQUEST_READ", "A", -1, 7)
    assert (written.param_id, written.param_value, written.target_system) == ("B", 0.5, 7)
    assert (bytes(given.secret_key), given.initial_timestamp, given.target_component) == (bytes([1]) * 32, 99, 1)
    assert parser.decode(bytearray(client.ask_all())).get_type() == "PARAM_REQUEST_LIST"


@pytest.mark.parametrize(
    ("key", "sender", "says"),
    [
        (None, None, "no board is heard (is it powered?)"),
        (None, Sender((3, 1)), "heard: the board of robot 3, not that of robot 2"),
        (None, Sender((2, 1), OTHER, lambda: 10), "a board is heard that signs (--link-key FILE)"),
        (KEY, Sender((2, 1), OTHER, lambda: 10), "a board is heard that signs with another key"),
        (KEY, Sender((2, 1)), "a board is heard that has no key"),
        (None, Sender((2, 2)), "no board is heard"),
    ],
)
def test_the_reason_why_no_board_is_heard(key: Key | None, sender: Sender | None, says: str) -> None:
    client = ParameterClient(2, key)
    if sender is not None:
        _heard(client, sender, HEARTBEAT)
    assert client.silence().startswith(says) and not client.has_answered and client.objection() == client.silence()
    assert client.signed is ("signs" in says)
    assert (client.silence("the cable is cut") == "the cable is cut") is says.startswith("no board")


def test_a_port_that_cannot_be_opened_is_told_with_the_reason(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plain = tmp_path / "plain"
    plain.touch()
    monkeypatch.setattr(board_address, "PORTS_BY_ID", tmp_path / "by-id")
    assert "not there; is the board plugged in, and powered?" in serial_trouble(tmp_path / "none")
    assert serial_trouble(plain) == f"{plain}: is no serial port"
    assert serial_trouble(Path("/dev/null")) == ""
    monkeypatch.setattr("os.access", lambda *_: False)
    assert "no permission" in serial_trouble(Path("/dev/null"))
    assert missing_port("x", ()).endswith("powered?") and missing_port("x", ("a", "b")).endswith("; there are a, b")


@pytest.mark.parametrize(
    ("device", "present", "doubted"),
    [
        ("/dev/ttyACM0", ("a", "b"), True),
        ("/dev/ttyUSB1", ("a", "b"), True),
        ("/dev/ttyACM0", ("a",), False),
        ("/dev/serial/by-id/a", ("a", "b"), False),
    ],
)
def test_a_port_by_its_number_is_doubted_while_several_are_there(device: str, present: tuple[str, ...], doubted: bool) -> None:
    assert bool(number_in_name(device, present)) is doubted
