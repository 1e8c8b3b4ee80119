"""The simulated pool as a process: boards on UDP, camera and truth on the bus.

pool.py steps the world by the clock or in lockstep; udp_ports.py and lossy_link.py are its wires; bench.py is a single board.
"""
