"""Train, export, quantize and verify the networks behind edgeperc's models (extra ``export``; needs torch)."""
