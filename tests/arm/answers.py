"""Write a computer's answers to some scans: ``python answers.py KIND IN.npz OUT.npz``.

It runs on both processors and imports nothing but edgeperc and what edgeperc needs. KIND ``scans`` perceives the arrays
``scan0``, ``scan1``, ...; KIND ``networks`` runs both networks on the inputs that KIND ``scans`` wrote.
"""

from __future__ import annotations

import json
import platform
import sys
import time
from typing import Any

import numpy as np

import edgeperc
from edgeperc.inference.session import Session
from edgeperc.system.machine import cpu_features, cpu_model
from edgeperc.zoo import DEFAULT

PRECISIONS = ("fp32", "int8")
N_INPUTS = 2  # scans whose network inputs are kept


def scans(given: Any) -> tuple[dict[str, Any], dict[str, Any]]:
    """Labels, cells and boxes of every scan in both precisions, and inputs of the networks."""
    arrays: dict[str, Any] = {}
    document: dict[str, Any] = {"boxes": {}, "seconds": {}}
    for precision in PRECISIONS:
        started = time.perf_counter()
        # trusted: a first run is not stopped after 30 s, which an emulated processor may take.
        perceive = edgeperc.Perceiver(provider="cpu", precision=precision, trusted=True)
        document["seconds"][f"{precision} start"] = time.perf_counter() - started
        started = time.perf_counter()
        for name in given.files:
            seen = perceive(given[name])
            arrays[f"{precision} points {name}"] = seen.require_points().labels
            arrays[f"{precision} cells {name}"] = seen.require_top_view().labels
            document["boxes"][f"{precision} {name}"] = [box.to_dict() for box in seen.boxes]
            if precision == PRECISIONS[0] and name in given.files[:N_INPUTS]:
                arrays |= {f"input {s.card.name} {name}": s.input.copy() for s in perceive.sessions}
        document["seconds"][f"{precision} scans"] = time.perf_counter() - started
    return arrays, document


def networks(given: Any) -> tuple[dict[str, Any], dict[str, Any]]:
    """Classes of the pixels in both precisions, and the precision that "auto" takes."""
    arrays: dict[str, Any] = {}
    document: dict[str, Any] = {"auto": {}, "golden": {}}
    inputs = [name for name in given.files if name.startswith("input ")]
    for model in DEFAULT:
        document["auto"][model] = Session(model, "cpu", n_threads=1, trusted=True).precision
        for precision in PRECISIONS:
            session = Session(model, "cpu", precision=precision, n_threads=1, trusted=True)
            document["golden"][f"{precision} {model}"] = session.golden_deviation
            for name in inputs:
                if name.split()[1] == model and session.card.view.kind != "objects":
                    session.input[:] = given[name]
                    arrays[f"{precision} pixels {name}"] = session.run()["class_logits"].argmax(0).astype(np.uint8)
    return arrays, document


def main(kind: str, source: str, target: str) -> None:
    """Write the answers to ``target``."""
    with np.load(source) as given:
        arrays, document = {"scans": scans, "networks": networks}[kind](given)
    document |= {"machine": platform.machine(), "cpu": cpu_model(), "features": sorted(cpu_features())}
    np.savez(target, document=np.array(json.dumps(document)), **arrays)


if __name__ == "__main__":
    main(*sys.argv[1:])
