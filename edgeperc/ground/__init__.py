"""What a scan shows of the ground: its planes, heights above it, observed cells, the mounting."""
