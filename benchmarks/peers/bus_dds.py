"""DDS (Eclipse Cyclone, what many ROS 2 robots run on): best effort, process to process, as text that is only copied."""

import importlib
import json
import os
import subprocess
import sys
from collections.abc import Callable
from typing import Any

from benchmarks.harness import Row, time_us

# Loopback alone, no multicast: a container or a lab network often has none. Sockets large enough for a picture.
os.environ.setdefault(
    "CYCLONEDDS_URI",
    "<CycloneDDS><Domain><General><Interfaces><NetworkInterface name='lo' multicast='false'/></Interfaces>"
    "<AllowMulticast>false</AllowMulticast><MaxMessageSize>65500B</MaxMessageSize></General>"
    "<Discovery><Peers><Peer address='localhost'/></Peers><ParticipantIndex>auto</ParticipantIndex></Discovery>"
    "<Internal><SocketReceiveBufferSize min='default'/></Internal></Domain></CycloneDDS>",
)

# Not in our environment, so neither are its types.
core: Any = importlib.import_module("cyclonedds.core")
domain: Any = importlib.import_module("cyclonedds.domain")
idl: Any = importlib.import_module("cyclonedds.idl")
pub: Any = importlib.import_module("cyclonedds.pub")
sub: Any = importlib.import_module("cyclonedds.sub")
topic: Any = importlib.import_module("cyclonedds.topic")
util: Any = importlib.import_module("cyclonedds.util")

PATIENCE_S = 2


# Text, because the binding packs a sequence of bytes one by one in Python, which would measure nothing but that.
Text = idl.make_idl_struct("Text", "Text", {"data": str})


def _ends(sends: str, receives: str) -> tuple[Callable[[Any], None], Callable[[], Any]]:
    """Send one message; receive one, or None when patience is over."""
    participant = domain.DomainParticipant(7)
    qos = core.Qos(core.Policy.Reliability.BestEffort, core.Policy.History.KeepLast(1))
    writer = pub.DataWriter(participant, topic.Topic(participant, sends, Text), qos)
    reader = sub.DataReader(participant, topic.Topic(participant, receives, Text), qos)
    waits = core.WaitSet(participant)
    waits.attach(core.ReadCondition(reader, core.SampleState.Any | core.ViewState.Any | core.InstanceState.Any))

    def receive() -> Any:
        waits.wait(util.duration(seconds=PATIENCE_S))
        return next(iter(reader.take(1)), None)

    return writer.write, receive


def _echo() -> None:
    send, receive = _ends("pong", "ping")
    while True:
        message = receive()
        if message is not None:
            send(message)


def _measure(task: list[dict[str, Any]]) -> list[Row]:
    rows = []
    child = subprocess.Popen([sys.executable, __file__, "echo"])
    try:
        send, receive = _ends("ping", "pong")
        for item in task:
            message = Text(data="x" * item["bytes"])

            def round_trip(message: Any = message) -> None:
                send(message)
                receive()

            samples = time_us(round_trip, item["n"])
            rows.append(Row.of("bus", f"round trip, {item['case']}", "dds (cyclone), no router", "us", samples))
    finally:
        child.kill()
    return rows


if __name__ == "__main__":
    if len(sys.argv) > 1:
        _echo()
    else:
        print(json.dumps([row.as_dict() for row in _measure(json.load(sys.stdin))]))
