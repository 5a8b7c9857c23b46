"""Accuracy of models and of the tracker, measured as in the papers. Not part of the runtime.

`evaluate` runs models over labeled datasets: `datasets` reads scans and labels of KITTI, `scan_folder` those of any
sensor, `splits` lists the drives for training, validation and testing, `truth` prepares the ground truth of a scan,
`judge` compares one perception with it, and `tables` computes the figures of all scans, with intervals. `metrics`
counts labels and matches boxes. `unseen` raises an error for scans that a model was trained on, and `mistakes`
describes the errors of a scan for a picture. `camvid` evaluates camera models on labeled images. `transfer` evaluates a
model on other sensors. `tracking` evaluates the tracker on KITTI's sequences, by `tracking_metrics`. `consistency`
needs no labels.
"""
