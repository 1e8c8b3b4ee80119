"""Delayed messages are told from others, whatever the sender's clock shows."""

import time

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from shoal.bus.bus import Bus
from shoal.bus.delay_estimator import WINDOW_NS, WINDOWS, DelayEstimator
from shoal.bus.memory_transport import MemoryHub, MemoryTransport
from shoal.messages import topics
from shoal.messages.codec import Header, encode
from shoal.messages.messages import StationHeartbeat
from shoal.runtime.runtime import WallClock, age_s

MS = 1_000_000
PERIOD_NS = 50 * MS


@given(st.integers(-(10**18), 10**18), st.lists(st.integers(0, 400 * MS), min_size=1, max_size=100))
def test_it_is_the_way_s_length_over_the_shortest(offset_ns: int, way_ns: list[int]) -> None:
    estimator = DelayEstimator()
    for k, way in enumerate(way_ns):
        sent_ns = 10**15 + k * PERIOD_NS
        assert estimator.excess_ns(sent_ns + offset_ns, sent_ns + way) == way - min(way_ns[: k + 1])


def test_a_burst_after_an_outage_is_as_late_as_it_is() -> None:
    estimator = DelayEstimator()
    assert [estimator.excess_ns(k * PERIOD_NS, k * PERIOD_NS + MS) for k in range(20)] == [0] * 20
    back_ns = 40 * PERIOD_NS
    assert [estimator.excess_ns(k * PERIOD_NS, back_ns + MS) for k in range(20, 41)] == [
        back_ns - k * PERIOD_NS for k in range(20, 41)
    ]


@pytest.mark.parametrize("drift", [-1e-4, 1e-4])
def test_clocks_that_drift_apart_make_nothing_late(drift: float) -> None:
    estimator = DelayEstimator()
    late = [estimator.excess_ns(round(k * PERIOD_NS * (1.0 + drift)), k * PERIOD_NS) for k in range(72_000)]  # an hour
    assert max(late) <= WINDOWS * WINDOW_NS * abs(drift) + MS


@pytest.mark.parametrize("drift", [-2e-4, -1e-4, 1e-4, 2e-4])
@pytest.mark.parametrize("offset_ns", [0, 10**15, -(10**15)])
def test_a_drift_is_taken_off_once_it_is_known_and_a_delay_is_not(drift: float, offset_ns: int) -> None:
    """Of the way of each message, alike but for one, within 16 s: without it all would seem up to 3 ms late."""
    estimator = DelayEstimator()
    for k in range(3000):
        way_ns = 30 * MS if k % 500 == 499 else 2 * MS
        late_ns = estimator.excess_ns(round(k * PERIOD_NS * (1.0 + drift)) + offset_ns, k * PERIOD_NS + way_ns)
        if k > 100:
            assert late_ns == pytest.approx(way_ns - 2 * MS, abs=MS / 10), k


@pytest.mark.parametrize("drift", [-1e-4, 1e-4])
def test_clocks_that_drift_apart_while_nothing_comes_make_nothing_late(drift: float) -> None:
    """A robot that was out of the water for hours, say, and is seen again by the same localizer."""
    estimator = DelayEstimator()
    arrivals = [*range(0, 15_000 * MS, PERIOD_NS), *range(3 * 3600 * 1000 * MS, 3 * 3600 * 1000 * MS + 15_000 * MS, PERIOD_NS)]
    late = [estimator.excess_ns(round(at_ns * (1.0 + drift)), at_ns) for at_ns in arrivals]
    assert max(late) <= WINDOWS * WINDOW_NS * abs(drift) + MS


