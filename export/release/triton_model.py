"""The Python model of a Triton repository, as `release.triton` copies it there: from a scan to its answer.

Triton imports it as ``model.py`` in a process of its own, which needs edgeperc with onnxruntime. The networks run in
Triton's onnxruntime backend, under their own names.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edgeperc import Perceiver
from edgeperc.errors import EdgepercError, InferenceError
from edgeperc.inference.session import Session
from edgeperc.records import scan_record
from edgeperc.types.points import Floats32


class TritonPythonModel:
    """Triton's interface of a Python model; it calls the methods in turn."""

    def initialize(self, args: Mapping[str, str]) -> None:
        """Make the perceiver. ``args["model_config"]`` is ``config.pbtxt`` as JSON."""
        self._triton: Any = import_module("triton_python_backend_utils")
        given = json.loads(args["model_config"])["parameters"]
        parameters = {name: value["string_value"] for name, value in given.items()}
        models = sorted(Path(__file__).parent.glob("*.onnx"))
        self._perceive = Perceiver(models, sensor=parameters["sensor"], provider="cpu", n_threads=1)
        for session in self._perceive.sessions:
            session.run = partial(self._run, session)  # type: ignore[method-assign]

    def _run(self, session: Session, n_rows: int = 1) -> Mapping[str, Floats32]:
        """`Session.run`, by Triton."""
        triton, card = self._triton, session.card
        of_rows = card.input_shape[0] is None
        response = triton.InferenceRequest(
            model_name=card.name,
            requested_output_names=[output.name for output in card.outputs],
            inputs=[triton.Tensor(card.input.name, session.input[:n_rows] if of_rows else session.input[None])],
            preferred_memory=triton.PreferredMemory(triton.TRITONSERVER_MEMORY_CPU, 0),
        ).exec()
        if response.has_error():
            raise InferenceError(f"{card.name}: {response.error().message()}")
        for output in card.outputs:
            answer = triton.get_output_tensor_by_name(response, output.name).as_numpy()
            if of_rows:
                session.raw[output.kind][:n_rows] = answer
            else:
                session.raw[output.kind][:] = answer[0]
        session.spread()
        return session.outputs

    def execute(self, requests: Sequence[Any]) -> list[Any]:
        """Answer requests: a scan each."""
        return [self._answer(request) for request in requests]

    def _answer(self, request: Any) -> Any:
        triton = self._triton
        points = triton.get_input_tensor_by_name(request, "points").as_numpy()
        stamp = triton.get_input_tensor_by_name(request, "stamp_s")
        try:
            perception = self._perceive(points, None if stamp is None else float(stamp.as_numpy()[0]))
            record = scan_record(perception)
        except EdgepercError as exc:
            return triton.InferenceResponse(output_tensors=[], error=triton.TritonError(str(exc)))
        answers: dict[str, NDArray[Any]] = {
            "record": np.array([json.dumps(record, allow_nan=False).encode()], np.object_)
        }
        if perception.points is not None:
            answers["labels"] = perception.points.labels
        if perception.top_view is not None:
            answers["cells"] = perception.top_view.labels
        return triton.InferenceResponse(output_tensors=[triton.Tensor(*answer) for answer in answers.items()])
