"""What edgeperc is measured beside: other engines, numpy, and the limits of the machine."""
