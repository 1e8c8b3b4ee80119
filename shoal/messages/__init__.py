"""The messages between processes, their bytes and their topics.

A frozen dataclass (messages.py) has a protobuf class built from it (schema.py), becomes bytes and back (codec.py); topics.py
says which message travels under which key, how often and how reliably. The log holds the same bytes.
"""
