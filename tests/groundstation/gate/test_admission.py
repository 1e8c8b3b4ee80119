"""Which connections the guard keeps, passes on and closes: given instants, no sockets."""

import ssl
from collections.abc import Iterator

import pytest

from groundstation.gate import admission, gate, guard
from groundstation.gate.admission import (
    KNOWN,
    NEW,
    Admission,
    NotTls,
    RefusalReason,
    Refusals,
    Tokens,
    asks_for_another_hello,
    hello_is_whole,
    origin_of,
)
from shoal.bus import endpoint


def client_hello(name: str = "station.pool") -> bytes:
    """The first bytes of an OpenSSL client."""
    out = ssl.MemoryBIO()
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    with pytest.raises(ssl.SSLWantReadError):
        context.wrap_bio(ssl.MemoryBIO(), out, server_hostname=name).do_handshake()
    return out.read()


def test_a_hello_is_whole_with_its_last_byte_and_not_before() -> None:
    hello = client_hello()
    assert [size for size in range(len(hello) + 1) if hello_is_whole(hello[:size])] == [len(hello)]
    assert hello_is_whole(hello + b"what follows")


def test_a_hello_may_come_in_several_records() -> None:
    hello = client_hello()
    body = hello[5:]
    parts = [body[:100], body[100:101], body[101:]]
    split = b"".join(hello[:3] + len(part).to_bytes(2) + part for part in parts)
    assert [size for size in range(len(split) + 1) if hello_is_whole(split[:size])] == [len(split)]


@pytest.mark.parametrize(
    "data",
    [
        b"hello",
        b"GET / HTTP/1.1\r\n",
        b"\x16\x02\x00",  # SSL 2
        b"\x16\x03\x01\x00\x00",  # an empty record
        b"\x16\x03\x01\xff\xff",  # longer than a record may be
        b"\x16\x03\x01\x00\x04\x02\x00\x00\x00",  # a ServerHello
        b"\x16\x03\x01\x00\x04\x01\xff\xff\xff",  # a hello of 16 MB
        b"\x15\x03\x01\x00\x02\x01\x00",  # an alert
        b"".join(b"\x16\x03\x01\x00\x01" + bytes([byte]) for byte in b"\x01\x00\x30\x00" + bytes(20)),  # a record a byte
    ],
)
def test_bytes_that_are_no_client_hello_are_refused(data: bytes) -> None:
    with pytest.raises(NotTls):
        hello_is_whole(data)


def test_a_request_for_another_hello_is_recognised() -> None:
    answer = b"\x16\x03\x03\x00\x58\x02\x00\x00\x54\x03\x03" + admission.RETRY + bytes(50)
    assert asks_for_another_hello(answer)
    assert not asks_for_another_hello(answer[:11] + bytes(32) + bytes(50))
    assert not asks_for_another_hello(b"")


@pytest.mark.parametrize(
    ("address", "origin"),
    [
        ("192.168.1.7", "192.168.1.7"),
        ("::ffff:192.168.1.7", "192.168.1.7"),  # a socket of both families
        ("2001:db8:1:2:3:4:5:6", "2001:db8:1:2::/64"),
        ("2001:db8:1:2:ffff::1", "2001:db8:1:2::/64"),  # the same host, perhaps
        ("fe80::1%eth0", "fe80::/64"),
        ("::1", "::/64"),
    ],
)
def test_one_peer_is_one_origin(address: str, origin: str) -> None:
    assert origin_of(address) == origin


class Door:
    """Connections with numbers of their own, and what the admission said of them."""

    def __init__(self, most_links: int = 1000) -> None:
        self.admission = Admission(most_links)
        self.numbers = iter(range(100_000))
        self.closed: list[int] = []

    def come(self, address: str, now_s: float, hello: bool = False) -> int:
        number = next(self.numbers)
        self.closed += self.admission.come(number, address, now_s)
        if hello:
            self.admission.hello(number, now_s)
        return number

    def turns(self, now_s: float) -> list[tuple[int, int]]:
        return list(self.admission.turns(now_s))

    def join(self, address: str, now_s: float) -> int:
        """A member's connection, from its coming to its proof."""
        number = self.come(address, now_s, hello=True)
        assert number in dict(self.turns(now_s))
        self.admission.proven(number, now_s)
        return number


