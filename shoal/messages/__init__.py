"""The messages between processes, their bytes and their topics.

A frozen dataclass (messages.py) becomes protobuf bytes and back (codec.py, fleet.proto); topics.py says which message travels
under which key, how often and how reliably. The log holds the same bytes; pipe.py carries them.
"""
