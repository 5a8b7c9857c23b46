"""What a user sees while kernels are compiled: one line, at a first start only.

The logger ``edgeperc.compilation`` has a record of it (level INFO). Where stderr is a terminal and the program has not
set up logging, the same line is written there, with a bar. A program that wants none sets the level of this logger or
of ``edgeperc`` above INFO, or sets up logging. Nothing is written into a pipe or a file, and nothing if all kernels are
in the cache.
"""

from __future__ import annotations

import contextlib
import logging
import math
import shutil
import sys
import time
from collections.abc import Callable, Iterable, Mapping
from importlib import import_module
from types import MappingProxyType, TracebackType
from typing import Any, TextIO

from .kernel_cache import are_kept, missing, watchers
from .kernel_stamp import called_by

__all__ = ["Compilation", "kernels_of"]

logger = logging.getLogger(__name__)

# Kernels that Python calls, by what needs them; tests compare them with what is compiled.
KERNELS: Mapping[str, str] = MappingProxyType(
    {
        "scans": "returns.fill_returns returns.has_returns_only adapt.fill_rendered "
        "decode.fill_labels frame.fill_moved ground.fill_lowest "
        "ground.fit_first_plane projection.fill_image",
        "fitness": "fitness.fill_scan_sums",
        "crop": "crop.fill_rows",
        "gaps": "adapt.fill_between",
        "turn": "frame.fill_turned",
        "ground": "ground.fill_heights ground.fill_heights_above_plane ground.fill_levels ground.fill_planes",
        "points": "projection.mark_range_image refine.fill_point_labels refine.fill_without_outliers",
        "points outside": "crop.fill_spread",
        "clusters": "linkage.chain_points linkage.fill_clusters",
        "boxes": "cluster.fill_cluster_labels cluster.fill_groups cluster.fill_rectangle geometry.fill_oriented_iou "
        "geometry.mark_nms persons.fill_person_groups persons.fill_persons",
        "agreement": "agreement.clear_columns agreement.clear_ground agreement.count_inside agreement.fill_support "
        "persons.complete_persons voting.apply_verdicts voting.fill_tallies voting.fill_verdicts voting.fill_votes",
        "standing": "agreement.sum_inside",
        "road": "drivable.fill_corridor drivable.fill_first_cells "
        "geometry.fill_footprints observed.fill_lowest_returns "
        "observed.follow_rays observed.mark_cells outline.fill_grown outline.fill_rings outline.mark_connected "
        "outline.mark_needed outline.merge_corners outline.resolve_contacts projection.mark_top_view",
        "cells": "cells.clear_cells cells.fill_marks",
        "detections": "decode.clear_empty decode.count_not_finite decode.fill_footprint_sums decode.mark_peaks "
        "geometry.mark_nms",
        "blocks": "blocks.fill_pixels",
        "image": "image.fill_image_labels image.fill_scaled",
    }
)

SECONDS_EACH = 0.27  # of a kernel on a core at 2.4 GHz, with what numba compiles for it
UNEVEN = 1.4  # as long as if all processes ended at the same time
MIN_S = 1.5  # below, nothing is said
BAR = 10  # characters
PRIOR = 10  # kernels that the estimate counts for, beside those that are done


class Compilation:
    """Say that kernels are compiled, for use in a ``with`` statement around what compiles them.

    Parameters
    ----------
    kernels : callable
        Returns the kernels that are needed; called when one is missing.
    n_processes : int
        That compile at the same time.
    """

    def __init__(self, kernels: Callable[[], Iterable[Any]], n_processes: int = 1) -> None:
        self._kernels, self._n_processes = kernels, n_processes
        self._left: list[Any] | None = None
        self._n, self._width, self._began_s, self._each_s, self._what = 0, 0, 0.0, 0.0, ""
        self._terminal: TextIO | None = None

    def __enter__(self) -> Compilation:
        watchers.append(self.update)
        return self

    def __exit__(self, kind: type[BaseException] | None, exc: BaseException | None, at: TracebackType | None) -> None:
        watchers.remove(self.update)
        if kind is None and self._width:
            later = "; later starts load them" if are_kept(self._kernels()) else ""
            self._write(f"compiled {self._n} functions in {math.ceil(time.monotonic() - self._began_s)} s{later}")
        if self._width and self._terminal is not None:
            with contextlib.suppress(OSError, ValueError):
                self._terminal.write("\n")

    def update(self) -> None:
        """Count what is missing: a kernel is to be compiled, or was compiled here or by a helper."""
        if self._left is None:
            self._begin()
        elif self._terminal is not None:
            self._left = missing(self._left)
            done, passed_s = self._n - len(self._left), time.monotonic() - self._began_s
            left_s = len(self._left) * (PRIOR * self._each_s + passed_s) / (PRIOR + done)
            filled = BAR * done // self._n
            self._write(f"{self._what} [{'#' * filled:-<{BAR}}] {math.ceil(left_s)} s left")

    def _begin(self) -> None:
        kernels = [*self._kernels()]
        self._left, self._began_s = missing(kernels), time.monotonic()
        self._n = len(self._left)
        self._each_s = SECONDS_EACH * (UNEVEN / self._n_processes if self._n_processes > 1 else 1.0)
        seconds = self._n * self._each_s
        if seconds < MIN_S:
            return
        self._what = f"compiling {self._n} functions{' once for this computer' if are_kept(kernels) else ''}"
        line = f"{self._what}, about {round(seconds) if seconds < 10.0 else 5 * round(seconds / 5.0)} s"
        logger.info("%s", line)
        self._terminal = _terminal()
        self._write(line)

    def _write(self, line: str) -> None:
        """Replace the line on the terminal."""
        if self._terminal is None:
            return
        shown = f"edgeperc: {line}"[: shutil.get_terminal_size().columns - 1]
        with contextlib.suppress(OSError, ValueError):  # it was closed
            self._terminal.write(f"\r{shown:<{self._width}}")
            self._terminal.flush()
        self._width = len(shown)


def kernels_of(needs: Iterable[str]) -> list[Any]:
    """The kernels of some of the keys of `KERNELS`, and those that they call, each once."""
    names = dict.fromkeys(name.rpartition(".") for need in needs for name in KERNELS[need].split())
    every = [getattr(import_module(f"{__package__}.{module}"), name) for module, _, name in names]
    for kernel in every:  # it grows
        every.extend(other for other in called_by(kernel) if other not in every)
    return every


def _terminal() -> TextIO | None:
    """Standard error if a user reads it, and the program has not said otherwise."""
    levels = [logging.getLogger(name).level for name in (__name__, __package__ or "edgeperc")]
    try:
        is_shown = sys.stderr is not None and sys.stderr.isatty()
    except ValueError:  # it is closed
        return None
    return sys.stderr if is_shown and not logger.hasHandlers() and max(levels) <= logging.INFO else None
