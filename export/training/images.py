"""Images of CamVid as training samples: all of them stay on the device that trains, and are augmented there in batches.

CamVid (Brostow et al., 2008 and 2009) has 367 training and 101 validation images, 360 x 480, of ten minutes of driving.
As 8-bit integers they take 250 MB, so a training step reads no file and waits for no other process.
"""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import ClassVar, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from edgeperc.datasets.images import LabeledImages, image_hash
from edgeperc.errors import ImageError
from edgeperc.evaluation.metrics import Confusion
from edgeperc.simulation.samples import IGNORE
from edgeperc.simulation.street import CAMERA_CLASSES
from edgeperc.types.card import InputSpec
from edgeperc.types.points import Floats, Ints64

from .camera import Camera, on_device, upsampled
from .losses import cross_entropy

# Bounds of the random scale, of the change of the aspect, and of the factors of brightness, contrast and saturation.
SCALES = (0.5, 2.0)
ASPECT = 1.1
JITTER = 0.4
# Another light: logarithms of the colors' gains and of gamma have these standard deviations.
GAIN, GAMMA = 0.12, 0.35
# Another lens and sensor: share of the images that are blurred, and that get noise; standard deviations, in pixels and
# of 255.
FLAWED = 0.3
BLUR, NOISE = (0.4, 1.2), (2.0, 12.0)
BLUR_REACH = 2  # pixels
VALIDATION_BATCH = 8


class ImageSet(NamedTuple):
    """Images and their labels."""

    hashes: dict[str, str]  # name -> `edgeperc.datasets.images.image_hash`
    images: Tensor  # (n, 3, H, W) uint8; red, green, blue
    labels: Tensor  # (n, H, W) uint8; indices into `CAMERA_CLASSES`; `IGNORE` where unlabeled

    def scaled(self, width: int, height: int) -> ImageSet:
        """Images, bilinearly, and labels, of the nearest pixel, at another size."""
        if self.labels.shape[1:] == (height, width):
            return self
        size = (height, width)
        images = [
            F.interpolate(image[None].float(), size, mode="bilinear", antialias=True).round().byte()
            for image in self.images
        ]
        labels = F.interpolate(self.labels[:, None].float(), size, mode="nearest-exact")[:, 0]
        return ImageSet(self.hashes, torch.cat(images), labels.byte())

    def to(self, device: torch.device) -> ImageSet:
        """The same on a device."""
        return ImageSet(self.hashes, self.images.to(device), self.labels.to(device))


@lru_cache(maxsize=2)
def read_camvid(root: Path, split: str) -> ImageSet:
    """Read CamVid's images and labels of a split, once. Raises ImageError, MissingExtraError."""
    data = LabeledImages(root)
    if data.classes != CAMERA_CLASSES:
        raise ImageError(f"{root} has classes {data.classes}; expected {CAMERA_CLASSES}")
    files = data.files(split)
    pairs = [data.read(file) for file in files]
    if len(sizes := {image.shape for image, _ in pairs}) > 1:
        raise ImageError(f"{root} has images of {len(sizes)} sizes; expected one size, to train in batches")
    images = torch.from_numpy(np.stack([image for image, _ in pairs])).permute(0, 3, 1, 2).contiguous()
    labels = torch.from_numpy(np.stack([labels for _, labels in pairs]))
    hashes = {file.stem: image_hash(image) for file, (image, _) in zip(files, pairs, strict=True)}
    return ImageSet(hashes, images, labels)


def normalized(images: Tensor, spec: InputSpec) -> Tensor:
    """Images (B, 3, H, W) in 0..255 as a network's input, float32."""
    mean, std = (on_device(values, images.device)[:, None, None] for values in (spec.mean, spec.std))
    return (images.float() - mean) / std


