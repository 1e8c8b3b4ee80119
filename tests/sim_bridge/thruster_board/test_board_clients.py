"""The simulated board on a link with several askers: parameters, arming by others, signing, and what survives a restart."""

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import common as dialect

from shoal.config.experiment import load_experiment
from shoal.errors import ConfigError
from shoal.mavlink import agent_link
from shoal.mavlink.agent_link import AgentLink
from shoal.mavlink.framing import Sender
from shoal.mavlink.parameters import ParameterClient
from shoal.mavlink.signing import Key
from shoal.mavlink.signing_key import load_key
from sim_bridge.thruster_board.board import NonvolatileState, ThrusterBoard
from sim_bridge.thruster_board.nonvolatile import boards_in

STEP = 5_000_000
POOL = load_experiment("pool")
KEY = Key(hashlib.sha256(b"a link of tests").digest())
NEUTRAL = (1500,) * 8
STILL = np.zeros(4)
STATION = (255, 190)
NOW = 47_338_560_000_000


class ClientBench:
    """A board, the robot's computer, and a ground station that speaks plain pymavlink."""

    def __init__(self, key: Key | None = None, stored: NonvolatileState | None = None, start: int = NOW) -> None:
        self.stored: list[NonvolatileState] = []
        self.board = ThrusterBoard(POOL, 1, 1, key, stored, self.stored.append)
        self.computer = AgentLink(1, key, lambda: start)
        self.station = Sender(STATION, key, lambda: start)
        self.now_ns = 0
        self.sent: list[Any] = []

    def step(self, *frames: bytes, times: int = 1) -> list[Any]:
        """Messages of the board in these steps; the first takes the frames."""
        messages: list[Any] = []
        for i in range(times):
            self.board.receive(b"".join(frames) if i == 0 else b"", self.now_ns)
            data = self.board.step(self.now_ns, STILL, STILL, STILL)
            self.computer.receive(data, self.now_ns)
            messages += dialect.MAVLink(None).parse_buffer(data) or []
            self.now_ns += STEP
        return messages

    def ask(self, message: Any) -> list[Any]:
        kinds = ("PARAM_VALUE", "PARAM_ERROR", "COMMAND_ACK", "STATUSTEXT", "AUTOPILOT_VERSION")
        return [m for m in self.step(self.station.pack(message)) if m.get_type() in kinds]

    def set(self, name: str, value: float, kind: int = dialect.MAV_PARAM_TYPE_REAL32) -> list[Any]:
        return self.ask(dialect.MAVLink_param_set_message(1, 1, name.encode(), value, kind))


def arming(arm: float) -> Any:
    return dialect.MAVLink_command_long_message(1, 1, 400, 0, arm, 0, 0, 0, 0, 0, 0)


# --- others on the link


def test_a_ground_station_arms_only_as_the_rules_allow() -> None:
    bench = ClientBench()
    text, answer = bench.ask(arming(1))
    assert (text.text, answer.result) == ("not armed: no override is arriving", agent_link.REJECTED)
    assert (answer.target_system, answer.target_component) == STATION
    bench.step(bench.computer.pulses(NEUTRAL))
    text, answer = bench.ask(arming(1))
    assert (text.text, answer.result, bench.board.armed) == ("armed", agent_link.ACCEPTED, True)
    assert bench.computer.telemetry.armed
    assert bench.computer.telemetry.acknowledgements == 0  # the answer was not for the computer
    assert bench.ask(arming(0))[-1].result == agent_link.ACCEPTED
    assert not bench.board.armed


def test_overrides_of_a_ground_station_neither_arm_nor_move() -> None:
    bench = ClientBench()
    override = dialect.MAVLink_rc_channels_override_message(1, 1, *NEUTRAL)
    bench.step(bench.station.pack(override))
    assert bench.ask(arming(1))[-1].result == agent_link.REJECTED
    bench.step(bench.computer.pulses(NEUTRAL))
    bench.ask(arming(1))
    bench.step(bench.station.pack(dialect.MAVLink_rc_channels_override_message(1, 1, *(1900,) * 4, *NEUTRAL[4:])), times=20)
    assert bench.board.pulses == NEUTRAL
    for _ in range(40):
        bench.step(bench.station.pack(override))
    assert not bench.board.armed


