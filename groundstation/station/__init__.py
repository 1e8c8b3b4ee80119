"""The station's process: one cycle a control period, between bus, mission, page and log.

Messages are in inboxes; station.py hands them to the mission, sends what it wants, and publishes the heartbeat; process.py
starts and ends it all; discovery.py lets a terminal find the stations of this machine.
"""