def augmented_images(images: Tensor, labels: Tensor, rng: np.random.Generator) -> tuple[Tensor, Tensor]:
    """Scale, crop, mirror, recolor and disturb each image of a batch (B, 3, H, W) with its labels at random, on its
    device; what lies outside an image scaled down is gray and `IGNORE`.
    """
    n = len(images)
    smallest, largest = np.log(SCALES)
    scale = np.exp(rng.uniform(smallest, largest, n))
    aspect = np.exp(rng.uniform(-np.log(ASPECT), np.log(ASPECT), n))
    theta = np.zeros((n, 2, 3), np.float32)
    for axis, zoom in enumerate((scale * aspect, scale / aspect)):
        # In units where the image spans -1..1: the visible window spans 2 / zoom, around a random center.
        theta[:, axis, axis] = 1.0 / zoom
        theta[:, axis, 2] = rng.uniform(-1.0, 1.0, n) * np.abs(1.0 - 1.0 / zoom)
    theta[:, 0, 0] *= rng.choice([-1.0, 1.0], n)
    grid = F.affine_grid(
        torch.from_numpy(theta).to(images.device, non_blocking=True), list(images.shape), align_corners=False
    )
    gray = 127.5
    pixels = F.grid_sample(images.float() - gray, grid, mode="bilinear", padding_mode="zeros", align_corners=False)
    # Outside the image, labels are 0, which no labeled pixel is after adding 1.
    moved = F.grid_sample(labels[:, None].float() + 1.0, grid, mode="nearest", align_corners=False)[:, 0]
    labels = torch.where(moved == 0.0, float(IGNORE), moved - 1.0).byte()

    factors = torch.from_numpy(rng.uniform(1.0 - JITTER, 1.0 + JITTER, (3, n, 1, 1, 1)).astype(np.float32))
    brightness, contrast, saturation = factors.to(images.device, non_blocking=True)
    pixels = (pixels + gray) * brightness
    mean = pixels.mean((1, 2, 3), keepdim=True)
    pixels = mean + (pixels - mean) * contrast
    luma = pixels.mean(1, keepdim=True)
    return _in_other_light((luma + (pixels - luma) * saturation).clamp(0.0, 255.0), rng), labels


def _in_other_light(images: Tensor, rng: np.random.Generator) -> Tensor:
    """Images in 0..255 in another light, some blurred and noisy. With the smaller scales, the mean IoU of a network of
    one sequence rises on another at dusk from 31.9 to 42.4 %, and goes from 35.7 to 34.5 % on a third by day.
    """
    n, device = len(images), images.device

    def drawn(values: Floats, *shape: int) -> Tensor:
        return torch.from_numpy(values.astype(np.float32)).view(n, *shape).to(device, non_blocking=True)

    gain, gamma = np.exp(rng.normal(0.0, GAIN, (n, 3))), np.exp(rng.normal(0.0, GAMMA, n))
    lit = (images * drawn(gain, 3, 1, 1)).clamp(0.0, 255.0).div(255.0).pow(drawn(gamma, 1, 1, 1)).mul(255.0)
    sharp, clean = rng.random((2, n)) >= FLAWED
    blur = np.where(sharp, 1e-3, rng.uniform(*BLUR, n))
    weights = np.exp(-0.5 * (np.arange(-BLUR_REACH, BLUR_REACH + 1) / blur[:, None]) ** 2)
    weights = (weights / weights.sum(1, keepdims=True)).repeat(3, axis=0)
    taps = torch.from_numpy(weights.astype(np.float32)).to(device, non_blocking=True)
    flat = F.pad(lit.flatten(0, 1)[None], (BLUR_REACH,) * 4, mode="replicate")
    flat = F.conv2d(F.conv2d(flat, taps[:, None, None], groups=3 * n), taps[:, None, :, None], groups=3 * n)
    generator = torch.Generator(device).manual_seed(int(rng.integers(2**62)))
    noise = torch.randn(images.shape, generator=generator, device=device)
    noise *= drawn(np.where(clean, 0.0, rng.uniform(*NOISE, n)), 1, 1, 1)
    return (flat.view_as(images) + noise).clamp(0.0, 255.0)


