"""From a sensor's scan to the scan as the models know it."""
