"""The rules in C beside the Python reference: the same random calls, the same outputs after each."""

import ctypes
import math
import random
from collections.abc import Iterable

import numpy as np
import pytest

from shoal.mavlink.agent_link import IGNORED
from shoal.mavlink.parameters import ParameterClient
from shoal.mavlink.signing import Key
from sim_bridge.thruster_board.parameters import FIXED, VOLATILE, Refusal
from sim_bridge.thruster_board.state_machine import BoardStateMachine
from tests.firmware.library import PARAMETERS, FirmwareBoard, core

COMPUTER, KEY = (1, 191), Key(bytes(range(32)))
REFUSALS = [None, Refusal.UNKNOWN, Refusal.RANGE, Refusal.TYPE, Refusal.INCONSISTENT, Refusal.ARMED]
TIE_US = 2e-3  # single precision may round a pulse the other way so near to a half
EDGE_V = 1e-3  # and take a level so near to a threshold
HIL = [row for row in FIXED if row.name in VOLATILE]
CALLS = 40
SEQUENCES = 300


@pytest.fixture(scope="module")
def library() -> ctypes.CDLL:
    return core()


def pulses(draw: random.Random, machine: BoardStateMachine) -> tuple[int, ...]:
    """Pulses within, at and just beyond the limits."""
    (low, high), (ankle_low, ankle_high) = machine.parameters.thruster_us, machine.parameters.ankle_us
    neutral, still = machine.parameters.neutral_us, machine.parameters.dead_zone_us
    if draw.random() < 0.5:
        thrusters = [int(neutral)] * 4
    else:
        thrusters = [int(draw.choice([low, high, neutral, *still, draw.uniform(low, high)])) for _ in range(4)]
    ankles = [int(draw.choice([IGNORED, ankle_low, ankle_high, draw.uniform(ankle_low, ankle_high)])) for _ in range(4)]
    outputs = [*thrusters, *ankles]
    if draw.random() < 0.15:
        at = draw.randrange(8)
        limits = (low, high) if at < 4 else (ankle_low, ankle_high)
        outputs[at] = int(draw.choice([limits[0] - 1, limits[1] + 1, 0, IGNORED, still[0] - 1, still[1] + 1]))
    return tuple(outputs)


def parameter(draw: random.Random) -> tuple[str, float]:
    """A parameter and a value near its bounds, its default or the others' values; sometimes one that does not exist."""
    row = draw.choice(draw.choices([FIXED, HIL, PARAMETERS.table], [13, 4, 3])[0])
    value = draw.choice([
        row.low, row.high, math.nextafter(row.low, -math.inf), row.high + 1, PARAMETERS[row.name], math.nan, math.inf,
        PARAMETERS[row.name] + draw.choice([-1, 1, 0.5, -50, 50]), draw.uniform(row.low, row.high),
        float(draw.randint(int(row.low), int(row.high))),
    ])  # fmt: skip
    return ("NONE" if draw.random() < 0.02 else row.name), ctypes.c_float(value).value


def call(draw: random.Random, machine: BoardStateMachine, board: FirmwareBoard, now_ns: int) -> None:
    """Make one random call of both, and compare what they return."""
    kind = draw.choices(["override", "arm", "disarm", "change", "key", "battery", "step"], [30, 12, 2, 4, 1, 10, 40])[0]
    if kind == "override":
        sender = COMPUTER if draw.random() < 0.95 else draw.choice([(2, 191), (1, 190), (255, 190)])
        outputs = pulses(draw, machine)
        refused = machine.overrides_refused
        machine.override(sender, outputs, now_ns)
        assert board.override(sender, outputs, now_ns) is (machine.overrides_refused == refused)
    elif kind in ("arm", "disarm"):
        assert board.arm(kind == "arm", now_ns) == machine.arm(kind == "arm", now_ns)
    elif kind == "change":
        name, value = parameter(draw)
        refusal = machine.change(name, value)
        assert REFUSALS[board.change(machine.parameters.index.get(name, -1), value)] is refusal, (name, value)
    elif kind == "key":
        assert board.take_key() is (machine.set_key(KEY, 0) == "")
    elif kind == "battery":
        voltage_v, elapsed_s = draw.choice([draw.uniform(8.0, 13.0), 12.0, math.nan, math.inf]), draw.choice([0.0, 0.02, 3.0])
        voltage_v = ctypes.c_float(voltage_v).value
        machine.battery(voltage_v, elapsed_s)
        board.battery(voltage_v, elapsed_s)
    else:
        machine.step(now_ns)
        board.step_rules(now_ns)


