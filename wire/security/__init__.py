"""Access to the bus: keys, access rules, admission of connections.

A folder of keys (key_ring.py) gives every process a certificate with its role; access_control.py turns roles into the router's
rules; the guard (guard.py, admission.py) stands in front of the router's public port.
"""
