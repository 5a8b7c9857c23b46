"""The road for a planner: polygon, free distance, lane, occupancy grid."""
