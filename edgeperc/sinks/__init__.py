"""Sinks: each writes the answers of a whole run to one file or one receiver, scan after scan.

A sink imports its optional package when it is made, so that a missing extra is reported before the first scan.
"""

from ..records import PerceivedScan, Sink

__all__ = ["PerceivedScan", "Sink"]