def is_near_an_edge(machine: BoardStateMachine) -> bool:
    """True if single precision may come out on the other side."""
    thresholds = [t + h for t in machine.parameters.thresholds_v for h in (0.0, machine.parameters["BAT_HYST_V"])]
    voltage = machine._voltage  # private: the filtered voltage is to be seen nowhere else
    if voltage is not None and any(abs(voltage - threshold) < EDGE_V for threshold in thresholds):
        return True
    unrounded = machine._echo_us[: machine.parameters.thrusters]  # private: messages hold them rounded
    return any(abs(pulse % 1.0 - 0.5) < TIE_US for pulse in unrounded)


def seen(machine: BoardStateMachine) -> tuple[object, ...]:
    texts = [(text.severity, text.text) for text in machine.texts]
    machine.texts.clear()
    return machine.armed, int(machine.charge), machine.overrides_refused, machine.outputs_us, texts


def of_the_firmware(board: FirmwareBoard) -> tuple[object, ...]:
    armed, charge, refused, _ = board.state()
    return armed, charge, refused, board.pulses, board.texts()


def compare(library: ctypes.CDLL, seed: int) -> tuple[int, bool]:
    """One sequence of calls of both. Returns how many were made, and true if the board was armed in it."""
    draw = random.Random(seed)
    machine, board = BoardStateMachine(PARAMETERS, COMPUTER), FirmwareBoard(library)
    now_ns, armed = draw.choice([0, 1000, 2**40 * 1000]), False
    for count in range(CALLS):
        now_ns += draw.choice([0, 1, 1000, 5000, 5000, 20_000, 50_000, 249_999, 250_000, 250_001, 400_000]) * 1000
        call(draw, machine, board, now_ns)
        if is_near_an_edge(machine):
            return count, armed
        assert of_the_firmware(board) == seen(machine), (seed, count)
        armed |= machine.armed
    return CALLS, armed


def test_random_calls_have_the_outputs_of_the_reference(library: ctypes.CDLL) -> None:
    counts, armed = zip(*(compare(library, seed) for seed in range(SEQUENCES)), strict=True)
    assert sum(counts) > 0.9 * CALLS * SEQUENCES  # few ended at an edge
    assert sum(armed) > 0.1 * SEQUENCES  # and many sequences got somewhere


def test_of_more_texts_than_find_room_the_newest_are_kept(library: ctypes.CDLL) -> None:
    board, client = FirmwareBoard(library, KEY), ParameterClient(1, KEY, lambda: 1000)
    for _ in range(5):
        board.arm(True, 0)
    board.override(COMPUTER, (1500,) * 8, 0)
    board.arm(True, 0)
    board.arm(False, 0)
    board.arm(True, 0)
    texts = [text for _, text in board.texts()]
    assert texts == ["not armed: no override is arriving"] * 3 + ["armed", "disarmed", "armed"]
    assert board.state()[:3] == (True, 0, 0) and [board.value(name) for name in PARAMETERS.index] == list(PARAMETERS.values)
    assert board.receive(client.ask("SLEW_US_S"), 10**9)  # the link's state, behind the texts, is as it was
    client.receive(board.step(10**9), 10**9)
    assert client.values["SLEW_US_S"] == PARAMETERS["SLEW_US_S"]


def test_the_first_step_moves_nothing_as_no_time_has_passed(library: ctypes.CDLL) -> None:
    board = FirmwareBoard(library)
    board.override(COMPUTER, (1500,) * 8, 10**9)
    assert board.arm(True, 10**9) == 0
    board.override(COMPUTER, (1900,) * 8, 10**9)
    board.step_rules(10**9)
    assert board.pulses[:4] == (1500,) * 4
    board.step_rules(10**9 + 5_000_000)
    assert board.pulses[:4] != (1500,) * 4


