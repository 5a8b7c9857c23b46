"""A serverless function of CVAT: a scan in, its boxes out as cuboids of a 3-D task; in the form of nuclio."""

from __future__ import annotations

import base64
import binascii
import functools
import inspect
import json
import os
from http import HTTPStatus
from itertools import chain
from typing import Any

from ..errors import EdgepercError, FitnessError, OptionError, PointsError, SensorError
from ..perceiver import Learned, Perceiver
from ..readers.files import parse_points
from ..sinks.prelabels import cvat_cuboid
from ..system.names import nearest

__all__ = ["OPTIONS_VARIABLE", "CvatFunction", "handler", "init_context"]

OPTIONS_VARIABLE = "EDGEPERC_OPTIONS"
"""Environment variable with the function's options of a `Perceiver`, a JSON object."""

_STATUS = {
    OptionError: HTTPStatus.BAD_REQUEST,
    PointsError: HTTPStatus.UNPROCESSABLE_ENTITY,
    SensorError: HTTPStatus.UNPROCESSABLE_ENTITY,
    FitnessError: HTTPStatus.UNPROCESSABLE_ENTITY,
}
_N_NUMBERS = 16  # of a cuboid in CVAT; in a 3-D task the last seven are 0


class CvatFunction:
    """Answers CVAT's requests, each by its scan alone: what was asked before changes nothing.

    Parameters
    ----------
    **options
        Of the `Perceiver`. A threshold in a request replaces its ``score_threshold``.

    Raises
    ------
    OptionError, ModelError, ProviderError, SensorError, MissingExtraError
        As `Perceiver`; an unknown option, too.
    """

    def __init__(self, **options: Any) -> None:
        known = [*inspect.signature(Perceiver).parameters]
        for name in options.keys() - {*known}:
            raise OptionError(
                f"{name!r} is no option of a Perceiver{nearest(name, known)}; expected {', '.join(known)}"
            )
        self._options = options
        self._perceiver = functools.lru_cache(maxsize=2)(self._make)  # a task is annotated with one threshold
        self._perceiver(None)

    def annotate(self, request: object) -> list[dict[str, Any]]:
        """The shapes of the scan in a request.

        Parameters
        ----------
        request : dict
            ``"image"``: the file of the frame in base64, PCD as CVAT sends it, or raw float32 as KITTI's .bin; also
            the other formats of `read_points`. ``"threshold"``, optional: lowest score of a box, in 0..1.

        Raises
        ------
        OptionError
            The request has another form.
        PointsError, SensorError, FitnessError, InferenceError
            As a `Perceiver`'s call.
        """
        content, threshold = _read(request)
        points = parse_points(content, "image.bin")  # of this name, it may be raw values
        perceive, fresh = self._perceiver(threshold)
        perceive.start_from(fresh)
        answers = []
        for box in perceive(points).boxes:
            numbers = [*chain.from_iterable(cvat_cuboid(box).values())]
            numbers += [0.0] * (_N_NUMBERS - len(numbers))
            score = str(round(box.score, 4))
            answers.append({"confidence": score, "label": box.label, "type": "cuboid", "points": numbers})
        return answers

    def _make(self, threshold: float | None) -> tuple[Perceiver, Learned]:
        options = self._options if threshold is None else self._options | {"score_threshold": threshold}
        perceiver = Perceiver(**options)
        return perceiver, perceiver.learned


def _read(request: object) -> tuple[bytes, float | None]:
    if not isinstance(request, dict):
        raise OptionError(
            f"the request is {type(request).__name__} {request!r:.40}; expected a JSON object with 'image', sent as "
            "application/json"
        )
    image, threshold = request.get("image"), request.get("threshold")
    if not isinstance(image, str):
        keys = ", ".join(map(repr, request)) or "nothing"
        raise OptionError(f"the request has {keys:.80}, and image is {image!r:.40}; expected the scan in base64")
    if threshold is not None and not (type(threshold) in (int, float) and 0.0 <= threshold <= 1.0):
        raise OptionError(f"threshold is {threshold!r:.40}; expected a number in 0..1, or none")
    try:
        return base64.b64decode(image, validate=True), threshold
    except (binascii.Error, ValueError) as exc:  # ValueError: not ASCII
        raise OptionError(f"image is {image!r:.40}, no base64 ({exc}); expected the scan's file in base64") from exc


def init_context(context: Any) -> None:
    """Load the models, once for each worker of nuclio; options are those in `OPTIONS_VARIABLE`."""
    text = os.environ.get(OPTIONS_VARIABLE, "{}")
    try:
        options = json.loads(text)
    except (RecursionError, ValueError) as exc:
        raise OptionError(f"{OPTIONS_VARIABLE} is {text!r}, no JSON ({exc}); expected options of a Perceiver") from exc
    if not isinstance(options, dict):
        raise OptionError(f"{OPTIONS_VARIABLE} is {text!r}; expected a JSON object with options of a Perceiver")
    context.user_data.function = CvatFunction(**options)


def handler(context: Any, event: Any) -> Any:
    """Answer one request; an error has its kind and message, which are in the log of the function, too."""
    status = HTTPStatus.OK
    try:
        answer: object = context.user_data.function.annotate(event.body)
    except EdgepercError as exc:
        status = _STATUS.get(type(exc), HTTPStatus.INTERNAL_SERVER_ERROR)
        answer = {"error": type(exc).__name__, "message": str(exc)}
        context.logger.warn(f"{type(exc).__name__}: {exc}")
    return context.Response(
        body=json.dumps(answer), headers={}, content_type="application/json", status_code=int(status)
    )
