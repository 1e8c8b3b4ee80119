"""Boards in HIL mode fly in step with the water, and with every process for real on a pseudo-terminal and on UDP."""

from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path
from socket import SOCK_DGRAM
from subprocess import Popen

import numpy as np
import pytest

from shoal.config.experiment import NO_CAMERA, Experiment, dump_experiment, load_experiment
from shoal.mavlink.parameters import ParameterClient
from sim_bridge.node.hil_board import HilBoard
from sim_bridge.sil.commands import Program, RunOptions, programs
from sim_bridge.sil.ports import free_base_port, free_port
from sim_bridge.sil.processes import Children
from sim_bridge.thruster_board.board import ThrusterBoard
from tests.closed_loop.dry_pool import DryPool, MakeBoard
from tests.closed_loop.reported import assert_passed
from tests.firmware.library import built
from tests.firmware.mega import Mega
from tests.firmware.plugged_mega import plugged_mega
from tests.sim_bridge.boards import board
from tests.waiting import wait_for_line

Plug = Callable[[str, Path, int], AbstractContextManager["Popen[str]"]]

STILL = np.zeros(4)
STEP_NS = 5_000_000
STEP_CYCLES = 80_000


class HilDesk:
    """The link to a board on a desk, in HIL mode and at rest, which makes a step of 5 ms each time that it is read."""

    trouble = advice = ""
    first_word_s = 0.0

    def __init__(self, robot: int, board: ThrusterBoard) -> None:
        self.board, self._now_ns = board, 0
        board.receive(ParameterClient(robot).set("HIL_MODE", 1.0), 0)
        self.pins: set[tuple[int, ...]] = set()

    def send(self, data: bytes) -> None:
        self.board.receive(data, self._now_ns)

    def read(self) -> bytes:
        self._now_ns += STEP_NS
        data = self.board.step(self._now_ns, STILL, STILL, STILL)
        self.pins.add(self.board.pulses)
        return data

    def wait(self, timeout_s: float) -> None: ...
    def close(self) -> None: ...


class MegaDesk:
    """The link to an Arduino Mega in simavr, in HIL mode and at rest, which runs for 5 ms each time that it is read."""

    trouble = advice = ""
    first_word_s = 0.0

    def __init__(self, robot: int) -> None:
        build = f"build/robot-{robot}"
        self.mega = Mega(elf=built(f"{build}/board.elf", f"BUILD={build}", f"ROBOT={robot}", compiler="avr-gcc"))
        self._now_ns, self.worst_cycles, self.widths_us = 0, 0, np.empty(0)
        while self._now_ns < 400 * STEP_NS:  # starts, and measures its gyro's bias
            self.read()
        self.send(ParameterClient(robot).set("HIL_MODE", 1.0))
        for _ in range(20):  # a heartbeat of before it may still be on its way
            self.read()

    def send(self, data: bytes) -> None:
        self.mega.receive(data, self._now_ns)

    def read(self) -> bytes:
        self._now_ns += STEP_NS
        data = self.mega.step(self._now_ns)
        self.worst_cycles = max(self.worst_cycles, self.mega.loop_cycles()[0])
        widths_us = [pulse.width_us for channel in self.mega.pulses() for pulse in channel]
        self.widths_us = np.union1d(self.widths_us, widths_us)
        return data

    def wait(self, timeout_s: float) -> None: ...
    def close(self) -> None: ...


def fly_within_limits(make: MakeBoard) -> DryPool:
    """Fly `pool` with these boards in step with the water. Raises AssertionError outside its limits."""
    pool = DryPool(load_experiment("pool", ["duration_s=32"]), make=make)
    pool.take_off()
    pool.run(32.0)
    settled = pool.errors()[400:, :, :3]
    rms_m = np.sqrt(np.mean(settled**2, axis=0))
    print(f"RMS {rms_m.max() * 1e3:.1f} mm, worst {np.abs(settled).max() * 1e3:.1f} mm")
    assert np.all(rms_m < 0.03)
    assert np.all(np.abs(settled) < 0.08)
    return pool


@pytest.mark.long
def test_boards_on_a_desk_fly_the_pool_scene_within_its_limits_and_no_pin_moves() -> None:
    desks: list[HilDesk] = []

    def make(experiment: Experiment, robot: int, seed: int) -> HilBoard:
        desks.append(HilDesk(robot, ThrusterBoard(experiment, robot, seed)))
        return HilBoard(experiment, robot, seed, "the desk", desks[-1], None)

    pool = fly_within_limits(make)
    assert [desk.pins for desk in desks] == [{(1500,) * 8}] * 2
    assert np.ptp(np.array(pool.pulses)[:, :, :4]) > 100, "us: the outputs have moved all the same"


@pytest.mark.slow
def test_arduinos_in_simavr_fly_the_pool_scene_within_its_limits_and_no_pin_moves() -> None:
    desks: list[MegaDesk] = []

    def make(experiment: Experiment, robot: int, seed: int) -> HilBoard:
        desks.append(MegaDesk(robot))
        return HilBoard(experiment, robot, seed, "simavr", desks[-1], None)

    pool = fly_within_limits(make)
    for desk in desks:
        print(f"pins {desk.widths_us.min():.1f} to {desk.widths_us.max():.1f} us, worst loop {desk.worst_cycles} cycles")
        assert np.all(np.abs(desk.widths_us - 1500.0) < 1.0)
        assert desk.worst_cycles < STEP_CYCLES
    assert np.ptp(np.array(pool.pulses)[:, :, :4]) > 100, "us: the outputs have moved all the same"


def in_hil(started: list[Program], boards: dict[int, str]) -> list[Program]:
    """The programs of a run, with `hil` around these boards in the place of `pool`."""
    real = [part for robot, where in boards.items() for part in ("--board", f"{robot}={where}")]
    return [Program(p.name, p.module, ("hil", *p.arguments[1:], *real)) if p.name == "sim-bridge" else p for p in started]


@pytest.mark.slow  # it asks for a processor that is never a tenth of a second late
@pytest.mark.real_time
@pytest.mark.timeout(300)
@pytest.mark.parametrize("plug", [pytest.param(board, id="reference"), pytest.param(plugged_mega, id="simavr")])
def test_a_formation_of_boards_in_hil_mode_flies_within_its_limits_in_real_time(tmp_path: Path, plug: Plug) -> None:
    experiment = load_experiment("pool", ["duration_s=26", NO_CAMERA])
    run, udp = tmp_path / "run", free_port(SOCK_DGRAM)
    run.mkdir()
    (run / "experiment.toml").write_text(dump_experiment(experiment), encoding="utf-8")
    boards = {1: f"serial:{tmp_path}/plug", 2: f"udp:127.0.0.1:{udp}"}
    address = f"tcp/127.0.0.1:{free_port()}"
    started = programs((1, 2), RunOptions(poses=True), run, address, free_base_port((1, 2)))
    children = Children(run / "logs")
    with plug(f"pty:{tmp_path}/plug", tmp_path / "kept", 1), plug(f"udp:127.0.0.1:{udp}", tmp_path / "kept", 2):
        try:
            for program in in_hil(started, boards):
                children.start(program.name, program.module, program.arguments)
                if program.name == "groundstation":
                    wait_for_line(run / "logs" / "groundstation.log", "waiting for the fleet", 120.0)
            assert children.all[0].process.wait(150) == 0, children.all[0].explain()
        finally:
            children.stop()
    assert_passed(run)