def test_a_voltage_at_a_level_is_not_below_it(library: ctypes.CDLL) -> None:
    machine, board = BoardStateMachine(PARAMETERS, COMPUTER), FirmwareBoard(library)
    for name, value in (("BAT_NEUTRAL_V", 8.0), ("BAT_NOARM_V", 9.0), ("BAT_WARN_V", 10.0), ("BAT_HYST_V", 0.5)):
        assert board.change(PARAMETERS.index[name], value) == 0  # exact in single precision
        assert machine.change(name, value) is None
    for voltage_v, charge in ((10.0, 0), (9.75, 1), (10.25, 1), (10.5, 0), (9.0, 1), (8.75, 2), (9.5, 1)):
        for taken in (board.battery, machine.battery):
            taken(voltage_v, 1000.0)  # the filter has forgotten all before
        assert board.state()[1] == charge == machine.charge, voltage_v


@pytest.mark.parametrize(("trim", "limits"), [(-20.0, ("THR_MIN_US", "ANK_MIN_US")), (20.0, ("THR_MAX_US", "ANK_MAX_US"))])
def test_a_trim_takes_no_pin_beyond_its_limits(library: ctypes.CDLL, trim: float, limits: tuple[str, str]) -> None:
    board, now_ns = FirmwareBoard(library), 10**9
    for name in ("THR1_TRIM_US", "ANK1_TRIM_US"):
        assert board.change(PARAMETERS.index[name], trim) == 0
    board.override(COMPUTER, (1500,) * 8, now_ns)
    board.step_rules(now_ns)
    assert board.arm(True, now_ns) == 0
    thruster_us, ankle_us = (round(PARAMETERS[name]) for name in limits)
    board.override(COMPUTER, (thruster_us,) * 4 + (ankle_us,) * 4, now_ns)
    for _ in range(40):
        now_ns += 5_000_000
        board.step_rules(now_ns)
    assert board.armed and board.pulses == (thruster_us,) * 4 + (ankle_us,) * 4


PUSHING = {  # changes that are taken, and the one after them that would have a disarmed board push
    "fewer thrusters than the vehicle's": [("THR_COUNT", 3.0)],
    "neutral ahead": [("THR_NEUTRAL_US", 1890.0)],
    "a trim": [("THR1_TRIM_US", 100.0)],
    "a curve that does not push back": [*((f"CRV{i:02}_N", 0.0) for i in (5, 4, 3, 2, 1))],
    "a curve that does not push ahead": [*((f"CRV{i:02}_N", 0.0) for i in (8, 9, 10, 11, 12))],
    "neutral in the dead zone of another curve": [("CRV05_N", 0.0), ("THR_NEUTRAL_US", 1460.0)],
    "a trim in the dead zone of another curve": [("CRV05_N", 0.0), ("THR2_TRIM_US", -40.0)],
    "neutral outside, each trim inside": [*((f"THR{i}_TRIM_US", 20.0) for i in (1, 2, 3, 4)), ("THR_NEUTRAL_US", 1460.0)],
    "neutral outside by the vehicle's curve": [
        ("CRV05_N", 0.0), *((f"THR{i}_TRIM_US", 20.0) for i in (1, 2, 3, 4)), ("THR_NEUTRAL_US", 1460.0),
    ],
    "a curve from beyond neutral on": [("CRV06_N", -0.1)],
    "no battery levels": [("BAT_NOARM_V", 0.0)],
    "a trim beyond the dead zone": [("THR1_TRIM_US", 20.0), ("THR_NEUTRAL_US", 1510.0)],
    "two points of one pulse": [("CRV02_US", 1100.0)],
    "nothing below neutral": [("THR_MIN_US", 1500.0)],
    "nothing above neutral": [("THR_MAX_US", 1500.0)],
    "two levels of one voltage": [("BAT_NOARM_V", PARAMETERS["BAT_WARN_V"])],
    "two other levels of one voltage": [("BAT_NEUTRAL_V", PARAMETERS["BAT_NOARM_V"])],
    "no range of the ankles": [("ANK_MIN_US", PARAMETERS["ANK_MAX_US"])],
}  # fmt: skip