def test_the_board_says_what_it_is() -> None:
    request = dialect.MAVLink_command_long_message(1, 1, 512, 0, 148, 0, 0, 0, 0, 0, 0)
    answer, version = ClientBench().ask(request)
    assert (answer.command, answer.result) == (512, agent_link.ACCEPTED)
    assert version.capabilities & dialect.MAV_PROTOCOL_CAPABILITY_MAVLINK2
    other = dialect.MAVLink_command_long_message(1, 1, 512, 0, 33, 0, 0, 0, 0, 0, 0)
    assert [m.result for m in ClientBench().ask(other)] == [agent_link.UNSUPPORTED]


def test_timesync_of_a_stranger_does_not_set_the_computers_clock() -> None:
    bench = ClientBench()
    bench.now_ns = 3_600_000_000_000
    bench.step(bench.station.pack(dialect.MAVLink_timesync_message(0, bench.now_ns - 7)))
    assert bench.computer.telemetry.round_trips == 0
    bench.step(bench.computer.timesync(bench.now_ns))
    assert (bench.computer.telemetry.round_trips, bench.computer.telemetry.clock_offset_ns) == (1, 0)


def test_battery_status_says_how_low_it_is() -> None:
    bench = ClientBench()
    (status,) = (m for m in bench.step() if m.get_type() == "BATTERY_STATUS")
    assert status.voltages[0] == pytest.approx(12_400, abs=100)
    assert (status.voltages[1], status.current_battery, status.battery_remaining, status.charge_state) == (65535, -1, -1, 1)
    assert bench.computer.telemetry.charge == 1


# --- parameters


def test_the_list_comes_one_with_each_burst_and_is_complete() -> None:
    bench = ClientBench()
    table, values = bench.board.rules.parameters.table, bench.board.rules.parameters.values
    bench.step()  # the burst of this instant; the next one is 20 ms away
    bench.step(bench.station.pack(dialect.MAVLink_param_request_list_message(1, 1)))
    bursts = [[m for m in bench.step(times=4) if m.get_type() == "PARAM_VALUE"] for _ in table]
    assert all(len(burst) <= 1 for burst in bursts)
    assert {m.param_id: m.param_value for burst in bursts for m in burst} == {
        row.name: value for row, value in zip(table, values, strict=True)
    }
    assert all(m.param_count == len(table) and m.param_type == 9 for burst in bursts for m in burst)
    assert not [m for m in bench.step(times=40) if m.get_type() == "PARAM_VALUE"]


@pytest.mark.parametrize(("name", "index"), [(b"CMD_AGE_MS", -1), (b"", 0), (b"SLEW_US_S", 0)])
def test_one_is_read_by_name_or_by_index(name: bytes, index: int) -> None:
    (value,) = ClientBench().ask(dialect.MAVLink_param_request_read_message(1, 1, name, index))
    assert (value.param_id, value.param_value, value.param_index) == ("CMD_AGE_MS", 250, 0)


@pytest.mark.parametrize(("name", "index"), [(b"NONSENSE", -1), (b"", 1000), (b"CMD_AGE_MS", 32767), (b"\xff\xfe", -1)])
def test_unknown_parameter_cannot_be_read(name: bytes, index: int) -> None:
    error, _ = ClientBench().ask(dialect.MAVLink_param_request_read_message(1, 1, name, index))
    assert (error.get_type(), error.error) == ("PARAM_ERROR", dialect.MAV_PARAM_ERROR_DOES_NOT_EXIST)


