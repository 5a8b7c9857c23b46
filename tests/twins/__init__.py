"""Slow twins of the kernels in plain Python and numpy, which the tests hold the kernels against."""
