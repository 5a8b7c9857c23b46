"""Measure edgeperc's latency on this computer (extra ``bench``)."""

from edgeperc.system.extras import without_telemetry

without_telemetry()  # modules of this package import onnxruntime themselves
