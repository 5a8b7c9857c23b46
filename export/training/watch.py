"""Validation figures during training."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import nn

from ..data.scan_sets import seen_by_network
from ..data.scans import LabeledScan
from .samples import Samples


class Watch:
    """Validates a network on scans that are not in its training set, with the inputs and targets of ``samples``."""

    def __init__(self, samples: Samples, scans: Sequence[LabeledScan]) -> None:
        self.task, self.scans = samples.task, scans
        seen = [seen_by_network(samples.projector, scan) for scan in scans]
        self.projected = [projected for _, projected in seen]
        self.targets = [self.task.target(scan, projected) for scan, projected in seen]

    def validate(self, network: nn.Module) -> tuple[float, float, dict[str, float | None]]:
        """Validate a network: the decisive figure (`Tally.decisive`), the mean loss, and all figures by name."""
        losses, tally = [], self.task.tally()
        device = next(network.parameters()).device
        for scan, projected, targets in zip(self.scans, self.projected, self.targets, strict=True):
            with torch.no_grad():
                outputs = network(torch.from_numpy(projected.image[None]).to(device))
            batch = [torch.from_numpy(target[None]).to(device) for target in targets]
            losses.append(float(self.task.loss(outputs, batch)))
            self.task.count(outputs, projected, targets, scan, tally)
        return tally.decisive(), float(np.mean(losses)), tally.figures()
