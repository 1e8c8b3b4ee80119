"""The robot itself: its dynamics, its state observer, its thrusters and its battery.

Poses and board telemetry go into the observer (eso.py), which uses the dynamics (dynamics.py); a wrench becomes pulses in
allocation.py. battery.py says whether the charge allows arming and flying.
"""
