"""Safety of one robot: its mode, its health, and checks of its sensors and outputs.

Health (health.py) and commands move the mode (modes.py). The board's echo is compared with the pulses sent (output_check.py).
Dead thrusters (thruster_fault_detection.py) and a robot off its path (path_deviation.py) are detected in flight.
thruster_selftest.py pushes each thruster before the flight.
"""