def test_setting_is_acknowledged_kept_and_counts() -> None:
    bench = ClientBench()
    (value,) = bench.set("THR_MAX_US", 1700)
    assert (value.param_id, value.param_value) == ("THR_MAX_US", 1700)
    again = ClientBench(stored=bench.stored[-1])
    assert again.board.rules.parameters["THR_MAX_US"] == 1700
    again.step(again.computer.pulses((1701, *NEUTRAL[1:])))
    assert again.board.rules.overrides_refused == 1


@pytest.mark.parametrize(
    ("name", "value", "kind", "error"),
    [
        ("THR_MAX_US", 5000, 9, 2),
        ("THR_MAX_US", float("nan"), 9, 2),
        ("THR_MAX_US", 1700, 6, 2),
        ("BAT_WARN_V", 9.0, 9, 2),
    ],
)
def test_refused_value_is_answered_with_the_old_one_and_the_reason(name: str, value: float, kind: int, error: int) -> None:
    bench = ClientBench()
    before = bench.board.rules.parameters
    answer, refused, text = bench.set(name, value, kind)
    assert (answer.param_id, answer.param_value) == (name, before[name])
    assert (refused.error, refused.target_system, refused.target_component) == (error, *STATION)
    assert text.text.startswith(name)
    assert bench.board.rules.parameters is before


def test_nothing_is_set_while_armed_and_unknown_names_never() -> None:
    bench = ClientBench()
    bench.step(bench.computer.pulses(NEUTRAL), bench.computer.arm(True))
    _, refused, text = bench.set("SLEW_US_S", 500)
    assert (refused.error, text.text) == (dialect.MAV_PARAM_ERROR_PERMISSION_DENIED, "SLEW_US_S: armed")
    assert bench.board.rules.parameters["SLEW_US_S"] == 8000
    error, _ = bench.set("NONSENSE", 500)
    assert error.error == dialect.MAV_PARAM_ERROR_DOES_NOT_EXIST


# --- signing, and restarts


def test_a_signed_board_obeys_its_computer_and_nobody_without_the_key() -> None:
    bench = ClientBench(KEY)
    stranger = AgentLink(1)
    bench.step(stranger.pulses(NEUTRAL), stranger.arm(True))
    assert not bench.board.armed
    assert bench.board.unauthentic_frames == 2
    bench.step(bench.computer.pulses(NEUTRAL), bench.computer.arm(True))
    bench.step(stranger.arm(False), stranger.pulses((1600, *NEUTRAL[1:])), times=4)
    assert bench.board.armed
    assert bench.board.pulses == NEUTRAL
    assert bench.computer.telemetry.armed
    status = [m for m in bench.step(times=200) if m.get_type() == "SYS_STATUS"]
    assert status[-1].errors_count2 == 4


def test_no_order_counts_again_after_the_board_lost_power_at_any_moment() -> None:
    """Everything that was ever sent is sent again to a board that starts with what the first had kept when each came."""
    first = ClientBench(KEY)
    recorded: list[bytes] = []
    moments: list[tuple[int, NonvolatileState]] = []
    for i in range(30):
        frames = [first.computer.pulses(NEUTRAL)]
        if i in (5, 9, 21):
            frames.append(first.computer.arm(True))
        if i in (7, 15):
            frames.append(first.computer.arm(False))
        if i == 18:
            frames.append(first.station.pack(dialect.MAVLink_param_set_message(1, 1, b"SLEW_US_S", 500.0, 9)))
        recorded += frames
        first.step(*frames, times=10)
        if first.stored:
            moments.append((len(recorded), first.stored[-1]))
    assert first.board.rules.parameters["SLEW_US_S"] == 500
    for length, stored in moments:
        board = ThrusterBoard(POOL, 1, 1, KEY, stored)
        for i, frame in enumerate(recorded[:length]):
            board.receive(frame, i * 20 * STEP)
            board.step(i * 20 * STEP, STILL, STILL, STILL)
            assert not board.armed
        assert board.rules.parameters["SLEW_US_S"] == stored.parameters["SLEW_US_S"]


