"""Simulated training scans of sensors at other heights."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("torch")

from edgeperc.types.mounting import MODEL_HEIGHT_M
from edgeperc_export.data.scans import LabeledScan
from edgeperc_export.data.simulate import simulate


@pytest.mark.parametrize("sensor", ["hdl-64e", "vlp-16"])
def test_scans_at_any_height_stand_on_the_ground_of_the_models(sensor: str, tmp_path: Path) -> None:
    heights = set()
    for indoors in (False, True):
        simulate(tmp_path / str(indoors), 4, sensor=sensor, indoors=indoors, any_height=True)
        for path in sorted((tmp_path / str(indoors)).glob("*.npz")):
            scan = LabeledScan.load(path)
            low = scan.points[(np.hypot(scan.points[:, 0], scan.points[:, 1]) < 25.0) & (scan.labels == 0), 2]
            if not indoors:  # in a hall, walls may hide the floor
                assert np.percentile(low, 5) == pytest.approx(-MODEL_HEIGHT_M, abs=1.0)
            bottoms = [box.center[2] - box.size[2] / 2 for box in scan.boxes if np.hypot(*box.center[:2]) < 12.0]
            if len(bottoms) > 3:  # some stand on a bank
                assert np.median(bottoms) == pytest.approx(-MODEL_HEIGHT_M, abs=0.7)
            heights.add(round(float(low.min(initial=0.0)), 2))
    assert len(heights) > 4
