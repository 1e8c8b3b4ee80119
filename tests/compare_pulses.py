"""Compares the pulses of two runs bit by bit: a change of form must not change what a lockstep flight does.

python -m tests.compare_pulses RUN RUN   # exit code 0: same pulses at same instants, 1: not, 2: nothing to compare
"""

import sys
from pathlib import Path

from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

Pulses = dict[tuple[str, int], tuple[int, ...]]  # of a topic's state at its time (ns): microseconds


def pulses(run: Path) -> Pulses:
    """All pulses that robots sent in a run, read without the project's own reader."""
    pulses_by_instant: Pulses = {}
    with (run / "run.mcap").open("rb") as file:
        for _, channel, message, state in make_reader(file, decoder_factories=[DecoderFactory()]).iter_decoded_messages():
            if channel.topic.startswith("shoal/robot/") and channel.topic.endswith("/state"):
                pulses_by_instant[channel.topic, message.publish_time] = tuple(state.pulse_us)
    return pulses_by_instant


def main(first: str, second: str) -> int:
    """Print where two runs differ first. Returns the exit code."""
    a, b = pulses(Path(first)), pulses(Path(second))
    if not any(any(us != 1500 for us in sent) for sent in a.values()):
        print(f"{first}: no robot pushed")
        return 2
    different = sorted((key for key in a.keys() | b.keys() if a.get(key) != b.get(key)), key=lambda key: key[1])
    for topic, time_ns in different[:1]:
        print(f"{topic} at {time_ns} ns: {a.get((topic, time_ns))} and {b.get((topic, time_ns))} us; {len(different)} in all")
    print(f"{len(a)} and {len(b)} states: {'different' if different else 'the same pulses'}")
    return 1 if different else 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:3]))
