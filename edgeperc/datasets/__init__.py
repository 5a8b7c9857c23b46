"""Labeled scans and images of others, as files lie on disk."""
