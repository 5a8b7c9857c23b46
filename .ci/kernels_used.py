"""What users do, so that `.ci/kernels` knows which kernels Python calls and for which types."""

from __future__ import annotations

import itertools
import tempfile

import numpy as np

import edgeperc
from edgeperc.cli import main
from edgeperc.inference.decode import decode_classes
from edgeperc.inference.pillars import Pillarizer
from edgeperc.readers.livox_packets import NEW_KINDS, LivoxStream, Points
from edgeperc.readers.ouster_packets import OusterStream, layout_of
from edgeperc.readers.pcd import fill_unpacked_lzf
from edgeperc.readers.spinning_packets import FORMATS, Angles, SpinningStream
from edgeperc.simulation.samples import simulated_scan
from edgeperc.types.card import InputSpec
from edgeperc.types.detector import PillarGeometry

SET_UPS = (
    *({}, {"full_turn": True}, {"models": "lodnn"}, {"models": "sceneseg"}),
    *({"boxes_from": "clusters"}, {"agree": False, "precision": "fp32"}),
)


def decode_packets() -> None:
    """A packet of each kind of sensor, without a return."""
    metadata = {"beam_altitude_angles": [1.0, 0.0], "beam_azimuth_angles": [0.0, 0.0], "lidar_mode": "512x10"}
    layout = layout_of(metadata)
    ouster, hesai, livox = OusterStream(layout, None), FORMATS["pandarxt-16"], LivoxStream()
    list(ouster.add(bytes(layout.packet_bytes))) + list(ouster.end())
    spinning = SpinningStream(hesai, Angles(np.zeros((16, 2))))
    list(spinning.add(memoryview(bytes(hesai.sizes[0])))) + list(spinning.end())
    list(livox.add(Points(0.0, 0.0, NEW_KINDS[1], bytes(14)))) + list(livox.end())


def see_images() -> None:
    """Label an image, paint a scan and the road by it, as `--camera` and programs do."""
    points = simulated_scan(1, "hdl-64e").points
    seen = edgeperc.Perceiver("camseg")(image=np.zeros((90, 160, 3), np.uint8))
    K = [[100.0, 0.0, 80.0], [0.0, 100.0, 45.0], [0.0, 0.0, 1.0]]
    T = [[0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
    calibration = edgeperc.Calibration(np.array(K), np.array(T), 160, 90)
    edgeperc.paint(seen, points, calibration, sensor="hdl-64e")
    edgeperc.camera_road(seen, points, calibration, sensor="hdl-64e")
    calibration.project(points)


def move_and_read() -> None:
    """Undo motion, watch a zone, read a compressed cloud, and take scores of classes from logits."""
    points = simulated_scan(1).points
    edgeperc.deskew(points, np.zeros(len(points)), edgeperc.Motion((1.0, 0.0, 0.0), (0.0, 0.0, 0.0)))
    edgeperc.Zone([(0.0, 0.0), (1.0, 0.0), (0.0, 1.0)]).mark(points)
    fill_unpacked_lzf(np.frombuffer(bytes(2), np.uint8), np.empty(1, np.uint8))
    decode_classes(np.zeros((2, 4, 4), np.float32), "class_logits")


def run() -> None:
    """Perceive, track and map simulated scans in every usual set-up, run the demo, find a sensor and its place."""
    with tempfile.TemporaryDirectory() as folder:
        main(["demo", "--out", folder])
    decode_packets()
    see_images()
    move_and_read()
    edgeperc.find_origin(simulated_scan(1, "hdl-64e").points[:, :3] + [0.0, 5e6, 0.0])
    view = PillarGeometry((0.0, 64.0), (-32.0, 32.0), (-3.0, 1.0), 0.5, 8, 100, 0.0, 0.0, "num_points", "coors")
    Pillarizer(view, InputSpec("voxels", ("x", "range"), (0.0, 0.0), (1.0, 1.0))).fill(simulated_scan(1).points)
    with tempfile.TemporaryDirectory() as folder:  # a sensor that is found
        simulated_scan(1, "hdl-64e").points.tofile(f"{folder}/scan.bin")
        main(["run", f"{folder}/scan.bin"])
    for name, set_up in itertools.product(("hdl-64e", "vlp-16"), SET_UPS):
        perceive, tracker = edgeperc.Perceiver(sensor=name, on_mismatch="ignore", **set_up), edgeperc.Tracker()
        rolling, online, sweeps = edgeperc.RollingGrid(), [], edgeperc.Sweeps()
        scans = [simulated_scan(seed, name).points for seed in (1, 2)]
        for k, points in enumerate((*scans, *scans, np.zeros((0, 4), np.float32))):
            given = points * np.float32([1, 1, 1, 255]) if name == "vlp-16" else points
            earlier = sweeps.earlier(given, 0.1 * k, np.eye(4))
            perception = perceive(given, stamp_s=0.1 * k, earlier=earlier)
            online.append(tracker.update(perception.boxes, 0.1 * k))
            sweeps.add(given, perception, online[-1])
            edgeperc.occupancy_grid(perception, given, sensor=name)
            rolling.update(perception, given, np.eye(4), sensor=name)
            if perception.top_view is not None:
                edgeperc.road_ahead(perception.top_view, perception.boxes)
        edgeperc.smooth_tracks(online)
