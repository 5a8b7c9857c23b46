"""From a scan through a network to classes and boxes."""