@pytest.mark.parametrize("held_up_s", [0.5, 4.9, 5.1, 8.0, 25.0, 600.0])
def test_a_burst_is_late_however_long_it_was_held_up(held_up_s: float) -> None:
    """And what is sent after it is not."""
    estimator = DelayEstimator()
    for k in range(100):
        estimator.excess_ns(k * PERIOD_NS, k * PERIOD_NS + MS)
    held_up, back_ns = round(held_up_s * 1e9) // PERIOD_NS, 100 * PERIOD_NS + round(held_up_s * 1e9)
    for k in range(100, 100 + held_up):
        assert estimator.excess_ns(k * PERIOD_NS, back_ns) == pytest.approx(back_ns - k * PERIOD_NS, abs=2 * MS)
    assert estimator.excess_ns(back_ns, back_ns + MS) == pytest.approx(0, abs=2 * MS)


def test_late_messages_of_a_session_that_has_ended_are_no_restart(monkeypatch: pytest.MonkeyPatch) -> None:
    """A station is started again; its last heartbeat comes late, then twice, among those of the new one."""
    inbox, now_ns = Bus(MemoryTransport(MemoryHub())).inbox(topics.HEARTBEAT, StationHeartbeat), [0]
    monkeypatch.setattr(time, "monotonic_ns", lambda: now_ns[0])
    beat = encode(StationHeartbeat())

    def late_ms(session: int, sequence: int, sent_ms: int, arrived_ms: int) -> float | None:
        now_ns[0], dropped = arrived_ms * MS, inbox.dropped
        inbox.store(Header(session, sequence, sent_ms * MS - session * 3600 * 10**9), beat)
        received = inbox.newest()
        assert received is not None
        return received.late_ns / MS if inbox.dropped == dropped else None

    assert [late_ms(7, k + 1, 50 * k, 50 * k + 1) for k in range(10)] == [0.0] * 10
    assert late_ms(8, 1, 600, 601) == 0.0
    assert late_ms(7, 11, 500, 650) == 149.0
    assert late_ms(8, 2, 650, 661) == 10.0
    assert late_ms(7, 11, 500, 700) is None


def test_a_sender_that_slept_is_late_for_two_windows_at_most() -> None:
    """Its monotonic clock stood still for a minute."""
    estimator = DelayEstimator()
    for k in range(100):
        estimator.excess_ns(k * PERIOD_NS, k * PERIOD_NS)
    minute_ns = 60 * 10**9
    late = [estimator.excess_ns(k * PERIOD_NS, k * PERIOD_NS + minute_ns) for k in range(100, 600)]
    assert late[0] == minute_ns and late[-1] == 0
    assert sum(each > 0 for each in late) * PERIOD_NS <= WINDOWS * WINDOW_NS


def test_a_slower_way_is_the_usual_one_after_a_while() -> None:
    estimator = DelayEstimator()
    random = np.random.default_rng(1)
    for k in range(1000):
        way_ns = (10 if k < 400 else 60) * MS + int(random.integers(MS))
        late_ns = estimator.excess_ns(k * PERIOD_NS, k * PERIOD_NS + way_ns)
        assert late_ns <= 2 * MS or 400 <= k < 400 + WINDOWS * WINDOW_NS / PERIOD_NS + 1


def test_an_inbox_adds_the_delay_of_a_late_message_to_its_age(monkeypatch: pytest.MonkeyPatch) -> None:
    hub, clock = MemoryHub(), WallClock()
    with Bus(MemoryTransport(hub)) as sender, Bus(MemoryTransport(hub)) as receiver:
        inbox, beat = receiver.inbox(topics.HEARTBEAT, StationHeartbeat), StationHeartbeat()
        real_ns, held_ns = time.monotonic_ns, [0]
        monkeypatch.setattr(time, "monotonic_ns", lambda: real_ns() + held_ns[0])
        for held_ns[0], expected_s in ((0, 0.0), (700 * MS, 0.7), (0, 0.0)):
            sender.publish(topics.HEARTBEAT, beat, real_ns())
            received = inbox.newest()
            assert received is not None
            assert received.late_ns * 1e-9 == pytest.approx(expected_s, abs=0.1)
            assert age_s(clock, received) == pytest.approx(expected_s, abs=0.1)
