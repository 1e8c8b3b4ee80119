"""Clocks, waiting and lockstep, on the in-memory bus."""

import io
import logging
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from shoal.bus.bus import Bus
from shoal.bus.memory_transport import MemoryHub, MemoryTransport
from shoal.messages import topics
from shoal.messages.messages import CameraHealth, Event, LocalizerStatus, Obstacles, Pose, StationHeartbeat, Tick
from shoal.runtime.runtime import Failed, Stop, WallClock, age_s, guarded_thread, log, log_handler, log_to_bus, run_app, wait
from sim_bridge.lockstep.clock import Lockstep, LockstepClock


def two_buses() -> tuple[Bus, Bus]:
    hub = MemoryHub()
    return Bus(MemoryTransport(hub)), Bus(MemoryTransport(hub))


def test_an_age_counts_from_the_content_not_from_the_arrival_and_ignores_the_senders_clock() -> None:
    sender, receiver = two_buses()
    inbox = receiver.inbox(topics.HEARTBEAT, StationHeartbeat)
    clock = WallClock()
    hour_ns = 3_600_000_000_000
    before_ns = clock.now_ns()
    sender.publish(topics.HEARTBEAT, StationHeartbeat(), before_ns + hour_ns, age_ns=80_000_000)
    received = inbox.newest()
    assert received is not None
    elapsed_s = (clock.now_ns() - before_ns) * 1e-9
    assert 0.08 <= age_s(clock, received) <= 0.08 + elapsed_s + 1e-3
    instant_ns = clock.instant_ns(received)
    assert clock.instant_ns(received) == instant_ns  # the same message was true at one instant, whenever it is asked


def test_in_lockstep_an_age_is_the_difference_of_stamps() -> None:
    sender, receiver = two_buses()
    inbox = receiver.inbox(topics.HEARTBEAT, StationHeartbeat)
    sender.publish(topics.HEARTBEAT, StationHeartbeat(), 50_000_000)
    received = inbox.newest()
    assert received is not None
    clock = LockstepClock()
    clock.tick_ns = 130_000_000
    assert age_s(clock, received) == pytest.approx(0.08)


@pytest.mark.long
@pytest.mark.parametrize(
    ("signals", "before", "code"),
    [
        (["SIGHUP", "SIGHUP"], "", 0),
        (["SIGTERM", "SIGHUP"], "", 0),
        (["SIGHUP", "SIGTERM", "SIGHUP"], "", 0),
        (["SIGHUP", "SIGTERM", "SIGTERM"], "", 128 + signal.SIGTERM),
        (["SIGHUP"], "signal.signal(signal.SIGHUP, signal.SIG_IGN)", 3),
    ],
    ids=["hung up twice", "and then hung up", "logged out", "and told twice", "nohup"],
)
def test_a_hang_up_is_a_request_to_stop(signals: list[str], before: str, code: int) -> None:
    sent = "".join(f"; os.kill(os.getpid(), signal.{name})" for name in signals)
    script = f"import os, signal, sys; {before}\nfrom shoal.runtime.runtime import Stop\nstop = Stop(){sent}\n"
    done = subprocess.run([sys.executable, "-c", f"{script}sys.exit(0 if stop() else 3)"], check=False)
    assert done.returncode == code


@pytest.mark.long
@pytest.mark.parametrize("ends", ["stop.request()", "stop.fail('the disk has gone')"])
@pytest.mark.parametrize(("name", "count", "code"), [("SIGINT", 1, 5), ("SIGTERM", 1, 5), ("SIGTERM", 2, 143)])
def test_the_first_signal_does_not_cut_short_a_process_that_ends_by_itself(
    ends: str, name: str, count: int, code: int
) -> None:
    """It writes its files to their end, and tells why it ends."""
    kills = f"os.kill(os.getpid(), signal.{name}); " * count
    script = f"import os, signal, sys\nfrom shoal.runtime.runtime import Stop\nstop = Stop(); {ends}; {kills}sys.exit(5)"
    assert subprocess.run([sys.executable, "-c", script], check=False, capture_output=True).returncode == code


