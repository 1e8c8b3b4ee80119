"""Software and keys onto the robots' computers, over ssh, checked and reversible.

A manifest of what a board should have (manifest.py) and wheels (wheelhouse.py) are sent by ssh.py; certificate_authority.py
and key_ring.py make the fleet's certificates.
"""
