"""Measure edgeperc's latency on this computer (extra ``bench``)."""
