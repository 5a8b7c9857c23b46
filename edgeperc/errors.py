"""The exceptions of edgeperc. Each message says what was given, what was expected and what to do."""

from __future__ import annotations


class EdgepercError(Exception):
    """Base class of all errors of edgeperc."""


class OptionError(EdgepercError, ValueError):
    """An option is unknown, has a value out of its range, or excludes another option."""


class PointsError(EdgepercError, ValueError):
    """An array or a sensor file is not a scan: wrong shape, dtype, fields or length."""


class ImageError(EdgepercError, ValueError):
    """An array or a file is not a camera's image: wrong shape, dtype, format or size; or an image is missing."""


class SensorError(EdgepercError, ValueError):
    """A sensor profile is unknown or describes no possible sensor."""


class CalibrationError(EdgepercError, ValueError):
    """A calibration describes no camera, or does not fit the image that it is used with."""


class MountingError(EdgepercError, ValueError):
    """Scans do not show how the sensor is mounted, and it was not given."""


class SettingsError(EdgepercError, ValueError):
    """This computer's settings file cannot be read, or has another schema."""


class SplitError(EdgepercError, ValueError):
    """A model would be evaluated on a scan that it was trained on."""


class TrackingError(EdgepercError, ValueError):
    """Boxes or a pose that cannot be tracked, or frames that do not belong together."""


class StampError(TrackingError):
    """A time is missing, not finite or out of its range, or two times do not rise where they have to."""


class FitnessError(EdgepercError):
    """A scan differs grossly from the model's training scans, or at all if ``on_mismatch`` is ``"raise"``."""


class ModelError(EdgepercError):
    """A model cannot be used."""


class ModelFileError(ModelError):
    """The model file is missing, or onnxruntime cannot open it."""


class CardError(ModelError):
    """The model's card is missing, unreadable or of a newer schema."""


class CardMismatchError(ModelError):
    """The card and the graph disagree on names, shapes or class counts."""


class ProviderError(EdgepercError):
    """The requested execution provider is not installed, or onnxruntime did not activate it."""


class InferenceError(EdgepercError):
    """The session failed on a valid input tensor."""


class MissingExtraError(EdgepercError, ImportError):
    """An optional package is not installed, and the message gives the install command; or it is ``damaged``."""

    def __init__(self, package: str, extra: str, purpose: str, damaged: str = "") -> None:
        self.package, self.extra, self.purpose, self.damaged = package, extra, purpose, damaged
        state = f"not installed. Run: pip install 'edgeperc[{extra}]'"
        if damaged:
            state = f"installed, but cannot be imported: {damaged}. Install it anew; edgeperc doctor examines it"
        super().__init__(f"{purpose} needs {package}, which is {state}")

    def __reduce__(self) -> tuple[type[MissingExtraError], tuple[str, ...]]:
        """For pickles: a pool of processes waits for ever for an error that its own process cannot read."""
        return type(self), (self.package, self.extra, self.purpose, self.damaged)
