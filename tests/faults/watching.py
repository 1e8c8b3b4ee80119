"""SHELL: an operator's page without a browser: connects, says hello, and takes what comes.

python -m tests.faults.watching HOST:PORT
"""

import json
import sys

from websockets.sync.client import connect
from websockets.typing import Origin


def main() -> None:
    """See the module's docstring."""
    address = sys.argv[1]
    with connect(f"ws://{address}/live", origin=Origin(f"http://{address}"), max_size=None) as socket:
        socket.send(json.dumps({"kind": "hello"}))
        for n, _ in enumerate(socket, start=1):
            socket.send(json.dumps({"kind": "ack", "n": n}))
            if n == 20:
                print("frames come", flush=True)


if __name__ == "__main__":
    main()