def test_after_a_restart_both_ends_understand_each_other_at_once() -> None:
    first = ClientBench(KEY)
    first.step(first.computer.pulses(NEUTRAL), first.computer.arm(True), times=300)
    second = ClientBench(KEY, first.stored[-1])
    second.computer, second.now_ns = first.computer, first.now_ns + 1_000_000_000  # it ran on
    second.step(second.computer.pulses(NEUTRAL), second.computer.arm(True), times=5)
    assert second.board.armed
    assert second.computer.telemetry.armed
    assert second.computer.telemetry.replayed_frames == 0


def test_memory_is_written_once_a_second_while_signed_frames_come() -> None:
    bench = ClientBench(KEY)
    for _ in range(100):
        bench.step(bench.computer.pulses(NEUTRAL), times=10)
    assert 4 <= len(bench.stored) <= 6  # 5 s
    quiet = len(bench.stored)
    bench.step(times=1000)
    assert len(bench.stored) <= quiet + 1


def test_a_folder_keeps_what_boards_must_not_forget(tmp_path: Path) -> None:
    board = boards_in(tmp_path / "boards")(POOL, 2, 1)
    station = Sender(STATION)
    board.receive(station.pack(dialect.MAVLink_param_set_message(2, 1, b"THR3_TRIM_US", -12.0, 9)), 0)
    assert board.pulses[2] == 1488
    assert boards_in(tmp_path / "boards")(POOL, 2, 1).pulses[2] == 1488
    assert boards_in(tmp_path / "boards")(POOL, 1, 1).pulses[2] == 1500
    content = json.loads((tmp_path / "boards" / "robot-2.json").read_text())
    assert content["parameters"]["THR3_TRIM_US"] == -12.0


@pytest.mark.parametrize(
    "content",
    [
        "",
        "[]",
        "{}",
        '{"parameters": 3, "heard": 0, "sent": 0}',
        '{"parameters": {}, "heard": "x"}',
        '{"parameters": {"THR1_TRIM_US": Infinity}, "heard": 0, "sent": 0}',
    ],
)
def test_a_memory_that_is_none_is_explained(tmp_path: Path, content: str) -> None:
    (tmp_path / "robot-1.json").write_text(content)
    with pytest.raises(ConfigError, match=r"robot-1\.json: not what a board keeps"):
        boards_in(tmp_path)(POOL, 1, 1)


# --- a key that comes over the link


def setup(secret: bytes, newest: int = 5) -> Any:
    return dialect.MAVLink_setup_signing_message(1, 1, list(secret), newest)


def test_a_key_over_the_link_counts_from_the_next_byte_on_and_survives_a_loss_of_power() -> None:
    bench = ClientBench()
    unsigned = AgentLink(1)
    bench.board.receive(bench.station.pack(setup(KEY.secret)) + unsigned.pulses(NEUTRAL) + unsigned.arm(True), 0)
    bench.step()
    assert bench.board.signed and not bench.board.armed
    stored = bench.stored[-1]
    assert stored.key == KEY and stored.heard == 5
    assert KEY.secret.hex() not in repr(stored)
    for board in (bench.board, ThrusterBoard(POOL, 1, 1, stored.key, stored)):
        late, now_ns = AgentLink(1, KEY, lambda: 100), 10 * STEP
        for computer, armed in ((unsigned, False), (AgentLink(1, Key(bytes(range(32)))), False), (late, True)):
            board.receive(computer.pulses(NEUTRAL) + computer.arm(True), now_ns)
            assert board.armed is armed
        late.receive(board.step(now_ns, STILL, STILL, STILL), now_ns)
        assert late.telemetry.armed


@pytest.mark.parametrize("secret", [bytes(32), None], ids=["zeros", "armed"])
def test_a_key_of_zeros_and_a_key_for_an_armed_board_are_refused(secret: bytes | None) -> None:
    bench = ClientBench()
    if secret is None:
        bench.step(bench.computer.pulses(NEUTRAL), bench.computer.arm(True))
        assert bench.board.armed
    bench.step(bench.station.pack(setup(secret or KEY.secret)))
    assert not bench.board.signed


