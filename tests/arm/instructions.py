"""``python -m tests.arm.instructions``: instructions that one run of each network takes on aarch64, in fp32 and int8.

An emulated processor shows no times. The number of instructions shows whether onnxruntime has fast kernels for a kind
of int8: unsigned activations, as shipped, or signed ones. It needs a C compiler and onnx.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import onnx

from edgeperc.zoo import DEFAULT, model_path

from .environment import REPOSITORY, Environment, run

# On aarch64: run each network twice, and call getppid before and after the second run.
PROGRAM = """
import os, sys, onnxruntime
from edgeperc.inference.session import golden_input
options = onnxruntime.SessionOptions()
options.intra_op_num_threads = 1
for file in sys.argv[1:]:
    session = onnxruntime.InferenceSession(file, options, providers=["CPUExecutionProvider"])
    given = {each.name: golden_input(0, tuple(each.shape)) for each in session.get_inputs()}
    session.run(None, given)
    os.getppid()
    session.run(None, given)
    os.getppid()
"""
KINDS = ("fp32", "int8", "int8, signed activations")


def main() -> int:
    """Print a table."""
    environment = Environment(REPOSITORY / "build/arm")
    environment.prepare()
    folder = environment.folder
    plugin, counts = folder / "count.so", folder / "counts.txt"
    run(["cc", "-shared", "-fPIC", "-O1", "-o", str(plugin), str(Path(__file__).with_name("count.c"))])
    files = []
    for model in DEFAULT:
        rounded, signed = model_path(f"{model}:int8"), folder / f"{model}-signed.onnx"
        write_signed(rounded, signed)
        files += [str(each) for each in (model_path(model), rounded, signed)]
    print("| processor | network | " + " | ".join(f"{kind}, million" for kind in KINDS) + " |\n" + "| --- " * 5 + "|")
    for cpu in ("cortex-a53", "neoverse-n1"):
        if environment.run(cpu, ["-c", PROGRAM, *files], ["-plugin", f"{plugin},out={counts}"]):
            return 1
        numbers = np.array(counts.read_text().split(), np.float64).reshape(len(DEFAULT), len(KINDS), 2)
        for model, millions in zip(DEFAULT, np.diff(numbers)[..., 0] / 1e6, strict=True):
            print(f"| {cpu} | {model} | {' | '.join(f'{each:.0f}' for each in millions)} |", flush=True)
    return 0


def write_signed(source: Path, target: Path) -> None:
    """The same network with signed activations: every zero point is 128 lower."""
    model = onnx.load(str(source))
    for weight in model.graph.initializer:
        values = onnx.numpy_helper.to_array(weight)
        if values.dtype == np.uint8:
            signed = (values.astype(np.int16) - 128).astype(np.int8)
            weight.CopyFrom(onnx.numpy_helper.from_array(signed, weight.name))
    del model.graph.value_info[:]
    onnx.save(model, str(target))


if __name__ == "__main__":
    sys.exit(main())
