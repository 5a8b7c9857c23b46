"""What the stages speak about: points, sensors, mountings, views, cards, boxes and the answer to a scan."""
