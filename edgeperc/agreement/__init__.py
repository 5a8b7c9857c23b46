"""Labels, boxes and cells correct one another."""
