"""What several tests of the exporter take."""

from __future__ import annotations

from pathlib import Path

import pytest

from cli_helpers import Shell


@pytest.fixture
def shell(capsys: pytest.CaptureFixture[str]) -> Shell:
    from edgeperc_export.cli import main

    return Shell(capsys, main)


@pytest.fixture(scope="session")
def kitti(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The root of simulated frames in KITTI's files."""
    from database_helpers import simulated_kitti
    from PIL import Image

    root = simulated_kitti(tmp_path_factory.mktemp("kitti"))
    (root / "training/image_2").mkdir()
    Image.new("RGB", (1242, 375), (90, 120, 160)).save(root / "training/image_2/000000.png")
    return root
