"""The robot's computer: its configuration, its service, its real-time settings, its board's parameters.

config.py reads the agent's configuration; realtime.py and sd_notify.py talk to Linux and systemd; step_clock.py computes the
instant of the next step.
"""
