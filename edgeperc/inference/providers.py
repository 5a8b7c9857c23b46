"""Execution providers of onnxruntime on this computer."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from functools import cache
from importlib import import_module
from typing import Any

from ..errors import ProviderError
from ..system.extras import require, without_telemetry
from ..system.names import nearest
from ..types.choices import PRECISIONS

logger = logging.getLogger(__name__)

PROVIDERS: Mapping[str, str] = {
    "tensorrt-rtx": "NvTensorRTRTXExecutionProvider",
    "tensorrt": "TensorrtExecutionProvider",
    "cuda": "CUDAExecutionProvider",
    "openvino": "OpenVINOExecutionProvider",
    "coreml": "CoreMLExecutionProvider",
    "directml": "DmlExecutionProvider",
    "qnn": "QNNExecutionProvider",
    "webgpu": "WebGpuExecutionProvider",
    "cpu": "CPUExecutionProvider",
}
AUTO = ("cuda", "openvino", "cpu")
# Providers that come as plugins in addition to stock onnxruntime: provider, then the package with its library.
PLUGINS = {
    "openvino": "onnxruntime_ep_openvino",
    "tensorrt-rtx": "onnxruntime_ep_nv_tensorrt_rtx",
    "qnn": "onnxruntime_qnn",
    "webgpu": "onnxruntime_ep_webgpu",
}
# Providers that run on the processor's cores and take a number of threads.
SHARING = ("cpu", "openvino")
# What C++ raises, and warnings that are errors, become one of these, or one of onnxruntime's own classes, which share
# no base but Exception.
_OF_CPP = (RuntimeError, ValueError, TypeError, LookupError, ArithmeticError, MemoryError, Warning)


def check_names(provider: str, precision: str) -> None:
    """Refuse names that are none. Raises ProviderError."""
    if precision not in ("auto", *PRECISIONS):
        close = nearest(precision, PRECISIONS)
        raise ProviderError(f"precision {precision!r} is unknown{close}; expected auto, {', '.join(PRECISIONS)}")
    if provider == "auto" or provider in PROVIDERS:
        return
    short, _, suffix = provider.partition(":")
    if short in PROVIDERS and suffix:
        raise ProviderError(
            f"provider {provider!r}: the precision is an option of its own; ask for provider {short!r} and "
            f"precision {suffix!r}"
        )
    close = nearest(provider, PROVIDERS)
    raise ProviderError(f"provider {provider!r} is unknown{close}; expected auto or one of {', '.join(PROVIDERS)}")


def load_onnxruntime() -> Any:
    """The module onnxruntime, which sends and prints nothing. Raises MissingExtraError."""
    without_telemetry()
    ort = require("onnxruntime", "cpu", "Running a model")
    ort.set_default_logger_severity(4)  # its exceptions contain the messages, and ours repeat them
    return ort


def recompiles(short: str, view_kind: str) -> bool:
    """Whether a provider compiles a network anew for each number of candidates, which differs from scan to scan.

    On 30 KITTI scans, that of objects takes 22 ms a scan on OpenVINO and 5 ms on `cpu` (two cores of an Intel Xeon).
    A few scans in turn do not show it, because their numbers come again.
    """
    return short == "openvino" and view_kind == "objects"


def is_of_engine(exc: Exception) -> bool:
    """Whether onnxruntime raised an error: the handler of a signal may raise one of its own during a call."""
    return isinstance(exc, _OF_CPP) or type(exc).__module__.startswith("onnxruntime")


def plugin_devices(ort: Any, short: str) -> list[Any]:
    """Devices of a plugin provider on this computer; empty if its package is not installed or finds none.

    Of Qualcomm's, the NPU comes first: its plugin also offers the GPU and the processor.
    """
    if not hasattr(ort, "get_ep_devices"):
        return []
    name = PROVIDERS[short]

    def devices() -> list[Any]:
        found = [d for d in ort.get_ep_devices() if d.ep_name == name]
        return sorted(found, key=lambda d: d.device.type.name != "NPU") if short == "qnn" else found

    if not devices():
        try:
            ort.register_execution_provider_library(name, import_module(PLUGINS[short]).get_library_path())
        except ModuleNotFoundError:
            return []
        except Exception as exc:  # onnxruntime's errors share no base but Exception
            if "already registered" not in str(exc):
                raise ProviderError(
                    f"the plugin for provider {short!r} is installed but does not load: {exc}; install a version of "
                    f"{PLUGINS[short]} for onnxruntime {ort.__version__}, or uninstall it"
                ) from exc
    return devices()


def is_available(short: str) -> bool:
    """Whether ``Perceiver(provider=...)`` accepts a key of `PROVIDERS` here. Raises ProviderError."""
    ort = load_onnxruntime()
    return PROVIDERS[short] in ort.get_available_providers() or (short in PLUGINS and bool(plugin_devices(ort, short)))


def available_providers() -> tuple[str, ...]:
    """The keys of `PROVIDERS` that are available; the log says once which plugins do not load."""
    present = []
    for short in PROVIDERS:
        try:
            present += [short] * is_available(short)
        except ProviderError as exc:
            _warn_once(str(exc))
    return tuple(present)


@cache
def _warn_once(text: str) -> None:
    logger.warning("%s", text)


def runtime_version() -> str:
    """The version of the installed onnxruntime."""
    return str(load_onnxruntime().__version__)


def devices() -> tuple[str, ...]:
    """The devices that onnxruntime and its installed plugins offer here, such as ``"cpu: CPU Intel"``.

    Empty if onnxruntime is older than 1.23, which does not list them.
    """
    present, ort = available_providers(), load_onnxruntime()  # in this order, which loads the plugins
    found = ort.get_ep_devices() if hasattr(ort, "get_ep_devices") else ()
    names = {PROVIDERS[short]: short for short in present}
    listed = (
        f"{names.get(each.ep_name.partition('.')[0], each.ep_name)}: "  # such as OpenVINOExecutionProvider.AUTO
        f"{each.device.type.name} {each.device.vendor or each.ep_vendor}"
        for each in found
    )
    return tuple(dict.fromkeys(each.strip() for each in listed))
