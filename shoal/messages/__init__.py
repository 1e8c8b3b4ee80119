"""The messages between processes, their bytes and their topics.

A frozen dataclass (messages.py) becomes protobuf bytes and back (codec.py, fleet.proto); topics.py says which message travels
under which key, how often and how reliably. The log holds the same bytes; log_records.py and pipe.py read and carry them.
"""
