"""The networks of a perceiver, some of which are those of its sensor."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence

from ..types.choices import SPARSE_MODELS
from ..types.sensor import SensorProfile
from ..zoo import resolve
from .session import Session

Model = str | os.PathLike[str]


class Sessions:
    """Sessions of models by name or path, each loaded when a sensor first needs it."""

    def __init__(self, models: Sequence[Model], precision: str, load: Callable[[Model], Session]) -> None:
        self.models, self.precision, self._load = models, precision, load
        self._loaded: dict[Model, Session] = {}

    def of(self, sensor: SensorProfile) -> tuple[Session, ...]:
        """The sessions for the scans of a sensor. Raises as `Session`."""
        models = [self._sparse(model) or model if sensor.is_sparse else model for model in self.models]
        for model in models:
            if model not in self._loaded:
                self._loaded[model] = self._load(model)
        return tuple(self._loaded[model] for model in models)

    def _sparse(self, model: Model) -> str | None:
        """What takes the place of a model for sparse sensors; None if it does not come in the precision asked for."""
        name = SPARSE_MODELS.get(str(model))
        precision = "fp32" if self.precision == "bf16" else self.precision
        if name is None or precision == "auto":
            return name
        return name if any(variant.precision == precision for variant in resolve(name)) else None
