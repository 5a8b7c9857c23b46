"""What a user sees while kernels are compiled: one line, at a first start only.

The logger ``system.compilation`` has a record of it (level INFO). Where stderr is a terminal and the program has not
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

from .compiling import watchers
from .kernel_stamp import called_by

logger = logging.getLogger(__name__)

PACKAGE = "edgeperc"

# Kernels that Python calls, by what needs them, such as a view; tests compare them with what is compiled.
KERNELS: Mapping[str, str] = MappingProxyType(
    {
        "scans": "ground.planes.fill_lowest ground.planes.fit_first_plane preprocess.condition.fill_rendered "
        "preprocess.health.fill_lacking preprocess.health.fill_sectors preprocess.health.mark_isolated "
        "preprocess.returns.fill_returns preprocess.returns.has_returns_only types.frame.fill_moved",
        "views": "inference.crop.fill_rows inference.decode.fill_labels inference.projection.fill_image",
        "curvature": "inference.projection.fill_curvature",
        "fitness": "preprocess.fitness.fill_scan_sums",
        "gaps": "preprocess.interpolation.fill_between",
        "sensor": "preprocess.sensor_estimate.fill_votes",
        "turn": "types.frame.fill_turned",
        "ground": "ground.planes.fill_heights ground.planes.fill_heights_above_plane ground.planes.fill_levels "
        "ground.planes.fill_planes ground.planes.taken_cells",
        "range_image": "inference.crop.fill_spread inference.projection.mark_range_image "
        "objects.refine.fill_point_labels objects.refine.fill_without_outliers",
        "clusters": "objects.linkage.chain_points objects.linkage.fill_clusters",
        "boxes": "objects.boxes.fill_rectangle objects.cluster.fill_cluster_labels objects.cluster.fill_groups "
        "objects.persons.fill_person_groups objects.persons.fill_persons types.geometry.fill_oriented_iou "
        "types.geometry.mark_nms",
        "objects": "objects.candidate_boxes.fill_boxes objects.candidate_boxes.fill_merged "
        "objects.candidates.fill_cells objects.crops.fill_crops objects.crops.fill_features "
        "types.geometry.fill_oriented_iou types.geometry.mark_nms",
        "candidates": "objects.candidates.fill_groups_of_cells objects.candidates.fit_groups",
        "agreement": "agreement.rules.clear_columns agreement.rules.clear_ground agreement.rules.count_inside "
        "agreement.rules.fill_support agreement.votes.apply_verdicts agreement.votes.fill_tallies "
        "agreement.votes.fill_verdicts agreement.votes.fill_votes objects.persons.complete_persons",
        "standing": "agreement.rules.sum_inside",
        "top_view": "ground.observed.fill_lowest_returns ground.observed.follow_rays ground.observed.mark_cells "
        "inference.projection.mark_top_view road.ahead.fill_corridor road.ahead.fill_first_cells "
        "road.outline.fill_grown road.outline.fill_rings road.outline.mark_connected "
        "road.outline.mark_needed road.outline.merge_corners road.outline.resolve_contacts "
        "types.geometry.fill_footprints",
        "cells": "agreement.cells.clear_cells agreement.cells.fill_marks",
        "detections": "inference.box_heads.count_not_finite inference.box_heads.fill_footprint_sums "
        "inference.box_heads.mark_peaks inference.decode.clear_empty types.geometry.mark_nms",
        "pillars": "inference.box_heads.count_not_finite inference.pillars.fill_pillars "
        "inference.pillars.find_pillars types.geometry.fill_oriented_iou types.geometry.mark_nms",
        "blocks": "inference.decode.fill_pixels",
        "camera": "camera.image.fill_image_labels camera.image.fill_scaled",
    }
)

SECONDS_EACH = 0.27  # of a kernel on a core at 2.4 GHz, with what numba compiles for it
UNEVEN = 1.4  # as long as if all processes ended at the same time
MIN_S = 1.5  # below, nothing is said
BAR = 10  # characters
PRIOR = 10  # kernels that the estimate counts for, in addition to those that are done


class Compilation:
    """Say that kernels are compiled, by so many processes, for use in a ``with`` statement around what compiles them;
    ``kernels`` is asked for those that are needed when one is missing.
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
            from .kernel_cache import are_kept

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
            from .kernel_cache import missing

            self._left = missing(self._left)
            done, passed_s = self._n - len(self._left), time.monotonic() - self._began_s
            left_s = len(self._left) * (PRIOR * self._each_s + passed_s) / (PRIOR + done)
            filled = BAR * done // self._n
            self._write(f"{self._what} [{'#' * filled:-<{BAR}}] {math.ceil(left_s)} s left")

    def _begin(self) -> None:
        from .kernel_cache import are_kept, missing

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
    every = [getattr(import_module(f"{PACKAGE}.{module}"), name) for module, _, name in names]
    for kernel in every:  # it grows
        every.extend(other for other in called_by(kernel) if other not in every)
    return every


def _terminal() -> TextIO | None:
    """Standard error if a user reads it, and the program has not said otherwise."""
    levels = [logging.getLogger(name).level for name in (__name__, PACKAGE)]
    try:
        is_shown = sys.stderr is not None and sys.stderr.isatty()
    except ValueError:  # it is closed
        return None
    return sys.stderr if is_shown and not logger.hasHandlers() and max(levels) <= logging.INFO else None
