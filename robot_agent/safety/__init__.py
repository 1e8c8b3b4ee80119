"""What keeps a robot safe: its mode, its health, and checks of what it senses and does.

Health (health.py) and commands move the mode (modes.py); pulses are checked on their way out (output_check.py); dead thrusters
(thruster_fault_detection.py) and a path that is left (path_deviation.py) are found in flight.
"""
