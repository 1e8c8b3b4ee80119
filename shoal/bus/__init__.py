"""The bus: how messages get from process to process.

Bytes travel over Zenoh sessions (zenoh_transport.py) with settings from endpoint.py and network.py; the station is
the router, behind gate.py. bus.py gives bytes their meaning: typed inboxes, commands with a reply, each command once.
"""
