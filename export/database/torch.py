"""A top-view database as a PyTorch data set."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import Dataset

from .files import TopViewDatabase


class TopViewDataset(Dataset[tuple[Tensor, Tensor]]):
    """A `TopViewDatabase`: item k is the image, (3, 400, 200) float32 in 0..1, and the map, (400, 200) int64."""

    def __init__(self, root: Path | str, split: str = "all", fold: int | None = None) -> None:
        self.database = TopViewDatabase(root, split, fold)

    def __len__(self) -> int:
        return len(self.database)

    def __getitem__(self, k: int) -> tuple[Tensor, Tensor]:
        scene = self.database[k]
        image = np.ascontiguousarray(scene.image.transpose(2, 0, 1))
        return torch.from_numpy(image).float() / 255.0, torch.from_numpy(scene.map.astype(np.int64))
