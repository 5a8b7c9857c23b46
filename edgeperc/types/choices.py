"""Names that options take, and their defaults. This module imports nothing, so that ``--help`` is fast."""

DEFAULT_MODELS = ("ssadnet", "pointseg", "objects")
OPEN_MODELS = ("ssadnet-open", "sceneseg", "objects-open")
WEIGHTS = {"default": DEFAULT_MODELS, "open": OPEN_MODELS}
SPARSE_MODELS = {"pointseg": "pointseg-sparse"}
"""By a model's name, the one that takes its place for sensors of few beams, or without beams."""
CAMERA = "camseg"
DEFAULT_SENSOR = "hdl-64e"
AUTO_SENSOR = "auto"  # found in the points
PUBLIC_SETS = (
    "av2",
    "ddad",
    "kitti-raw",
    "kitti-tracking",
    "lyft",
    "nuscenes",
    "once",
    "pandaset",
    "semantickitti",
    "vod",
    "waymo",
)
"""Names of `edgeperc.datasets.layout.known_layouts`."""
PRECISIONS = ("fp32", "bf16", "int8")
PLACES = ("street", "hall", "yard")
"""Kinds of places that are simulated."""
RULES = (
    "boxes",
    "ceiling",
    "cells",
    "column",
    "fill",
    "ground",
    "height",
    "person",
    "road",
    "share",
    "stand",
    "support",
)
VEHICLES = ("car", "van", "truck")
"""Classes of vehicles that models tell apart."""
STATIC = ("road", "sidewalk", "terrain", "building", "vegetation", "pole")
"""Classes of points that are no objects, beside the background."""
