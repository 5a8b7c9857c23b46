"""Train, export, quantize and verify the networks behind edgeperc's models (extra ``export``; needs torch)."""

from edgeperc.system.extras import without_telemetry

without_telemetry()  # modules of this package import onnxruntime themselves
