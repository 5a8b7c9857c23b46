"""Kernels that were compiled when this package was built."""
