"""Training in several processes, the ranks of ``torchrun``.

Every rank gets the whole batch and puts its own part through the network. What a batch has in common stays in common:
the statistics of batch norm, the random numbers of dropout, and the loss, which is computed from the gathered outputs
of all ranks. So a step is that of one process, whatever the loss; only the order of additions differs. torch's
DistributedDataParallel would average losses of parts, which are other losses: weighted means and the Lovasz-softmax
loss are of a batch.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any, TypeVar

import torch
import torch.distributed as dist
from torch import Tensor, nn

from edgeperc.errors import EdgepercError

Value = TypeVar("Value")


class RankError(EdgepercError):
    """Another rank of a training run stopped, or the ranks cannot share the work."""


class Ranks:
    """The processes of a run, number ``rank`` of ``world``, by ``torchrun``'s variables; ``device``: GPU or CPU."""

    def __init__(self) -> None:
        self.rank, self.world = (int(os.environ.get(name, usual)) for name, usual in (("RANK", 0), ("WORLD_SIZE", 1)))
        self.device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
        self._shapes: list[tuple[torch.Size, torch.dtype]] = []

    @property
    def is_first(self) -> bool:
        """Whether this process writes files and shows the progress."""
        return self.rank == 0

    @contextmanager
    def together(self) -> Iterator[None]:
        """Connect the ranks: by NCCL on GPUs, by gloo on CPUs. Raises RankError."""
        if self.world == 1:
            yield
            return
        if self.device.type == "cuda":
            self.device = torch.device("cuda", int(os.environ.get("LOCAL_RANK", 0)))
            torch.cuda.set_device(self.device)
        try:
            dist.init_process_group("nccl" if self.device.type == "cuda" else "gloo")
            yield
        except RuntimeError as exc:
            text = str(exc).lower()
            if isinstance(exc, dist.DistError) or any(word in text for word in ("gloo", "nccl", "connection", "peer")):
                reason = " ".join(str(exc).split())[:200]
                raise RankError(
                    f"rank {self.rank} of {self.world} stops, because another rank did ({reason}); see its message. "
                    "The same command resumes the run"
                ) from exc
            raise
        finally:
            if dist.is_initialized():
                dist.destroy_process_group()

    def check(self, batch: int, accumulate: int, compiled: bool) -> None:
        """Raise `RankError` if the ranks cannot share a batch."""
        if self.world > 1 and batch % (accumulate * self.world):
            raise RankError(
                f"a batch of {batch} in {accumulate} parts cannot be shared by {self.world} ranks; expected a multiple "
                f"of {accumulate * self.world}"
            )
        if self.world > 1 and compiled:
            raise RankError("--compile is for one process; leave it out with torchrun")

    def share(self, network: nn.Module) -> None:
        """Give all ranks the first one's weights, and let batch norm and dropout work on the whole batch."""
        if self.world == 1:
            return
        for value in network.state_dict().values():
            dist.broadcast(value, 0)
        for module in network.modules():
            for kind, shared in ((nn.BatchNorm2d, _BatchNorm), (nn.Dropout, _Dropout), (nn.Dropout2d, _Dropout2d)):
                if type(module) is kind:
                    module.__class__ = shared  # the same parameters under the same names

    def part(self, batch: Tensor) -> Tensor:
        """This rank's part of a batch."""
        return batch.chunk(self.world)[self.rank]

    def whole(self, outputs: Any) -> Any:
        """The whole batch of a network's outputs, or of several, from the parts of all ranks."""
        if self.world == 1:
            return outputs
        if isinstance(outputs, Tensor):
            return _Gather.apply(outputs.float() if outputs.dtype == torch.bfloat16 else outputs)  # type: ignore[no-untyped-call]
        return tuple(self.whole(each) for each in outputs)

    def add_gradients(self, network: nn.Module) -> None:
        """Add up the gradients of all ranks: each has those of the batch's loss by way of its own part."""
        if self.world == 1:
            return
        gradients = [p.grad for p in network.parameters() if p.grad is not None]
        flat = torch.cat([gradient.flatten() for gradient in gradients])
        dist.all_reduce(flat)
        for gradient, summed in zip(gradients, torch.split(flat, [g.numel() for g in gradients]), strict=True):
            gradient.copy_(summed.view_as(gradient))

    def from_first(self, value: Value) -> Value:
        """The first rank's value."""
        if self.world == 1:
            return value
        values = [value]
        dist.broadcast_object_list(values, 0, device=self.device)
        return values[0]

    def from_rank(self, rank: int, batch: Sequence[Tensor] | None) -> list[Tensor]:
        """The batch of a rank, on all of them; the others pass None. All batches have the same shapes."""
        if self.world == 1:
            assert batch is not None
            return list(batch)
        if not self._shapes:
            shapes = [None if batch is None else [(part.shape, part.dtype) for part in batch]]
            dist.broadcast_object_list(shapes, rank, device=self.device)
            assert shapes[0] is not None
            self._shapes = shapes[0]
        parts = batch or [torch.empty(shape, dtype=dtype, device=self.device) for shape, dtype in self._shapes]
        for part in parts:
            dist.broadcast(part, rank)
        return list(parts)


