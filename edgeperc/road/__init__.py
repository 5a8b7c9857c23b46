"""The road for a planner: polygon, free distance, lane, occupancy grid; and what the scans before showed of it."""
