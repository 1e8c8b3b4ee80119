"""ZeroMQ: a pair of sockets over TCP between two processes, bytes that nobody looks at, no router between."""

import importlib
import json
import subprocess
import sys
from typing import Any

from benchmarks.harness import Row, time_us

zmq: Any = importlib.import_module("zmq")  # not in our environment, so neither are its types


def _pair() -> Any:
    link = zmq.Context.instance().socket(zmq.PAIR)
    link.linger = 0
    return link


def _echo(address: str) -> None:
    link = _pair()
    link.connect(address)
    while message := link.recv():  # an empty message is the end
        link.send(message)


def _measure(task: list[dict[str, Any]]) -> list[Row]:
    link, rows = _pair(), []
    port = link.bind_to_random_port("tcp://127.0.0.1")
    child = subprocess.Popen([sys.executable, __file__, f"tcp://127.0.0.1:{port}"])
    try:
        for item in task:
            payload = bytes(item["bytes"])

            def round_trip(payload: bytes = payload) -> None:
                link.send(payload)
                link.recv()

            samples = time_us(round_trip, item["n"])
            rows.append(Row.of("bus", f"round trip, {item['case']}", "zeromq, no router", "us", samples))
        link.send(b"")
        child.wait(5.0)
    finally:
        child.kill()
    return rows


if __name__ == "__main__":
    if len(sys.argv) > 1:
        _echo(sys.argv[1])
    else:
        print(json.dumps([row.as_dict() for row in _measure(json.load(sys.stdin))]))
