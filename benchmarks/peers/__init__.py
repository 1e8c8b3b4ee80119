"""Scripts that run in environments of their own (benchmarks/harness.py): a JSON task on stdin, JSON rows on stdout."""
