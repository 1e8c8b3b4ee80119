"""The simulated pool as a process: boards at their ports, camera and truth on the bus.

pool.py steps the world by the clock or in lockstep. board_ports.py holds the boards' ports and the links that faults
disturb. ideal_localizer.py stands for camera and localizer together: true poses with noise, without a picture. bench.py is
a single board by itself.
"""