class _Gather(torch.autograd.Function):
    """Concatenates the parts of all ranks. All compute the same loss from it, so each keeps its part of the slope."""

    @staticmethod
    def forward(ctx: Any, part: Tensor) -> Tensor:
        parts = [torch.empty_like(part, memory_format=torch.contiguous_format) for _ in range(dist.get_world_size())]
        dist.all_gather(parts, part.contiguous())
        return torch.cat(parts)

    @staticmethod
    def backward(ctx: Any, slope: Tensor) -> Tensor:
        return slope.chunk(dist.get_world_size())[dist.get_rank()]


class _Sum(torch.autograd.Function):
    """The sum over all ranks; its slope is the sum of theirs."""

    @staticmethod
    def forward(ctx: Any, value: Tensor) -> Tensor:
        return _summed(value)

    @staticmethod
    def backward(ctx: Any, slope: Tensor) -> Tensor:
        return _summed(slope)


def _summed(value: Tensor) -> Tensor:
    value = value.contiguous().clone()
    dist.all_reduce(value)
    return value


class _BatchNorm(nn.BatchNorm2d):
    """Batch norm with the mean and variance of the whole batch; torch's SyncBatchNorm is for GPUs alone."""

    def forward(self, input: Tensor) -> Tensor:
        if not self.training:
            return super().forward(input)
        assert self.running_mean is not None
        assert self.running_var is not None
        assert self.num_batches_tracked is not None
        assert self.momentum is not None
        x, world = input.to(self.running_mean.dtype), dist.get_world_size()
        n = world * x.numel() // x.shape[1]
        mean = _Sum.apply(x.sum((0, 2, 3))) / n  # type: ignore[no-untyped-call]
        centered = x - mean[:, None, None]
        variance = _Sum.apply((centered**2).sum((0, 2, 3))) / n  # type: ignore[no-untyped-call]
        with torch.no_grad():
            self.running_mean.lerp_(mean, self.momentum)
            self.running_var.lerp_(variance * (n / max(n - 1, 1)), self.momentum)
            self.num_batches_tracked += 1
        x = centered * (variance + self.eps).rsqrt()[:, None, None]
        return (x * self.weight[:, None, None] + self.bias[:, None, None]).to(input.dtype)


def _drop(input: Tensor, p: float, shape: Sequence[int]) -> Tensor:
    """Dropout with this rank's part of the random numbers of the whole batch, as torch draws them on a CPU."""
    world, n = dist.get_world_size(), len(input)
    noise = torch.empty((world * n, *shape), dtype=input.dtype, device=input.device)
    if len(shape) == 3 and input.is_contiguous(memory_format=torch.channels_last):
        noise = noise.contiguous(memory_format=torch.channels_last)
    noise = noise.bernoulli_(1.0 - p).div_(1.0 - p)
    return input * noise[dist.get_rank() * n :][:n]


class _Dropout(nn.Dropout):
    """Dropout of single values."""

    def forward(self, input: Tensor) -> Tensor:
        return _drop(input, self.p, input.shape[1:]) if self.training and self.p else super().forward(input)


class _Dropout2d(nn.Dropout2d):
    """Dropout of whole channels."""

    def forward(self, input: Tensor) -> Tensor:
        return _drop(input, self.p, (input.shape[1], 1, 1)) if self.training and self.p else super().forward(input)
