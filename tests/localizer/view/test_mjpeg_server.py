"""The page of `--show`: real HTTP on this machine, a few viewers, none of whom can hold anything up."""

import http.client
import socket
import threading
from collections.abc import Iterator

import pytest

from localizer.view import local_server
from localizer.view import mjpeg_server as page_module
from localizer.view.local_server import MOST_VIEWERS
from localizer.view.mjpeg_server import MjpegServer
from shoal.errors import ConfigError
from shoal.runtime.runtime import Stop
from tests.waiting import eventually


@pytest.fixture
def page(monkeypatch: pytest.MonkeyPatch) -> Iterator[MjpegServer]:
    monkeypatch.setattr(page_module, "_WAIT_S", 0.05)
    opened = MjpegServer(0, Stop(install=False))
    yield opened
    opened.close()


def port_of(page: MjpegServer) -> int:
    return int(page.address.rstrip("/").rpartition(":")[2])


def ask(page: MjpegServer, path: str, host: str | None = None) -> http.client.HTTPResponse:
    connection = http.client.HTTPConnection("127.0.0.1", port_of(page), timeout=5)
    connection.request("GET", path, headers={} if host is None else {"Host": host})
    return connection.getresponse()


def picture(stream: http.client.HTTPResponse) -> bytes:
    """The next part of the stream."""
    assert stream.readline().strip() == b"--picture"
    headers = {}
    while line := stream.readline().strip():
        name, _, value = line.partition(b": ")
        headers[name] = value
    assert headers[b"Content-Type"] == b"image/jpeg"
    data = stream.read(int(headers[b"Content-Length"]))
    assert stream.readline() == b"\r\n"
    return data


def test_the_page_shows_the_stream_and_asks_nobody_else(page: MjpegServer) -> None:
    answer = ask(page, "/")
    text = answer.read().decode()
    assert answer.status == 200 and 'src="/stream"' in text
    assert "http" not in text, "no request leaves this machine"
    assert ask(page, "/etc/passwd").status == 404


def test_a_viewer_gets_the_newest_picture_and_then_each_new_one(page: MjpegServer) -> None:
    for number in range(100):
        page.show(b"old %d" % number)
    stream = ask(page, "/stream")
    assert picture(stream) == b"old 99"
    page.show(b"new")
    while (shown := picture(stream)) == b"old 99":  # shown again while there is no news
        pass
    assert shown == b"new"


def test_a_viewer_that_does_not_read_holds_nobody_up(page: MjpegServer) -> None:
    """More than all socket buffers hold; the picture after is served to the next viewer at once."""
    page.show(b"first")
    assert picture(ask(page, "/stream")) == b"first"
    ask(page, "/stream")  # and never read
    for _ in range(100):
        page.show(bytes(1_000_000))
    page.show(b"last")
    assert picture(ask(page, "/stream")) == b"last"


def test_a_viewer_that_stops_reading_loses_its_place(page: MjpegServer, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(local_server, "_TAKEN_WITHIN_S", 0.2)
    page.show(bytes(8_000_000))  # more than all socket buffers hold
    stalled = [ask(page, "/stream") for _ in range(MOST_VIEWERS)]
    assert ask(page, "/stream").status == 503
    page.show(b"small")
    assert eventually(lambda: ask(page, "/stream").status == 200)
    assert len(stalled) == MOST_VIEWERS  # and their connections are still open here


def test_there_is_room_for_a_few_and_again_when_one_leaves(page: MjpegServer) -> None:
    page.show(b"x")
    viewers = [ask(page, "/stream") for _ in range(MOST_VIEWERS)]
    assert [v.status for v in viewers] == [200] * MOST_VIEWERS
    assert ask(page, "/stream").status == 503
    viewers[0].close()
    assert eventually(lambda: ask(page, "/stream").status == 200)


def test_another_name_for_this_machine_is_refused(page: MjpegServer) -> None:
    """A foreign web page can have its own name lead here; the browser then sends that name."""
    assert ask(page, "/", host="evil.example:8090").status == 421
    assert ask(page, "/stream", host="evil.example").status == 421
    assert ask(page, "/", host="localhost:1234").status == 200


def test_only_the_one_loopback_address_is_served(page: MjpegServer) -> None:
    """127.0.0.2 leads to this machine too, as its addresses in a network do."""
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(("127.0.0.2", port_of(page)), 5.0)


def test_a_port_in_use_is_explained(page: MjpegServer) -> None:
    port = port_of(page)
    with pytest.raises(ConfigError, match=f"--show-port {port}: in use"):
        MjpegServer(port, Stop(install=False))


def test_closing_ends_the_streams(monkeypatch: pytest.MonkeyPatch) -> None:
    page = MjpegServer(0, Stop(install=False))
    page.show(b"x")
    stream = ask(page, "/stream")
    assert picture(stream) == b"x"
    ender = threading.Timer(0.05, page.close)
    ender.start()
    stream.read()  # to the end, which there would not be
    ender.join()
