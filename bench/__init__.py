"""Measure edgeperc's latency on the hardware at hand."""
