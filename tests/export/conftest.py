"""What several tests of the exporter take."""

from __future__ import annotations

from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def kitti(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The root of simulated frames in KITTI's files."""
    from database_helpers import simulated_kitti

    return simulated_kitti(tmp_path_factory.mktemp("kitti"))
