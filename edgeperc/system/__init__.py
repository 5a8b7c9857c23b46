"""The computer below: processor, caches, files written whole, compiled kernels, lanes, clocks."""
