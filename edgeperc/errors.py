"""Every error edgeperc raises on purpose.

::

    EdgepercError
    ├── OptionError (ValueError)      an unknown option, or a value out of its range
    ├── PointsError (ValueError)      an array or a sensor file that is not a scan
    ├── SensorError (ValueError)      an unknown or impossible sensor profile
    ├── SettingsError (ValueError)    the file with this computer's settings cannot be read
    ├── SplitError (ValueError)       a model would be evaluated on a scan that it was trained on
    ├── TrackingError (ValueError)    boxes or a pose that cannot be tracked
    │   └── StampError                a scan that is no later than the one before it
    ├── FitnessError                  a scan unlike those a model was trained on, and on_mismatch="raise"
    ├── ModelError
    │   ├── ModelFileError            missing, or onnxruntime cannot open it
    │   ├── CardError                 card absent, unreadable or of a newer schema
    │   └── CardMismatchError         the card and the graph disagree
    ├── ProviderError                 the execution provider asked for is not there or not active
    ├── InferenceError                the session failed on a valid tensor
    └── MissingExtraError (ImportError)   an optional dependency is absent; says which line installs it

Each message says what was given, what was expected and what to do.
"""

from __future__ import annotations

__all__ = [
    "CardError",
    "CardMismatchError",
    "EdgepercError",
    "FitnessError",
    "InferenceError",
    "MissingExtraError",
    "ModelError",
    "ModelFileError",
    "OptionError",
    "PointsError",
    "ProviderError",
    "SensorError",
    "SettingsError",
    "SplitError",
    "StampError",
    "TrackingError",
]


class EdgepercError(Exception):
    """Root of every error that edgeperc raises on purpose."""


class OptionError(EdgepercError, ValueError):
    """An option is unknown, has a value out of its range, or excludes another option."""


class PointsError(EdgepercError, ValueError):
    """An array or a sensor file is not a scan: wrong shape, dtype, fields or length."""


class SensorError(EdgepercError, ValueError):
    """A sensor profile is unknown or describes no possible sensor."""


class SettingsError(EdgepercError, ValueError):
    """The file with this computer's settings cannot be read, or has another schema."""


class SplitError(EdgepercError, ValueError):
    """A model would be evaluated on a scan that it was trained on."""


class TrackingError(EdgepercError, ValueError):
    """Boxes or a pose that cannot be tracked, or frames that do not belong together."""


class StampError(TrackingError):
    """A scan's time is not finite, or no later than that of the scan before it."""


class FitnessError(EdgepercError):
    """A scan is unlike those the model was trained on, and the caller asked for an error."""


class ModelError(EdgepercError):
    """A model cannot be used."""


class ModelFileError(ModelError):
    """The model file is missing, or onnxruntime cannot open it."""


class CardError(ModelError):
    """The model carries no card, an unreadable one, or one of a newer schema."""


class CardMismatchError(ModelError):
    """The card and the graph disagree on names, shapes or class counts."""


class ProviderError(EdgepercError):
    """The execution provider asked for is not installed or did not become active."""


class InferenceError(EdgepercError):
    """The session failed on a valid input tensor."""


class MissingExtraError(EdgepercError, ImportError):
    """An optional dependency is absent; the message holds the line that installs it."""

    def __init__(self, package: str, extra: str, purpose: str) -> None:
        self.package, self.extra, self.purpose = package, extra, purpose
        super().__init__(f"{purpose} needs {package}, which is not installed. Run: pip install 'edgeperc[{extra}]'")
