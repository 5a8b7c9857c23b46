"""Fuzzers of edgeperc: ``python -m tests.fuzz KIND --cases N --seed S``; see ``docs/howto/untrusted.md``."""