def test_a_signed_board_takes_another_key_only_from_who_has_its_own() -> None:
    bench, other = ClientBench(KEY), Key(bytes(range(32)))
    bench.step(Sender(STATION).pack(setup(other.secret)), Sender(STATION, other, lambda: 1000).pack(setup(other.secret)))
    assert bench.stored == [] or bench.stored[-1].key == KEY
    bench.step(Sender(STATION, KEY, lambda: 1000).pack(setup(other.secret)))
    assert bench.stored[-1].key == other and bench.stored[-1].heard >= 1000


def test_a_folder_keeps_a_key_for_its_owners_eyes_only(tmp_path: Path) -> None:
    board = boards_in(tmp_path)(POOL, 2, 1)
    board.receive(Sender(STATION).pack(dialect.MAVLink_setup_signing_message(2, 1, list(KEY.secret), 5)), 0)
    assert load_key(tmp_path / "robot-2.key").secret == KEY.secret  # which refuses what others can read
    assert KEY.secret.hex() not in (tmp_path / "robot-2.json").read_text()
    assert boards_in(tmp_path)(POOL, 2, 1).signed and not boards_in(tmp_path)(POOL, 1, 1).signed


@pytest.mark.parametrize(
    ("robot", "key", "boards", "says"),
    [
        (None, None, None, ""),
        (1, KEY, KEY, ""),
        (2, None, None, "heard: the board of robot 1, not that of robot 2"),
        (None, None, KEY, "a board is heard that signs (--link-key FILE)"),
        (1, Key(bytes(32)), KEY, "a board is heard that signs with another key"),
        (1, KEY, None, "a board is heard that has no key (over a cable, `robot-agent params give-key FILE` gives it one)"),
    ],
)
def test_client_that_hears_no_board_is_told_the_reason(
    robot: int | None, key: Key | None, boards: Key | None, says: str
) -> None:
    client, bench = ParameterClient(robot, key, lambda: 1000), ClientBench(boards)
    assert (client.has_answered, client.silence()) == (False, "no board is heard (is it powered?)")
    assert client.silence("the cable is out") == "the cable is out"
    for _ in range(4):
        bench.board.receive(client.heartbeat(), bench.now_ns)
        client.receive(bench.board.step(bench.now_ns, STILL, STILL, STILL), bench.now_ns)
        bench.now_ns += 1_000_000_000
    assert (client.has_answered, client.silence("the link's trouble")) == (not says, says)


def test_a_value_that_is_answered_without_its_place_in_the_list_counts() -> None:
    """As ArduPilot's firmware answers a name. Of a list it is no part."""
    client, board = ParameterClient(1), Sender((1, 1))
    client.receive(board.pack(dialect.MAVLink_param_value_message(b"SLEW_US_S", 500.0, 9, 40, 65535)), 0)
    assert (client.values, client.value_count, client.complete) == ({"SLEW_US_S": 500.0}, 1, False)
    client.receive(board.pack(dialect.MAVLink_param_value_message(b"SLEW_US_S", 600.0, 9, 1, 0)), 0)
    client.receive(board.pack(dialect.MAVLink_param_value_message(b"SLEW_US_S", 700.0, 9, 40, 65535)), 0)
    assert (client.values, client.complete) == ({"SLEW_US_S": 700.0}, True)


def test_a_board_whose_memory_is_gone_says_so(tmp_path: Path) -> None:
    folder = tmp_path / "boards"
    board = boards_in(folder)(POOL, 1, 1)
    folder.rmdir()
    station = Sender(STATION)
    with pytest.raises(ConfigError, match=r"boards/robot-1\.json: No such file or directory"):
        board.receive(station.pack(dialect.MAVLink_param_set_message(1, 1, b"SLEW_US_S", 500.0, 9)), 0)