def failures(door: Door, address: str, from_s: float, to_s: float, step_s: float = 0.05) -> Iterator[float]:
    """One failed handshake after another from an address, as many as are let through. Yields when each is passed on."""
    now_s = from_s
    while now_s < to_s:
        door.come(address, now_s, hello=True)
        for number, _ in door.turns(now_s):
            yield now_s
            door.admission.ended(number, True, now_s)
        for number in door.admission.overdue(now_s):
            door.closed.append(number)
        now_s += step_s


def test_only_a_connection_with_a_hello_gets_a_turn() -> None:
    door = Door()
    silent = door.come("10.0.0.1", 0.0)
    member = door.come("10.0.0.1", 0.0, hello=True)
    assert door.turns(0.0) == [(member, NEW)]
    assert door.admission.overdue(admission.HELLO_S - 0.01) == ()
    assert door.admission.next_s(0.0) == admission.HELLO_S
    assert set(door.admission.overdue(admission.HELLO_S)) == {silent}


def test_failed_handshakes_of_one_origin_are_rationed() -> None:
    seconds = 60.0
    passed = list(failures(Door(), "10.0.0.1", 0.0, seconds))
    assert admission.ORIGIN_BURST <= len(passed) <= admission.ORIGIN_BURST + seconds * admission.ORIGIN_PER_S + 1


def test_failed_handshakes_of_all_new_origins_together_are_rationed() -> None:
    door, seconds, passed = Door(), 20.0, 0
    for step in range(int(seconds / 0.05)):
        now_s = step * 0.05
        for host in range(10):
            door.come(f"10.0.0.{host}", now_s, hello=True)
        for number, _ in door.turns(now_s):
            passed += 1
            door.admission.ended(number, True, now_s)
        door.admission.overdue(now_s)
    assert admission.LANE_BURST <= passed <= admission.LANE_BURST + seconds * admission.LANE_PER_S + 1


def test_a_member_is_not_rationed() -> None:
    door = Door()
    for _ in range(200):
        door.join("10.0.0.1", 1.0)


def test_a_new_origin_does_not_wait_for_the_crowd_of_another() -> None:
    door = Door()
    list(failures(door, "10.0.0.1", 0.0, 10.0))
    for _ in range(50):
        door.come("10.0.0.1", 10.0, hello=True)
    member = door.come("10.0.0.2", 10.0, hello=True)
    assert member in dict(door.turns(10.0))


def test_a_known_origin_has_a_lane_of_its_own_which_the_failures_of_others_leave_alone() -> None:
    door = Door()
    door.join("10.0.0.99", 0.0)
    for step in range(200):
        for host in range(20):
            door.come(f"10.0.0.{host}", step * 0.05, hello=True)
        for number, lane in door.turns(step * 0.05):
            assert lane == NEW
            door.admission.ended(number, True, step * 0.05)
    member = door.come("10.0.0.99", 10.0, hello=True)
    assert (member, KNOWN) in door.turns(10.0)


def test_turns_go_round_the_origins() -> None:
    door = Door()
    many = {door.come("10.0.0.1", 100.0, hello=True): "many" for _ in range(20)}
    few = {door.come("10.0.0.2", 100.0, hello=True): "few" for _ in range(2)}
    order = [{**many, **few}[number] for number, _ in door.turns(100.0)]
    assert order[:4] == ["many", "few", "many", "few"]


