"""A live node: perceives the newest cloud of a topic and publishes the answers."""

from __future__ import annotations

import queue
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from ..errors import MissingExtraError, ModelError, OptionError, PointsError, ProviderError
from ..live import stream
from ..readers.clouds import cloud_points, describe_cloud
from ..readers.tables import MAX_SCAN_BYTES
from ..records import PerceivedScan
from ..system.clock import Stamp
from ..system.names import check_text
from .graph import RELIABLE, Graph, Output
from .messages import CLOUD, DIAGNOSTICS, OUTPUTS, RosMessages

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from ..live import Answer
    from ..perceiver import Perceiver
    from ..tracking.tracker import Tracker
    from ..types.perception import Perception

__all__ = ["PerceptionNode"]

REPORT_EVERY_S = 1.0
# No scan heals what is wrong with the installation or the options.
_FATAL = (MissingExtraError, ModelError, OptionError, ProviderError)


class PerceptionNode:
    """Perceives the newest point cloud of a topic; older ones that still wait are dropped and counted.

    Iterate over it to run it. A cloud that cannot be read or perceived, however damaged, is an error in the diagnostics
    and an item of the iteration; the node goes on. Answers have the stamp of their cloud; if it is 0, that of this
    computer's clock. Clouds that come late or twice are answered without tracks, and if the stamps jump, as when a
    recording begins again, tracking begins anew (`edgeperc.Tracker`).

    It subscribes with the quality of service of sensor data. It publishes ``PREFIX/points``, ``PREFIX/markers``,
    ``PREFIX/occupancy`` and ``PREFIX/detections``, each only while somebody subscribes, and ``/diagnostics`` once a
    second, all reliably: best-effort subscribers receive them, too.

    Parameters
    ----------
    graph : Graph
        Closed by the node.
    perceiver_for : callable
        Called once, with the description of the first cloud (`edgeperc.readers.clouds.describe_cloud`); returns the
        `edgeperc.Perceiver`. An error of a kind that another cloud may not have, such as `SensorError`, is an item of
        the iteration, and the next cloud is tried.
    topic : str
        Of sensor_msgs/PointCloud2.
    tracker : Tracker, optional
    frame_id : str, optional
        Frame of the answers, by default that of each cloud.
    grid_frame_id : str, optional
        As in `RosMessages`.
    prefix : str
        Name before those of the topics.
    rate_hz : float
        Scans per second of the sensor; an answer is late after two periods and stale after five.
    outputs : sequence of str
        Names of `OUTPUTS`. If ``detections`` cannot be published because vision_msgs is not installed, a warning says
        so.

    Raises
    ------
    MissingExtraError
        rosbags is not installed.
    OptionError
        A name is not valid.

    Examples
    --------
    >>> graph = ZenohGraph()                                                     # doctest: +SKIP
    >>> with PerceptionNode(graph, lambda cloud: Perceiver(), topic="/points") as node:    # doctest: +SKIP
    ...     for outcome in node:
    ...         print(outcome)
    """

    def __init__(
        self,
        graph: Graph,
        perceiver_for: Callable[[Mapping[str, Any]], Perceiver],
        *,
        topic: str = "/points",
        tracker: Tracker | None = None,
        frame_id: str | None = None,
        grid_frame_id: str | None = None,
        prefix: str = "/edgeperc",
        rate_hz: float = 10.0,
        outputs: Sequence[str] = tuple(OUTPUTS),
    ) -> None:
        if frame_id is not None:
            check_text("the frame is", frame_id, OptionError)
        self._graph, self._perceiver_for = graph, perceiver_for
        self._topic, self._frame_id = topic, frame_id
        self._messages = RosMessages(grid_frame_id=grid_frame_id, lifetime_s=5.0 / rate_hz)
        self._perceiver: Perceiver | None = None
        self._stamp_ns: int | None = None
        self._points: NDArray[np.float32] | None = None
        self._newest: PerceivedScan | None = None
        self._n_answers = self._n_failed = self._n_reported = self._n_failed_reported = 0
        self._error: Exception | None = None
        self._waiting: queue.SimpleQueue[bytes | None] = queue.SimpleQueue()
        self._closed = threading.Event()

        self._outputs: dict[str, Output] = {}
        for name in outputs:
            if name not in OUTPUTS:
                raise OptionError(f"outputs has {name!r}; expected some of {', '.join(OUTPUTS)}")
            if name != "diagnostics":
                self._advertise(name, f"{prefix.rstrip('/')}/{name}")
        self._diagnostics = graph.advertise("/diagnostics", DIAGNOSTICS, RELIABLE) if "diagnostics" in outputs else None
        # The queue is empty nearly always: the stream's thread takes what comes, and keeps the newest.
        self._stream = stream(iter(self._waiting.get, None), self._perceive, tracker, rate_hz=rate_hz)
        graph.subscribe(topic, CLOUD, self._waiting.put)
        self._reporter = threading.Thread(target=self._report_always, name="edgeperc-diagnostics", daemon=True)
        self._reporter.start()

    def _advertise(self, name: str, topic: str) -> None:
        try:
            self._outputs[name] = self._graph.advertise(topic, OUTPUTS[name], RELIABLE)
        except OptionError as exc:
            if name != "detections":
                raise
            warnings.warn(f"no detections are published: {exc}", stacklevel=4)

    @property
    def n_scans(self) -> int:
        """Number of clouds that came."""
        return self._stream.n_scans

    @property
    def n_dropped(self) -> int:
        """Number of them that were dropped because a newer one had come."""
        return self._stream.n_dropped

    @property
    def n_failed(self) -> int:
        """Number of them that could not be read or perceived."""
        return self._n_failed

    def __iter__(self) -> Iterator[PerceivedScan | Exception]:
        """Perceive and publish until the node is closed.

        Yields
        ------
        PerceivedScan or Exception
            For each cloud that was not dropped.

        Raises
        ------
        MissingExtraError, ModelError, OptionError, ProviderError
            Of making the perceiver.
        """
        while not self._closed.is_set():
            try:
                answer = self._stream.take()
                assert answer is not None
                scan = self._publish(answer)
            except StopIteration:
                return
            except _FATAL:
                raise
            except Exception as exc:
                self._error = exc
                self._n_failed += 1
                yield exc
            else:
                self._error, self._newest = None, scan
                self._n_answers += 1
                yield scan

    def _perceive(self, data: bytes, *, stamp_s: float) -> Perception:
        """The answer to the bytes of a cloud. Its own stamp counts, not that of its arrival."""
        self._points, self._stamp_ns = None, None
        if len(data) > MAX_SCAN_BYTES:
            raise PointsError(f"the cloud has {len(data):,} bytes; expected at most {MAX_SCAN_BYTES:,}")
        cloud = self._messages.decode(data, CLOUD)
        if cloud.height * cloud.width > MAX_SCAN_BYTES // 16:
            raise PointsError(
                f"the cloud declares {cloud.height:,} x {cloud.width:,} points; expected at most "
                f"{MAX_SCAN_BYTES // 16:,}"
            )
        points = cloud_points(cloud)
        if self._perceiver is None:
            self._perceiver = self._perceiver_for(describe_cloud(self._topic, cloud))
        stamp_ns = cloud.header.stamp.sec * 10**9 + cloud.header.stamp.nanosec or time.time_ns()
        self._messages.frame_id = self._frame_id or cloud.header.frame_id or "lidar"
        perception = self._perceiver(points, stamp_s=Stamp(stamp_ns * 1e-9, stamp_ns))
        self._points, self._stamp_ns = points, stamp_ns
        return perception

    def _publish(self, answer: Answer) -> PerceivedScan:
        assert self._points is not None
        assert self._perceiver is not None
        assert answer.perception.stamp_s is not None
        scan = PerceivedScan(
            name=f"{self._topic}/{answer.n_scans - 1:06d}",
            stamp_s=answer.perception.stamp_s,
            points=self._points,
            perception=answer.perception,
            tracks=answer.tracks,
            sensor=self._perceiver.sensor,
            health=answer.health,
        )
        for name, output in self._outputs.items():
            if output.is_wanted:
                output.publish(self._messages.encode(getattr(self._messages, name)(scan, self._stamp_ns)))
        return scan

    def _report_always(self) -> None:
        """Body of the thread that publishes the diagnostics, also while a scan is perceived."""
        while not self._closed.wait(REPORT_EVERY_S) and self._diagnostics is not None:
            self._diagnostics.publish(self._messages.encode(self._report()))

    def _report(self) -> Any:
        n_answers, n_failed, error, newest = self._n_answers, self._n_failed, self._error, self._newest
        level, message = None, None
        if error is not None:
            level, message = 2, f"{type(error).__name__}: {error}"
        elif newest is not None:
            health = self._stream.health
            level, message = {"OK": (0, "OK"), "LATE": (1, "LATE"), "STALE": (3, "STALE: no answer of late")}[health]
            if level == 0 and n_failed > self._n_failed_reported:
                level, message = 1, f"{n_failed - self._n_failed_reported} clouds of the last second failed"
        values = {
            "topic": self._topic,
            "clouds received": self.n_scans,
            "clouds dropped": self.n_dropped,
            "clouds failed": n_failed,
            "answers": n_answers,
            "answers [Hz]": f"{(n_answers - self._n_reported) / REPORT_EVERY_S:.0f}",
        }
        if newest is not None:
            values["age of the newest answer [ms]"] = f"{1e3 * self._stream.age_s:.0f}"
        self._n_reported, self._n_failed_reported = n_answers, n_failed
        name = f"{self._graph.name.rpartition('/')[2]}: perception"
        return self._messages.diagnostics(
            newest, time.time_ns(), name=name, level=level, message=message, values=values
        )

    def close(self) -> None:
        """Leave the graph; more calls have no effect."""
        self._closed.set()
        self._reporter.join()
        self._graph.close()
        self._waiting.put(None)
        self._stream.close()

    def __enter__(self) -> PerceptionNode:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