@pytest.mark.long
@pytest.mark.parametrize("name", ["SIGTERM", "SIGHUP"])
def test_a_signal_goes_through_what_must_be_done_at_the_end(name: str) -> None:
    script = f"""import os, signal
from shoal.runtime.runtime import signals_raise
with signals_raise():
    try:
        os.kill(os.getpid(), signal.{name})
    finally:
        os.kill(os.getpid(), signal.SIGHUP)
        print("disarmed")
"""
    done = subprocess.run([sys.executable, "-c", script], check=False, capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (128 + getattr(signal, name), "disarmed\n")


def test_waiting_ends_on_arrival_on_time_and_on_stop() -> None:
    sender, receiver = two_buses()
    inbox = receiver.inbox(topics.HEARTBEAT, StationHeartbeat)
    stop = Stop(install=False)
    threading.Timer(0.05, lambda: sender.publish(topics.HEARTBEAT, StationHeartbeat(), 1)).start()
    assert wait(receiver, stop, lambda: inbox.newest_header() is not None, 5.0)
    assert not wait(receiver, stop, lambda: False, 0.02)
    assert any(waited_until_stopped_s(receiver) < 0.6 for _ in range(5))  # the first of them, unless the machine is busy


def waited_until_stopped_s(bus: Bus) -> float:
    """Time for which a process that is told to stop after 0.05 s goes on waiting for a message."""
    stop, began_s = Stop(install=False), time.monotonic()
    threading.Timer(0.05, stop.request).start()
    assert not wait(bus, stop, lambda: False, 60.0)
    return time.monotonic() - began_s


def test_lockstep_gives_each_tick_once_and_does_something_meanwhile() -> None:
    simulator, process = two_buses()
    clock, stop = LockstepClock(), Stop(install=False)
    lockstep = Lockstep(process, stop, clock)
    ticks_ns: list[int] = []

    def meanwhile() -> None:
        ticks_ns.append(clock.tick_ns)
        if len(ticks_ns) == 2:
            simulator.publish(topics.TICK, Tick(30, -1, 0), 30)

    tick = lockstep.next(meanwhile)
    assert tick is not None
    assert (tick.now_ns, clock.now_ns(), len(ticks_ns)) == (30, 30, 2)
    simulator.publish(topics.TICK, Tick(80, 30, 50), 80)
    tick = lockstep.next()
    assert tick is not None
    assert (tick.now_ns, tick.previous_ns) == (80, 30)
    threading.Timer(0.05, stop.request).start()
    assert lockstep.next() is None  # no tick comes twice


def test_lockstep_waits_for_every_input_and_goes_on_without_none(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    simulator, process = two_buses()
    inbox = process.inbox(topics.HEARTBEAT, StationHeartbeat)
    tidings, stop = process.inbox(topics.LOCALIZER, LocalizerStatus), Stop(install=False)
    lockstep = Lockstep(process, stop, LockstepClock())
    assert lockstep.await_all([(inbox, -1)])  # before the first step there was none to wait for
    threading.Timer(0.05, lambda: simulator.publish(topics.HEARTBEAT, StationHeartbeat(), 100)).start()
    assert lockstep.await_all([(inbox, 100)])
    assert inbox.newest() is not None
    monkeypatch.setattr("sim_bridge.lockstep.clock.LOCKSTEP_SAYS_S", 0.02)
    threading.Timer(0.1, stop.request).start()
    assert not lockstep.await_all([(inbox, 100), (tidings, 102)])
    assert "waiting for localizer/status" in caplog.text and "station/heartbeat" not in caplog.text


def test_await_sight_returns_when_status_poses_and_obstacles_have_come_in_any_order() -> None:
    """The status of a picture says whose poses to wait for, and which obstacles, told at the picture before."""
    simulator, process = two_buses()
    localizer, obstacles = process.inbox(topics.LOCALIZER, LocalizerStatus), process.inbox(topics.OBSTACLES, Obstacles)
    poses = {robot: process.inbox(topics.POSE, Pose, robot) for robot in (1, 2)}
    lockstep = Lockstep(process, Stop(install=False), LockstepClock())
    came: list[int | None] = []
    sight = threading.Thread(target=lambda: came.append(lockstep.await_sight(Tick(80, 30, 50), localizer, poses, obstacles)))
    sight.start()
    for topic, message, stamp_ns, robot in (
        (topics.POSE, Pose(0.0, 0.0, 0.0), 50, 1),
        (topics.LOCALIZER, LocalizerStatus(CameraHealth.OK, robots=(1,), obstacles_ns=40), 50, None),
        (topics.OBSTACLES, Obstacles(), 40, None),
    ):
        time.sleep(0.02)
        assert not came
        simulator.publish(topic, message, stamp_ns, robot)
    sight.join(10.0)
    assert came == [40]  # robot 2 was not seen: nobody waits for its pose


def test_a_tick_that_cannot_be_read_does_not_repeat_the_step_before(caplog: pytest.LogCaptureFixture) -> None:
    simulator, process = two_buses()
    stop = Stop(install=False)
    lockstep = Lockstep(process, stop, LockstepClock())
    simulator.publish(topics.TICK, Tick(50, 0, -1), 50)
    first = lockstep.next()
    assert first is not None and first.now_ns == 50
    simulator.forward(topics.TICK, b"\xff", 100)
    assert lockstep.next(meanwhile=stop.request) is None
    assert caplog.text.count("lockstep: a tick is no new one") == 1


def test_the_logs_lines_travel_as_events_until_the_bus_is_closed_debug_ones_do_not() -> None:
    sender, receiver = two_buses()
    inbox = receiver.inbox(topics.EVENT, Event)
    before = (list(log.handlers), log.level, log.propagate)
    try:
        log.setLevel(logging.DEBUG)
        log.handlers.clear()
        log.propagate = False  # pytest's own handlers, of which another test may have left one, end at what the last line does
        log_to_bus(sender, LockstepClock(), "tester")
        log.warning("water in %s", "the boat")
        log.debug("a detail")
        log.warning("%d robots", "no number")  # logging says on stderr what is wrong with it, and nothing ends
        sender.close()
        log.warning("said after the end")
    finally:
        log.handlers[:], log.level, log.propagate = before
    received = inbox.newest()
    assert received is not None
    assert (received.message.level, received.message.source, received.message.message) == (3, "tester", "water in the boat")


@pytest.mark.parametrize("error", [ValueError("no picture"), SystemExit(0), KeyboardInterrupt()])
def test_a_thread_that_ends_by_an_exception_stops_the_process_with_the_reason(error: BaseException) -> None:
    stop = Stop(install=False)

    def work() -> None:
        raise error

    thread = guarded_thread(stop, "camera", work)
    thread.start()
    thread.join()
    assert stop.requested
    with pytest.raises(Failed, match=f"thread camera ended: {type(error).__name__}"):
        stop.raise_failure()


def test_a_guarded_thread_that_ends_normally_does_not_stop_the_process() -> None:
    stop = Stop(install=False)
    thread = guarded_thread(stop, "camera", lambda: None)
    thread.start()
    thread.join()
    assert not stop.requested
    stop.raise_failure()


def test_the_first_failure_counts_and_a_plain_stop_is_none() -> None:
    stop = Stop(install=False)
    stop.request()
    stop.raise_failure()
    stop.fail("the camera is gone")
    stop.fail("so is the film")
    assert stop.failure == "the camera is gone"


def test_a_process_that_failed_says_why_and_exits_with_1(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(log, "handlers", [logging.NullHandler()])  # not what another test's command line left

    def app() -> None:
        stop = Stop(install=False)
        stop.fail("the camera is gone")
        stop.raise_failure()

    with pytest.raises(SystemExit) as ended:
        run_app(app)
    assert ended.value.code == 1
    assert capsys.readouterr().err == "the camera is gone\n"


def test_a_text_of_others_in_the_log_is_one_line_and_does_not_act_on_the_terminal() -> None:
    out = io.StringIO()
    handler = log_handler("tester", out)
    record = logging.LogRecord(
        "shoal", logging.INFO, "", 0, "remark: %s", ("a\x1b[2J\r\n12:00:00 fake ERROR b\x9b1m \u202ec \ud800 \u00e4",), None
    )
    handler.handle(record)
    (line,) = out.getvalue().splitlines()
    assert line.endswith("tester INFO remark: a\\x1b[2J\\r\\n12:00:00 fake ERROR b\\x9b1m \\u202ec \\ud800 \u00e4")


def test_a_traceback_in_the_log_keeps_its_lines() -> None:
    out = io.StringIO()
    try:
        raise ValueError("bad \x1b[2J")
    except ValueError:
        record = logging.LogRecord("shoal", logging.ERROR, "", 0, "broken", (), sys.exc_info())
    log_handler("tester", out).handle(record)
    first, *_, last = out.getvalue().splitlines()
    assert first.endswith("tester ERROR broken") and last == "ValueError: bad \\x1b[2J"


@pytest.mark.long
def test_a_full_disk_is_a_line_and_no_traceback(tmp_path: Path) -> None:
    """A write that finds no room raises without the file's name."""
    script = (
        "import resource, sys\nfrom shoal.runtime.runtime import run_app\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (10, 10))\n"
        "def app():\n    with open(sys.argv[1], 'w') as file:\n        file.write('x' * 100)\nrun_app(app)"
    )
    words = [sys.executable, "-c", script, str(tmp_path / "file")]
    done = subprocess.run(words, stderr=subprocess.PIPE, text=True, check=False)
    assert (done.returncode, done.stderr) == (2, "a file that was being written: File too large\n")