def test_an_origin_that_is_crowded_loses_its_oldest_silent_connection() -> None:
    door = Door()
    ready = door.come("10.0.0.1", 0.0, hello=True)
    silent = [door.come("10.0.0.1", 0.0) for _ in range(admission.MOST_WAITING_EACH)]
    assert door.closed == silent[:1]
    member = door.come("10.0.0.1", 1.0)  # a member's hello comes before so many others have
    door.admission.hello(member, 1.0)
    assert door.closed == silent[:2] and {ready, member} <= set(dict(door.turns(1.0)))


def test_when_all_places_are_taken_the_origin_with_most_connections_loses_one() -> None:
    door = Door()
    hosts = admission.MOST_WAITING // admission.MOST_WAITING_EACH
    for _ in range(admission.MOST_WAITING_EACH):
        for host in range(hosts):
            door.come(f"10.0.0.{host}", 0.0)
    assert door.closed == []
    member = door.come("10.0.0.99", 0.0)
    assert len(door.closed) == 1 and member not in door.closed


def test_a_handshake_that_proves_nothing_is_ended_and_counts_as_failed() -> None:
    door = Door()
    number = door.come("10.0.0.1", 0.0, hello=True)
    door.turns(0.0)
    assert door.admission.overdue(admission.PROOF_S - 0.01) == ()
    assert door.admission.overdue(admission.PROOF_S) == (number,)
    assert door.admission.ended(number, False, admission.PROOF_S)
    member = door.join("10.0.0.1", 5.0)
    assert door.admission.overdue(1e6) == ()
    assert not door.admission.ended(member, True, 1e6)


def test_handshakes_at_a_time_are_limited_and_the_next_gets_the_turn_of_one_that_ends() -> None:
    door = Door()
    waiting = [door.come("10.0.0.1", 0.0, hello=True) for _ in range(20)]
    first = [number for number, _ in door.turns(0.0)]
    assert first == waiting[: admission.MOST_TRYING_EACH]
    door.admission.proven(first[0], 0.1)
    assert [number for number, _ in door.turns(0.1)] == [waiting[admission.MOST_TRYING_EACH]]


def test_a_proof_that_the_router_takes_back_counts_as_failed() -> None:
    door, closed = Door(), 0
    for step in range(400):
        now_s = step * 0.05
        number = door.come("10.0.0.1", now_s, hello=True)
        if number in dict(door.turns(now_s)):
            door.admission.proven(number, now_s)
            closed += door.admission.ended(number, True, now_s)
        door.admission.overdue(now_s)
    assert closed <= 2 * admission.ORIGIN_BURST + 20.0 * admission.ORIGIN_PER_S + 1
    assert not door.admission.ended(door.join("10.0.0.2", 100.0), False, 100.1)  # a terminal's order is short


def test_links_are_limited() -> None:
    door = Door(most_links=2)
    door.join("10.0.0.1", 0.0)
    member = door.join("10.0.0.2", 0.0)
    waits = door.come("10.0.0.3", 0.0, hello=True)
    assert door.turns(0.0) == []
    door.admission.ended(member, False, 0.5)
    assert door.turns(0.5) == [(waits, NEW)]


def test_a_connection_waiting_for_tokens_is_admitted_when_there_is_one() -> None:
    door = Door()
    list(failures(door, "10.0.0.1", 0.0, 3.0))
    last = door.come("10.0.0.1", 3.0, hello=True)
    due_s = door.admission.next_s(3.0)
    assert 3.0 <= due_s <= 3.0 + 1.0 / admission.ORIGIN_PER_S + 1e-9
    passed = [number for number, _ in door.turns(due_s + 1e-6)]
    assert passed and passed[0] <= last


