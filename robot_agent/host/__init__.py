"""The robot's computer: its configuration, its service, its real-time settings, its board's parameters.

config.py reads the board file; realtime.py and sd_notify.py talk to Linux and systemd; step_clock.py says when a step is due.
"""
