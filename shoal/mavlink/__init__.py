"""The link between a robot's computer and its thruster board, both ends.

Bytes of a port (board_port.py) are cut into frames (framing.py), checked and read (frame_codec.py), their signatures verified
(signing.py), and become telemetry (agent_link.py); pulses and arming go the other way. board_link.py is the board's end, used
by the simulator and the probes.
"""
