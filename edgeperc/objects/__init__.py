"""From labeled points to objects."""
