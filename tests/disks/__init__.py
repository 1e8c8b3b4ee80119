"""Commands on a disk that is full, gone or read-only, and commands that are killed: no file is lost."""
