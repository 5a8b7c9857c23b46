"""What a camera model is measured against: a pipeline in numpy, and the small U-Net of a published comparison in torch.

The small U-Net (Jebamikyous, 2021, section 3) is the network that a reader of that comparison would run: a quarter of
U-Net's channels, random weights, at the size of the model's own input. Its labels mean nothing; its time does.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from edgeperc import ImageLabels
from edgeperc.simulation.camera import forward_camera, render
from edgeperc.simulation.samples import FIRST_SEED, simulated_scan
from edgeperc.types.card import CHANNELS, ModelCard
from edgeperc.types.points import Bytes, Floats32
from edgeperc.types.views import CameraGeometry

from ..worker import Prediction
from .engines import Engine

N_IMAGES = 3


def camera_images(view: CameraGeometry, folder: Path) -> tuple[Path, ...]:
    """Write what a camera of a view's size sees of simulated streets: `N_IMAGES` files, .npy, (H, W, 3) uint8."""
    files = []
    for k in range(N_IMAGES):
        scan = simulated_scan(FIRST_SEED + k)
        files.append(folder / f"camera-{view.width}x{view.height}-{k}.npy")
        seen = render(scan.scene, forward_camera(view.width, view.height), scan.T_world_sensor, FIRST_SEED + k)
        np.save(files[-1], seen.rgb)
    return tuple(files)


class NumpyCamera:
    """`edgeperc.Perceiver` of images of the model's own size without edgeperc's stages, by the engine's only output."""

    def __init__(self, card: ModelCard, engine: Engine) -> None:
        self.card, self.engine = card, engine
        order = [CHANNELS["camera"].index(name) for name in card.input.channels]
        self._order = slice(None) if order == sorted(order) else order
        self._mean, self._std = (np.array(v, np.float32)[:, None, None] for v in (card.input.mean, card.input.std))
        self._tables: tuple[Floats32, Floats32] | None = None

    def __call__(self, image: Bytes) -> Prediction:
        """Compute the labels of an image (H, W, 3) uint8."""
        batch = self.engine.input
        np.subtract(image.transpose(2, 0, 1)[self._order], self._mean, out=batch)
        np.divide(batch, self._std, out=batch)
        (logits,) = self.engine.run().values()
        if logits.shape[1:] != image.shape[:2]:
            if self._tables is None:
                down, across = (_table(*n) for n in zip(logits.shape[1:], image.shape[:2], strict=True))
                self._tables = down, np.ascontiguousarray(across.T)
            logits = self._tables[0] @ (logits @ self._tables[1])
        return Prediction(None, None, (), ImageLabels(logits.argmax(axis=0).astype(np.uint8), self.card.classes))


def _table(n_in: int, n_out: int) -> Floats32:
    """Bilinear weights of half-pixel centers along one axis, (n_out, n_in)."""
    places = (np.arange(n_out) + 0.5) * n_in / n_out - 0.5
    return np.stack([np.interp(places, np.arange(n_in), row) for row in np.eye(n_in)], axis=1).astype(np.float32)


def small_unet(card: ModelCard, precision: str, n_threads: int) -> Callable[[Bytes], Any]:
    """The small U-Net in torch (``"bf16"`` by autocast) with a card's input: from an image to meaningless labels."""
    import torch

    from edgeperc_export.networks.unet import UNet

    torch.set_num_threads(n_threads)
    torch.manual_seed(0)
    network = UNet(n_channels=len(card.input.channels), n_classes=len(card.classes), width=16).eval()
    mean, std = (torch.tensor(values)[:, None, None] for values in (card.input.mean, card.input.std))

    def label(image: Bytes) -> Any:
        with torch.inference_mode(), torch.autocast("cpu", torch.bfloat16, enabled=precision == "bf16"):
            x = (torch.from_numpy(image).permute(2, 0, 1).float() - mean) / std
            return network(x[None])[0].argmax(dim=0).byte().numpy()

    return label
