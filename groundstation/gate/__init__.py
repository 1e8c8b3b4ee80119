"""The ways into a station: the public port of a router with keys, and doors for this machine's user.

The gate (gate.py) takes the public port and starts the guard in front of the router (guard.py, by the rules of admission.py).
A terminal of this user asks through own_door.py, a Unix socket in a folder that nobody else may enter (user_folders.py).
"""
