"""Images, the calibration of a camera, and classes of an image on points and on the top view."""