def test_origins_are_forgotten_in_the_end(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(admission, "MOST_ORIGINS", 10)
    door = Door()
    for host in range(100):
        door.admission.gone(door.come(f"10.0.0.{host}", 0.0))
    # how many origins are remembered is told to nobody
    assert len(door.admission._origins) <= 11


def test_an_origin_that_comes_again_and_again_is_not_forgotten_for_others_that_come_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Forgotten, it would have all its tries anew."""
    monkeypatch.setattr(admission, "MOST_ORIGINS", 3)
    door, tried = Door(), 0
    for host in range(40):
        number = door.come("10.0.0.1", 1.0, hello=True)
        if number in dict(door.turns(1.0)):
            door.admission.ended(number, True, 1.0)
            tried += 1
        else:
            door.admission.gone(number)
        door.admission.gone(door.come(f"10.0.{host + 1}.1", 1.0))
    assert tried == admission.ORIGIN_BURST


UNPROVEN = RefusalReason.NO_CERTIFICATE


def test_an_origin_is_named_once_in_a_while_with_its_count() -> None:
    refusals = Refusals()
    for _ in range(3):
        refusals.note("10.0.0.1", UNPROVEN)
    assert refusals.due_sentences(0.0) == [
        "refused a connection from 10.0.0.1 without a valid certificate (3 of them since last told)"
    ]
    refusals.note("10.0.0.1", UNPROVEN)
    refusals.note("10.0.0.2", UNPROVEN)
    assert refusals.due_sentences(0.1) == ["refused a connection from 10.0.0.2 without a valid certificate"]
    assert refusals.due_sentences(refusals.next_s() - 0.1) == []
    assert refusals.due_sentences(refusals.next_s()) == ["refused a connection from 10.0.0.1 without a valid certificate"]
    assert refusals.next_s() == float("inf")


def test_each_reason_of_an_origin_is_told() -> None:
    """Four of five connections of a member wait for a fifth, which a stranger at the same address has."""
    refusals = Refusals()
    for reason in (UNPROVEN, *[RefusalReason.CROWDED] * 4, RefusalReason.NO_TLS):
        refusals.note("10.0.0.1", reason)
    assert refusals.due_sentences(0.0) == [
        "refused a connection from 10.0.0.1 without a valid certificate",
        "refused a connection from 10.0.0.1 because too many wait, or are open (4 of them since last told)",
        "refused a connection from 10.0.0.1 that does not begin as TLS does",
    ]


def test_of_many_origins_a_few_are_named() -> None:
    refusals = Refusals()
    for host in range(100):
        refusals.note(f"10.0.0.{host}", UNPROVEN)
    assert len(refusals.due_sentences(0.0)) == admission.MOST_NAMED
    assert refusals.due_sentences(1.0) == []


def test_a_member_that_is_not_wanted_is_rationed_like_a_stranger() -> None:
    door = Door()
    door.join("10.0.0.1", 0.0)  # one that is
    expelled = 0
    for step in range(1000):
        now_s = step * 0.01
        door.come("10.0.0.2", now_s, hello=True)
        for number, lane in door.turns(now_s):
            assert lane == NEW  # never that of the members
            door.admission.proven(number, now_s)
            door.admission.expel(number, now_s)
            assert not door.admission.ended(number, False, now_s)  # no failed handshake: the router says whose it was
            expelled += 1
        door.admission.overdue(now_s)
    assert expelled <= admission.ORIGIN_BURST + 10 * admission.ORIGIN_PER_S + 1
    number = door.come("10.0.0.1", 10.0, hello=True)
    assert (number, KNOWN) in door.turns(10.0)


def test_an_origin_stays_known_by_its_other_members_when_one_is_expelled() -> None:
    door = Door()
    door.join("10.0.0.1", 0.0)
    number = door.come("10.0.0.1", 0.1, hello=True)
    assert door.turns(0.1) == [(number, KNOWN)]
    door.admission.expel(number, 0.1)  # before its handshake was seen to succeed
    assert not door.admission.ended(number, False, 0.1)
    assert door.turns(0.2) == []
    other = door.come("10.0.0.1", 0.3, hello=True)
    assert door.turns(0.3) == [(other, KNOWN)]


def test_one_origin_cannot_have_all_links() -> None:
    door, held = Door(2048), list[int]()
    for step in range(admission.MOST_LINKS_EACH + 100):
        number = door.come("10.0.0.1", step * 1.0, hello=True)
        for link, _ in door.turns(step * 1.0):
            door.admission.proven(link, step * 1.0)
            held.append(link)
        door.admission.overdue(step * 1.0)
    assert len(held) == admission.MOST_LINKS_EACH and number not in held
    now_s = (admission.MOST_LINKS_EACH + 100) * 1.0
    door.join("10.0.0.2", now_s)
    door.admission.ended(held[0], False, now_s)
    door.admission.overdue(now_s + admission.TURN_S)  # who waited meanwhile
    door.join("10.0.0.1", now_s + admission.TURN_S)


def test_a_lane_has_so_many_handshakes_under_way_and_no_more() -> None:
    door, tried = Door(), list[int]()
    for step in range(29):  # until the first of them is overdue, in s/10
        for peer in range(3):
            door.come(f"10.0.{step}.{peer}", step / 10, hello=True)
        tried += [number for number, _ in door.turns(step / 10)]
    assert admission.LANE_BURST + 2.8 * admission.LANE_PER_S > admission.MOST_TRYING  # tokens do not limit it
    assert len(tried) == admission.MOST_TRYING


def test_so_many_origins_are_known_and_the_longest_unproven_is_forgotten_first() -> None:
    door = Door()
    addresses = [f"10.{i >> 8}.{i & 255}.1" for i in range(admission.MOST_KNOWN + 1)]

    def lane(address: str, now_s: float) -> int:
        number = door.come(address, now_s, hello=True)
        turn = dict(door.turns(now_s))[number]
        door.admission.proven(number, now_s)
        door.admission.ended(number, False, now_s)
        return turn

    for i, address in enumerate(addresses[:-1]):
        assert lane(address, i) == NEW
    now_s = len(addresses)
    assert lane(addresses[0], now_s) == KNOWN  # all of them are; this one is now the last to go
    assert lane(addresses[-1], now_s) == NEW
    assert [lane(addresses[i], now_s) for i in (0, 2, 1)] == [KNOWN, KNOWN, NEW]


def test_limits_that_depend_on_one_another_fit_together() -> None:
    """They stand in several modules, each with its reason."""
    assert gate.INNER_HANDSHAKE_MS == admission.PROOF_S * 1e3  # the router and the guard give up together
    assert endpoint.ACCEPT_MS < admission.YOUNG_S * 1e3  # or a stranger's session would count as a member's
    assert endpoint.TRY_MS < admission.TURN_S * 1e3  # or a connection would be closed that its client waits for
    assert admission.MOST_LINKS_EACH < guard.MOST_LINKS < endpoint.MOST_SESSIONS  # neither an origin nor all fill the router


# --- limits, at their edges


def _hello_of(whole: int, records: int) -> bytes:
    """A ClientHello of so many bytes, its header included, in so many records."""
    message = b"\x01" + (whole - 4).to_bytes(3) + bytes(whole - 4)
    each = -(-whole // records)
    parts = [message[k : k + each] for k in range(0, whole, each)]
    assert len(parts) == records
    return b"".join(b"\x16\x03\x01" + len(part).to_bytes(2) + part for part in parts)


def test_a_hello_is_as_large_as_it_may_be_and_no_larger() -> None:
    assert hello_is_whole(_hello_of(admission.MOST_HELLO, 1)) and hello_is_whole(_hello_of(4, 1))
    assert hello_is_whole(_hello_of(1600, admission.MOST_RECORDS))
    for data in (_hello_of(admission.MOST_HELLO + 1, 2), _hello_of(1700, admission.MOST_RECORDS + 1)):
        with pytest.raises(NotTls):
            hello_is_whole(data)
    longest = b"\x16\x03\x01" + admission.MOST_HELLO.to_bytes(2)
    assert not hello_is_whole(longest)
    with pytest.raises(NotTls):
        hello_is_whole(longest[:3] + (admission.MOST_HELLO + 1).to_bytes(2))


def test_tokens_come_by_their_rate_up_to_the_burst_and_are_overdrawn_by_as_much() -> None:
    tokens = Tokens(2.0, 0.5)
    assert (tokens.refill(0.0), tokens.next_s(0.0)) == (2.0, 0.0)
    tokens.add(-1.5, 0.0)
    assert (tokens.refill(0.0), tokens.next_s(0.0)) == (0.5, 1.0)
    tokens.add(-9.0, 0.0)
    assert (tokens.refill(0.0), tokens.next_s(0.0)) == (-2.0, 6.0)
    assert (tokens.refill(4.0), tokens.refill(3.0), tokens.next_s(4.0)) == (0.0, 0.0, 6.0)
    tokens.add(1.0, 4.0)
    assert (tokens.refill(4.0), tokens.refill(5.0), tokens.refill(1e6)) == (1.0, 1.5, 2.0)
    tokens.add(5.0, 1e6)
    assert tokens.refill(1e6) == 2.0


def test_the_next_look_is_for_the_first_thing_that_is_due() -> None:
    door = Door()
    assert door.admission.next_s(0.0) == float("inf")
    for _ in range(int(admission.ORIGIN_BURST)):
        number = door.come("10.0.0.1", 0.0, hello=True)
        assert door.turns(0.0) == [(number, NEW)]
        door.admission.ended(number, True, 0.0)
    waits = door.come("10.0.0.1", 0.0, hello=True)
    assert door.turns(0.0) == []
    assert door.admission.next_s(0.0) == pytest.approx(1.0 / admission.ORIGIN_PER_S), "a token"
    silent = door.come("10.0.0.2", 0.1 - admission.HELLO_S)
    assert door.admission.next_s(0.0) == pytest.approx(0.1), "a connection that says nothing"
    door.admission.gone(silent)
    assert door.turns(0.4) == [(waits, NEW)]
    assert door.admission.next_s(0.4) == pytest.approx(0.4 + admission.PROOF_S), "a handshake that does not end"


def test_a_member_is_closed_late_and_a_stranger_soon() -> None:
    door = Door()
    for after_s, failed in ((admission.YOUNG_S - 0.01, True), (admission.YOUNG_S, False)):
        assert door.admission.ended(door.join("10.0.0.1", 100.0), True, 100.0 + after_s) is failed
        assert not door.admission.ended(door.join("10.0.0.1", 100.0), False, 100.0 + after_s)


def test_a_connection_that_waits_is_closed_when_its_time_is_over() -> None:
    door = Door(most_links=0)
    silent, ready = door.come("10.0.0.1", 0.0), door.come("10.0.0.2", 0.5, hello=True)
    assert door.admission.overdue(admission.HELLO_S - 0.01) == ()
    assert door.admission.overdue(admission.HELLO_S) == (silent,)
    assert door.admission.overdue(0.5 + admission.TURN_S - 0.01) == ()
    assert door.admission.overdue(0.5 + admission.TURN_S) == (ready,) and door.admission.overdue(9.0) == ()


def test_refusals_that_were_kept_back_are_told_when_their_time_has_come() -> None:
    refusals = Refusals()
    assert refusals.next_s() == float("inf")
    refusals.note("10.0.0.1", UNPROVEN)
    assert refusals.next_s() == float("-inf") and len(refusals.due_sentences(5.0)) == 1
    refusals.note("10.0.0.1", UNPROVEN)
    assert refusals.next_s() == 5.0 + admission.SAY_AGAIN_S
    assert refusals.due_sentences(5.0 + admission.SAY_AGAIN_S - 0.01) == []
    assert refusals.due_sentences(5.0 + admission.SAY_AGAIN_S) == [
        "refused a connection from 10.0.0.1 without a valid certificate"
    ]