@pytest.mark.parametrize("changes", PUSHING.values(), ids=PUSHING)
def test_a_change_that_could_have_a_disarmed_board_push_is_refused(
    library: ctypes.CDLL, changes: list[tuple[str, float]]
) -> None:
    board, parameters = FirmwareBoard(library), PARAMETERS
    for at, (name, value) in enumerate(changes, start=1):
        refusal = REFUSALS[board.change(PARAMETERS.index[name], value)]
        changed = parameters.changed(name, value)
        assert refusal is (changed if isinstance(changed, Refusal) else None)
        assert (refusal is None) is (at < len(changes)), name
        parameters = parameters if isinstance(changed, Refusal) else changed
    assert board.pulses[:4] == tuple(round(1500 + trim) for trim in parameters.trims_us[:4])


def test_a_curve_that_pushes_a_little_both_ways_is_taken(library: ctypes.CDLL) -> None:
    board = FirmwareBoard(library)
    points = sorted(name for name in PARAMETERS.index if name.startswith("CRV") and name.endswith("_N"))
    for name in (*points[: len(points) // 2 + 1][::-1], *points[len(points) // 2 :]):  # from the dead zone outwards
        value = min(max(PARAMETERS[name], -0.25), 0.25)
        board.change(PARAMETERS.index[name], value)
    assert board.value(points[0]) == -0.25 and board.value(points[-1]) == 0.25


def thrust_n(curve: Iterable[tuple[float, float]], pulse_us: int) -> float:
    """The thrust of a pulse by a curve."""
    pulses_us, thrusts_n = zip(*curve, strict=True)
    return float(np.interp(pulse_us, pulses_us, thrusts_n))


def neutral_parameter(draw: random.Random) -> tuple[str, float]:
    """A parameter that has a part in what is neutral, and a value that moves the dead zone or leaves it."""
    middle = len(PARAMETERS.curve) // 2
    point = draw.randint(middle - 2, middle + 3)  # of the curve, from 1 on
    name = draw.choice([f"CRV{point:02}_N", f"CRV{point:02}_N", f"CRV{point:02}_US", "THR_NEUTRAL_US", "THR1_TRIM_US"])
    value = PARAMETERS[name] + draw.randint(-60, 60)
    return name, ctypes.c_float(draw.choice([0.0, -0.1, 0.1]) if name.endswith("_N") else value).value


def test_no_combination_of_parameters_has_a_disarmed_board_push_or_an_armed_one_leave_its_limits(library: ctypes.CDLL) -> None:
    draw, taken, armed = random.Random(7), 0, 0
    for sequence in range(300):
        machine, board, now_ns = BoardStateMachine(PARAMETERS, COMPUTER), FirmwareBoard(library), 10**9
        for _ in range(40):
            name, value = draw.choice([neutral_parameter, neutral_parameter, parameter])(draw)
            changed = board.change(PARAMETERS.index.get(name, -1), value) == 0
            assert changed is (machine.change(name, value) is None), (sequence, name, value)
            taken += changed
        board.step_rules(now_ns)
        curve = [(board.value(f"CRV{i:02}_US"), board.value(f"CRV{i:02}_N")) for i in range(1, len(PARAMETERS.curve) + 1)]
        for pulse_us in board.pulses[:4]:
            assert thrust_n(curve, pulse_us) == thrust_n(PARAMETERS.curve, pulse_us) == 0.0, (sequence, pulse_us)
        neutral_us = round(board.value("THR_NEUTRAL_US"))
        board.override(COMPUTER, (neutral_us,) * 4 + (IGNORED,) * 4, now_ns)
        armed += board.arm(True, now_ns) == 0
        for end in ("MIN", "MAX"):
            thruster_us, ankle_us = (round(board.value(f"{kind}_{end}_US")) for kind in ("THR", "ANK"))
            board.override(COMPUTER, (thruster_us,) * 4 + (ankle_us,) * 4, now_ns)
            for _ in range(4):
                now_ns += 20_000_000
                board.step_rules(now_ns)
                for kind, pulses_us in (("THR", board.pulses[:4]), ("ANK", board.pulses[4:])):
                    low_us, high_us = (board.value(f"{kind}_{end}_US") for end in ("MIN", "MAX"))
                    assert all(low_us <= pulse_us <= high_us for pulse_us in pulses_us), sequence
    assert taken > 1000 and armed > 50


@pytest.mark.slow
def test_many_random_calls_have_the_outputs_of_the_reference(library: ctypes.CDLL) -> None:
    for seed in range(100_000):
        compare(library, seed)
