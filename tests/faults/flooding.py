"""SHELL: a program of the fleet gone wild: 10,000 messages a second on what it may say, which nobody should act on.

python -m tests.faults.flooding STATION SEED ROBOT
"""

import sys
import time

import numpy as np

from shoal.bus.endpoint import Endpoint
from shoal.bus.zenoh_transport import ZenohTransport
from shoal.messages import codec, topics
from tests.shoal.strategies import CLASSES, example

RATE_HZ, BATCH_S = 10_000, 0.01
OVERSIZED = bytes(codec.MAX_MESSAGE_BYTES + 1)


def main() -> None:
    """See the module's docstring."""
    station, seed, robot = sys.argv[1:]
    random = np.random.default_rng(int(seed))
    transport = ZenohTransport(Endpoint(station))
    keys = ((topics.PLAN.key(int(robot)), topics.PLAN), (topics.EVENT.key(), topics.EVENT), ("junk", topics.STATE))
    publish = [transport.publisher(f"shoal/{key}", topic.qos, topic.cache_depth) for key, topic in keys]
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
