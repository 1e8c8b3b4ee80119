"""Stamps of cameras with clocks of their own, as one session publishes them."""

import numpy as np
import pytest

from localizer.sources.session_stamps import SessionStamps

S, MS = 1_000_000_000, 1_000_000


def test_stamps_of_clocks_that_agree_stay_as_they_are() -> None:
    stamps = SessionStamps()
    for k in range(100):
        at_ns = k * 50 * MS
        assert stamps.of("west", at_ns + 7, at_ns) == at_ns + 7
        assert stamps.of("east", at_ns + MS, at_ns) == at_ns + MS
    assert stamps.now_ns(5 * S) == 5 * S + 7


@pytest.mark.parametrize("ahead_ns", [-20 * S, -60 * MS, 6 * MS, 2 * S])
def test_the_second_cameras_clock_is_carried_over_to_the_firsts(ahead_ns: int) -> None:
    """Both drift by 100 ppm against ours, in two directions, for ten minutes; east's is set by 5 s half-way."""
    stamps = SessionStamps()
    for k in range(12_000):
        at_ns = k * 50 * MS
        west = stamps.of("west", at_ns + at_ns // 10_000, at_ns)
        east = stamps.of("east", at_ns - at_ns // 10_000 + ahead_ns + 5 * S * (k > 6_000), at_ns)
        assert abs(east - west) <= 5 * MS
        assert abs(stamps.carried("east", at_ns - at_ns // 10_000 + ahead_ns + 5 * S * (k > 6_000)) - west) <= 5 * MS


@pytest.mark.parametrize("ahead_ns", [-20 * S, -30 * MS, 30 * MS, 5 * S])
def test_stamps_go_on_whoever_tells_first_and_whoever_takes_over(ahead_ns: int) -> None:
    """Nothing is seen at first, and said by our own clock; then comes a camera, and later another in its place."""
    stamps = SessionStamps()
    assert stamps.now_ns(S) == S
    for k in range(200):
        at_ns, session = 2 * S + k * 50 * MS, 7 + (k >= 100)
        assert abs(stamps.of("", at_ns + ahead_ns * (session - 6), at_ns, session) - at_ns) <= MS
    assert stamps.now_ns(S) == S


def test_a_camera_whose_clock_is_set_moves_no_stamp() -> None:
    """As another computer takes over: the session goes on by the clock that it had. Pictures come late by up to 10 ms."""
    stamps, random, late_ns = SessionStamps(), np.random.default_rng(1), 10 * MS
    for k in range(400):
        at_ns = k * 50 * MS
        stamp = stamps.of("", at_ns + (S if k < 200 else -30 * S), at_ns + int(random.integers(late_ns)))
        assert abs(stamp - S - at_ns) <= late_ns
        assert abs(stamps.now_ns(at_ns) - S - at_ns) <= late_ns
