"""What an application does around a Perceiver: stream, track, measure the road, write JSON, and draw now and then."""

from __future__ import annotations

import json
from collections.abc import Iterator
from queue import SimpleQueue
from typing import Any

from edgeperc import Perceiver, Perception, Tracker, draw, stream
from edgeperc.records import scan_record
from edgeperc.types.points import Floats32, Points

PERIOD_S = 0.1


class Application:
    """Called in place of a Perceiver: each scan goes through a stream and a tracker; every ``draw_every``-th is
    drawn.
    """

    def __init__(self, perceive: Perceiver, draw_every: int = 100) -> None:
        self._scans: SimpleQueue[Floats32 | None] = SimpleQueue()
        self._draw_every = draw_every
        self._n = 0
        # A stream takes the newest scan; here the next one comes after the answer, so that none is dropped.
        self._live = stream(self._source(), perceive, Tracker(), rate_hz=1.0 / PERIOD_S, stale_after_s=3600.0)

    def _source(self) -> Iterator[Any]:
        n = 0
        while (scan := self._scans.get()) is not None:
            yield n * PERIOD_S, scan
            n += 1

    def __call__(self, points: Points) -> Perception:
        """Perceive a scan."""
        self._scans.put(points)
        answer = next(self._live)
        json.dumps(scan_record(answer.perception, answer.tracks))
        if self._draw_every and self._n % self._draw_every == 0:
            draw(answer.perception, points)
        self._n += 1
        return answer.perception

    def close(self) -> None:
        """End the stream and its thread."""
        self._scans.put(None)
        self._live.close()
