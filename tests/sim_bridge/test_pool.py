"""The pool on the wires, by the wall clock: what comes of every exposure."""

from sim_bridge.pool import Pool
from sim_bridge.ports import free_base_port
from sim_bridge.sockets import Sockets
from wire import topics
from wire.bus import Bus
from wire.codec import Header
from wire.experiment import load_experiment
from wire.runtime import Stop
from wire.topics import Topic
from wire.transport import MemoryHub, MemoryTransport

ROBOT = "robots=[{id=1, node_m=[0.0, 0.0, 0.0], start=[0.4, 0.0, 0.3, 0.0]}]"
EXPOSURES = 8


def test_of_every_exposure_there_is_a_pose_however_old_poses_are() -> None:
    """Four periods of the camera old, and told when they are as old as that."""
    experiment = load_experiment("pool", ["sim.latency_s=0.2", ROBOT])
    hub, stop = MemoryHub(), Stop(install=False)
    exposed: list[int] = []
    told: list[Header] = []

    def count(topic: Topic, key: str, header: Header, payload: bytes) -> None:
        exposed.append(header.stamp_ns)
        if len(exposed) == EXPOSURES:
            stop.request()

    witness = Bus(MemoryTransport(hub))
    witness.subscribe(topics.TRUTH, None, count)
    witness.subscribe(topics.POSE, 1, lambda topic, key, header, payload: told.append(header))
    sockets = Sockets(free_base_port((1,)), (1,), experiment.seed)
    Pool(experiment, Bus(MemoryTransport(hub)), sockets, stop, lockstep=False, poses=True).run()
    assert [header.stamp_ns for header in told] == exposed
    assert min(header.age_ns for header in told) >= 200_000_000
