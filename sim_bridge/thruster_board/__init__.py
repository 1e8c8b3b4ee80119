"""The simulated thruster board: a real MAVLink end with the rules that a firmware has to keep.

Bytes come in (board.py); state_machine.py has arming, watchdog and pulses; parameters.py and nonvolatile.py the parameters
and their memory; telemetry goes out.
"""
