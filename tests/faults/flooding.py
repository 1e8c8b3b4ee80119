"""SHELL: 10,000 messages a second that nobody should act on. `python -m tests.faults.flooding STATION SEED ROBOT...`"""

import sys
import time

import numpy as np

from tests.wire.strategies import CLASSES, example
from wire import codec, topics
from wire.transport import Endpoint, ZenohTransport

RATE_HZ, BATCH_S = 10_000, 0.01
OVERSIZED = bytes(codec.MAX_MESSAGE_BYTES + 1)


def main() -> None:
    """See the module's docstring."""
    station, seed, *robots = sys.argv[1:]
    random = np.random.default_rng(int(seed))
    transport = ZenohTransport(Endpoint(station))
    flooded = (topics.POSE, topics.HEARTBEAT, topics.PLAN, topics.STATE, topics.OBSTACLES, topics.FRAME, topics.EVENT)
    keys = [(topic, robot) for topic in flooded for robot in (map(int, robots) if "{robot}" in topic.name else (None,))]
    publish = [transport.publisher(f"shoal/{topic.key(robot)}", topic.qos) for topic, robot in keys]
    payloads = [codec.encode(example(cls)) for cls in CLASSES]
    due_s = time.monotonic()
    while True:
        for _ in range(round(RATE_HZ * BATCH_S)):
            payload = bytearray(payloads[int(random.integers(len(payloads)))])
            payload[int(random.integers(len(payload)))] ^= 1 << int(random.integers(8))
            header = random.bytes(28 if random.random() < 0.5 else int(random.integers(40)))
            publish[int(random.integers(len(publish)))](bytes(payload), header)
        if random.random() < BATCH_S:  # once a second
            publish[int(random.integers(len(publish)))](OVERSIZED, random.bytes(28))
        due_s += BATCH_S
        time.sleep(max(due_s - time.monotonic(), 0.0))


if __name__ == "__main__":
    main()
