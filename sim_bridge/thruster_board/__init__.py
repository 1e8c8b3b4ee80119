"""The simulated thruster board: a real MAVLink end with the rules a firmware has to keep.

Bytes in; arming, watchdog and pulses by state_machine.py; parameters and their memory; sensor telemetry out (board.py).
"""