class ImageSamples:
    """Batches of images on the training device, of the size of the task's view, each drawn once in an epoch."""

    n_targets = 1
    simulated: ClassVar[tuple[()]] = ()

    def __init__(self, task: Camera, images: ImageSet) -> None:
        self.task, self.recipe, self.images = task, task.recipe, images
        self.odds: dict[str, Floats] = {}

    def batch(self, step: int) -> tuple[Tensor, Tensor]:
        """Inputs (B, 3, H, W) float32 and labels (B, H, W) uint8 of one step, always the same for the same step."""
        seed, batch, n = self.recipe.seed, self.recipe.batch, len(self.images.hashes)
        at = np.arange(step * batch, (step + 1) * batch)
        orders = {epoch: np.random.default_rng((seed, 2, epoch)).permutation(n) for epoch in {*(at // n).tolist()}}
        chosen = torch.from_numpy(np.array([orders[k // n][k % n] for k in at.tolist()]))
        chosen = chosen.to(self.images.images.device, non_blocking=True)
        images, labels = self.images.images[chosen], self.images.labels[chosen]
        if self.recipe.augment:
            images, labels = augmented_images(images, labels, np.random.default_rng((seed, 3, step)))
        return normalized(images, self.task.input), labels


@torch.no_grad()
def confusions(network: nn.Module, images: ImageSet, truth: Tensor, spec: InputSpec) -> tuple[Ints64, float, Tensor]:
    """Confusion (n, C, C) of each image at the truth's size, mean cross-entropy, and the labels on the device."""
    counts, losses, predicted = [], [], []
    for first in range(0, len(images.hashes), VALIDATION_BATCH):
        x = normalized(images.images[first : first + VALIDATION_BATCH], spec)
        right = truth[first : first + VALIDATION_BATCH]
        logits = upsampled(network(x.contiguous(memory_format=torch.channels_last)), right.shape[1:])
        losses += [cross_entropy(one[None], its[None]) for one, its in zip(logits, right, strict=True)]
        labels = logits.argmax(1)
        predicted.append(labels.byte())
        n, n_classes = len(right), logits.shape[1]
        image = torch.arange(n, device=right.device)[:, None, None]
        # Unlabeled pixels are counted in a row of their own, which is dropped.
        row = torch.where(right == IGNORE, n_classes, right.long())
        cells = (image * (n_classes + 1) + row) * n_classes + labels
        found = torch.bincount(cells.flatten(), minlength=n * (n_classes + 1) * n_classes)
        counts.append(found.view(n, n_classes + 1, n_classes)[:, :n_classes])
    return torch.cat(counts).cpu().numpy(), float(torch.stack(losses).mean()), torch.cat(predicted)


class ImageWatch:
    """Validates a network on images of the size of the task's view, at the labels' own size."""

    def __init__(self, task: Camera, images: ImageSet, truth: Tensor) -> None:
        self.task, self.images, self.truth = task, images, truth

    def validate(self, network: nn.Module) -> tuple[float, float, dict[str, float | None]]:
        """Validate a network: the mean IoU, the mean loss, and the IoU of each class and the mean by name."""
        counts, loss, _ = confusions(network, self.images, self.truth, self.task.input)
        confusion = Confusion(self.task.classes, counts.sum(0))
        iou = {"mean": confusion.mean_iou(), **dict(zip(self.task.classes, confusion.iou().tolist(), strict=True))}
        figures = {name: None if np.isnan(value) else round(float(value), 4) for name, value in iou.items()}
        return confusion.mean_iou(), loss, figures


def camvid_samples(task: Camera, root: Path, device: torch.device) -> tuple[ImageSamples, ImageWatch]:
    """The training samples and the validation of a camera's task, with all images on a device."""
    size = (task.view.width, task.view.height)
    train, validation = (read_camvid(root, split).to(device) for split in ("train", "validation"))
    return ImageSamples(task, train.scaled(*size)), ImageWatch(task, validation.scaled(*size), validation.labels)
