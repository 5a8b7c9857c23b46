"""A live node: perceives the newest cloud of a topic and publishes the answers."""

from __future__ import annotations

import queue
import threading
import time
import warnings
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import takewhile
from typing import TYPE_CHECKING, Any

import numpy as np

from ..errors import MissingExtraError, ModelError, OptionError, PointsError, ProviderError, TrackingError
from ..live import check_rate, stream
from ..readers.clouds import cloud_points, describe_cloud
from ..readers.scan_odometry import Odometry
from ..readers.tables import MAX_SCAN_BYTES
from ..records import PerceivedScan
from ..road.grid import Split, split_points
from ..road.sweeps import MAX_SWEEPS, SweepPerceiver
from ..system.clock import Stamp
from ..system.fields import OPTIONS
from ..system.names import check_text
from . import messages
from .graph import TRANSITIONS, Graph, Output, State, full_name
from .odometry import ODOMETRY, Poses, Rolling

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from ..live import Answer
    from ..perceiver import Perceiver
    from ..tracking.tracker import Tracker
    from ..tracking.tracks import Tracks
    from ..types.mounting import Mounting
    from ..types.perception import Perception
    from ..types.points import Floats, Floats32

__all__ = ["PerceptionNode"]

USUAL_OUTPUTS = (*messages.OUTPUTS, messages.GROUND_POINTS, messages.OBSTACLE_POINTS)
"""What a node publishes unless it is told otherwise."""
REPORT_EVERY_S = 1.0
_MOST_GATHERED = 200  # clouds: more than come in the time of a scan
_LATENCIES = 1000  # of the last answers, for the percentiles
# No scan heals what is wrong with the installation or the options.
_FATAL = (MissingExtraError, ModelError, OptionError, ProviderError)


class PerceptionNode:
    """Perceives the newest point cloud of a topic; older ones that still wait are dropped and counted.

    Iterate over it to run it. A cloud that cannot be read or perceived, however damaged, is an error in the diagnostics
    and an item of the iteration; the node goes on. Answers have the stamp of their cloud; if it is 0, that of this
    computer's clock. Clouds that come late or twice are answered without tracks, and if the stamps jump, as when a
    recording begins again, tracking begins anew (`edgeperc.Tracker`). Those of a sensor that does not spin are gathered
    over the time that its profile says, as of one that stands still.

    It subscribes with the quality of service of sensor data. It publishes ``PREFIX/NAME`` for each of its outputs, each
    only while somebody subscribes, and ``/diagnostics`` once a second, all reliably: best-effort subscribers receive
    them, too. ``ground_points`` and ``obstacle_points`` are the two parts of the cloud with all its fields
    (`edgeperc.road.grid.split_points`); ``rolling`` is the grid with memory, in the frame of the odometry.

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
        With ``rolling`` or ``n_sweeps``, it takes the poses of the odometry, and a cloud without one is answered
        without tracks.
    frame_id : str, optional
        Frame of the answers, by default that of each cloud.
    grid_frame_id : str, optional
        As in `RosMessages`.
    prefix : str
        Name before those of the topics.
    rate_hz : float
        Scans per second of the sensor; an answer is late after two periods and stale after five.
    outputs : sequence of str
        Names of `LIVE_OUTPUTS`, or ``NAME=TOPIC`` for another topic than ``PREFIX/NAME``. If ``detections`` cannot be
        published because vision_msgs is not installed, a warning says so.
    rolling : Rolling, optional
        Odometry and grid of the output ``rolling``; without it, there is none.
    n_sweeps : int, optional
        Clouds in which objects and ground are found together, with the newest one (`edgeperc.Sweeps`); needs a tracker.
        The poses are those of the odometry's topic of ``rolling``, or else an `edgeperc.Odometry` finds them.
    lifecycle : bool
        Begin unconfigured, and wait for `change_state` or, where the graph can, for a lifecycle manager. By default the
        node is active at once.

    Raises
    ------
    MissingExtraError
        rosbags, or what finds the poses for ``n_sweeps``, is not installed.
    OptionError
        A name is not valid, two topics are one, or ``n_sweeps`` is not 2 to 20 or has no tracker.

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
        outputs: Sequence[str] = USUAL_OUTPUTS,
        rolling: Rolling | None = None,
        n_sweeps: int | None = None,
        lifecycle: bool = False,
    ) -> None:
        if frame_id is not None:
            check_text("the frame is", frame_id, OptionError)
        check_rate(rate_hz)
        self._graph, self._perceiver_for = graph, perceiver_for
        self._topic, self._frame_id = topic, frame_id
        self._messages = messages.RosMessages(grid_frame_id=grid_frame_id, lifetime_s=5.0 / rate_hz)
        self._perceiver: Perceiver | None = None
        self._cloud: Any = None
        self._cloud_frame = ""  # of the cloud that the perceiver was made for
        self._stamp_ns: int | None = None
        self._points: Floats32 | None = None
        self._n_earlier = 0  # of these points: those of clouds before the newest
        self._gather_s = 0.0  # time over which scans are gathered, of a sensor that is known not to spin
        self._recent: deque[tuple[int, bytes]] = deque(maxlen=_MOST_GATHERED)  # when they came [ns]
        self._newest: PerceivedScan | None = None
        self._n_failed = self._n_unplaced = 0
        self._pose: Floats | None = None  # of the last cloud in the frame of the odometry
        self._unplaced = ""
        self._rates = _Rates()
        self._error: Exception | None = None
        self._waiting: queue.SimpleQueue[bytes | None] = queue.SimpleQueue()
        self._closed = threading.Event()
        self._tracker, self._rolling, self._poses = tracker, rolling, Poses(self._messages)
        self._forgets = False  # the next cloud begins anew
        self._swept: SweepPerceiver | None = None
        self._n_sweeps, self._odometry = n_sweeps, None
        self._mounting: Mounting | None = None  # that of the last cloud
        if n_sweeps is not None:
            OPTIONS.whole("n_sweeps", n_sweeps, 2, MAX_SWEEPS)
            if tracker is None:
                raise OptionError("n_sweeps needs a tracker, to tell what stands: pass tracker=Tracker()")
            self._odometry = Odometry() if rolling is None else None

        self._topics = _topics_of(outputs, prefix, rolling is not None)
        received = [topic, *([] if rolling is None else [rolling.topic])]
        _check_distinct([*received, *self._topics.values()], graph.name.rpartition("/")[0])
        self._outputs: dict[str, Output] = {}
        self._diagnostics = graph.advertise("/diagnostics", messages.DIAGNOSTICS) if "diagnostics" in outputs else None
        # The queue is empty nearly always: the stream's thread takes what comes, and keeps the newest.
        track = None if tracker is None else self._track
        self._stream = stream(iter(self._waiting.get, None), self._perceive, track, rate_hz=rate_hz)
        self._state: State = "unconfigured"
        self._is_connected, self._changing = False, threading.Lock()
        try:
            self.is_managed = lifecycle and graph.manage(self.change_state)
            for transition in () if lifecycle else ("configure", "activate"):
                self.change_state(transition)
        except BaseException:
            self._waiting.put(None)
            raise
        self._reporter = threading.Thread(target=self._report_always, name="edgeperc-diagnostics", daemon=True)
        self._reporter.start()

    @property
    def state(self) -> State:
        """Of the node's life: unconfigured, inactive, active or finalized."""
        return self._state

    def change_state(self, transition: str) -> State:
        """Configure, activate, deactivate, clean up or shut down the node.

        While it is not active, clouds are ignored and nothing but diagnostics is published. Cleaning up forgets models,
        tracks and the rolling grid; topics stay. Shutting down ends the iteration.

        Parameters
        ----------
        transition : str
            ``"configure"``, ``"activate"``, ``"deactivate"``, ``"cleanup"`` or ``"shutdown"``.

        Returns
        -------
        str
            The new state.

        Raises
        ------
        OptionError
            There is no such transition from the present state; or a topic's name is not valid, or its package missing.
        """
        with self._changing:
            possible = {name: after for name, (before, after) in TRANSITIONS.items() if self._state in before}
            if transition not in possible:
                raise OptionError(
                    f"the transition {transition!r} does not begin at {self._state}; expected one of "
                    f"{', '.join(possible)}"
                )
            if transition == "configure":
                self._connect()
            elif transition == "cleanup":
                self._perceiver, self._swept, self._mounting = None, None, None
                self._newest, self._error, self._forgets = None, None, True
                self._gather_s = 0.0
                self._recent.clear()
            self._state = possible[transition]
            if transition == "shutdown":
                self._waiting.put(None)
            return self._state

    def _connect(self) -> None:
        """Advertise and subscribe, once."""
        if self._is_connected:
            return
        for name, topic in self._topics.items():
            try:
                self._outputs[name] = self._graph.advertise(topic, messages.LIVE_OUTPUTS[name])
            except OptionError as exc:
                if name != "detections":
                    raise
                warnings.warn(f"no detections are published: {exc}", stacklevel=4)
        if self._rolling is not None:
            self._graph.subscribe(self._rolling.topic, ODOMETRY, self._poses.receive)
        self._graph.subscribe(self._topic, messages.CLOUD, self._receive)
        self._is_connected = True

    def _receive(self, data: bytes) -> None:
        if self._state == "active":
            if self._gather_s:
                self._recent.append((time.time_ns(), data))
            self._waiting.put(data)

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
                self._rates.add(self._stream.age_s)
                yield scan

    def _perceive(self, data: bytes, *, stamp_s: float) -> Perception:
        """The answer to the bytes of a cloud. Its own stamp counts, not that of its arrival."""
        if self._forgets:
            self._forgets = False
            if self._tracker is not None:
                self._tracker.reset()
            if self._rolling is not None:
                self._rolling.grid.reset()
            if self._odometry is not None:
                self._odometry.reset()
        if len(data) > MAX_SCAN_BYTES:
            raise PointsError(f"the cloud has {len(data):,} bytes; expected at most {MAX_SCAN_BYTES:,}")
        cloud = self._messages.decode(data, messages.CLOUD)
        if cloud.height * cloud.width > MAX_SCAN_BYTES // 16:
            raise PointsError(
                f"the cloud declares {cloud.height:,} x {cloud.width:,} points; expected at most "
                f"{MAX_SCAN_BYTES // 16:,}"
            )
        points = cloud_points(cloud)
        perceiver = self._perceiver
        if perceiver is None:
            perceiver = self._perceiver = self._perceiver_for(describe_cloud(self._topic, cloud))
            if self._n_sweeps is not None and self._tracker is not None:
                self._swept = SweepPerceiver(perceiver, self._tracker, self._odometry or self._placed, self._n_sweeps)
            self._cloud_frame = cloud.header.frame_id
            if (pattern := perceiver.sensor.pattern) is not None:
                self._recent.append((time.time_ns(), data))
                self._gather_s = pattern.accumulate_s
        if cloud.header.frame_id != self._cloud_frame:
            raise PointsError(
                f"the cloud has the frame {cloud.header.frame_id!r}, and the first one {self._cloud_frame!r}: it is of "
                "another sensor. Give each sensor a topic and a node of its own, or start this one anew"
            )
        stamp_ns = cloud.header.stamp.sec * 10**9 + cloud.header.stamp.nanosec or time.time_ns()
        self._messages.frame_id = self._frame_id or cloud.header.frame_id or "lidar"
        if self._gather_s:
            earlier = [*self._earlier(data, stamp_ns, self._gather_s)]
            self._n_earlier = sum(map(len, earlier))
            points = np.concatenate([*earlier, points])
        self._pose, self._cloud, self._stamp_ns = None, cloud, stamp_ns
        perception = (self._swept or perceiver)(points, stamp_s=Stamp(stamp_ns * 1e-9, stamp_ns))
        self._points, self._sensor, self._mounting = points, perceiver.sensor, perception.mounting
        if self._rolling is not None and self._pose is None:
            self._pose = self._pose_at(self._rolling, perception.mounting)
            self._n_unplaced += self._pose is None
        return perception

    def _placed(self, points: ArrayLike, stamp_s: float) -> Floats | None:
        """Pose of the cloud before it is perceived: the sensor is mounted as in the one before."""
        if self._rolling is not None and self._mounting is not None:
            self._pose = self._pose_at(self._rolling, self._mounting)
        return self._pose

    def _pose_at(self, rolling: Rolling, mounting: Mounting) -> Floats | None:
        assert self._stamp_ns is not None
        pose = self._poses.at(self._stamp_ns)
        if pose is None:
            self._unplaced = "no pose at the time of the cloud"
            return None
        frames = self._poses.child_frame_id, str(self._cloud.header.frame_id)
        return pose @ rolling.base_from_sensor(*frames, mounting)

    def _track(self, perception: Perception) -> Tracks | None:
        """The tracks; None with an odometry that has no pose of the cloud, without which they would begin anew."""
        if self._swept is not None:
            return self._swept.track(perception)
        assert self._tracker is not None
        if self._rolling is not None and self._pose is None:
            return None
        return self._tracker(perception, self._pose)

    def _earlier(self, newest: bytes, stamp_ns: int, gather_s: float) -> Iterator[Floats32]:
        """Points of the clouds that came in the time before the newest, dropped ones, too: `edgeperc.accumulate`."""
        for came_ns, data in takewhile(lambda each: each[1] is not newest, tuple(self._recent)):
            try:
                cloud = self._messages.decode(data, messages.CLOUD)
                stamp = cloud.header.stamp
                is_recent = 0 < stamp_ns - (stamp.sec * 10**9 + stamp.nanosec or came_ns) < gather_s * 1e9
                if is_recent and cloud.header.frame_id == self._cloud_frame:
                    yield cloud_points(cloud)
            except PointsError:  # which is told of a cloud that is the newest
                continue

    def _publish(self, answer: Answer) -> PerceivedScan:
        assert self._points is not None
        assert answer.perception.stamp_s is not None
        scan = PerceivedScan(
            name=f"{self._topic}/{answer.n_scans - 1:06d}",
            stamp_s=answer.perception.stamp_s,
            points=self._points,
            perception=answer.perception,
            tracks=answer.tracks,
            sensor=self._sensor,
            health=answer.health,
        )
        if self._state != "active":
            return scan
        parts: Split | None = None
        for name, output in self._outputs.items():
            if name == messages.ROLLING or not output.is_wanted:
                continue
            if name in (messages.GROUND_POINTS, messages.OBSTACLE_POINTS):
                parts = parts or split_points(scan.perception, scan.points, sensor=scan.sensor)
                mask = parts.ground if name == messages.GROUND_POINTS else parts.obstacle
                message = self._messages.part(scan, self._cloud, mask[self._n_earlier :], self._stamp_ns)
            else:
                message = getattr(self._messages, name)(scan, self._stamp_ns)
            output.publish(self._messages.encode(message))
        self._remember(scan)
        return scan

    def _remember(self, scan: PerceivedScan) -> None:
        """Take a scan with a pose into the rolling grid and publish it."""
        if self._rolling is None or self._pose is None:
            return
        assert self._stamp_ns is not None
        try:
            self._rolling.grid.update(scan.perception, scan.points, self._pose, tracks=scan.tracked or ())
        except TrackingError as exc:
            self._pose, self._unplaced, self._n_unplaced = None, str(exc), self._n_unplaced + 1
            return
        if self._outputs[messages.ROLLING].is_wanted:
            message = self._messages.rolling(self._rolling.grid, self._poses.frame_id, self._stamp_ns)
            self._outputs[messages.ROLLING].publish(self._messages.encode(message))

    def _report_always(self) -> None:
        """Body of the thread that publishes the diagnostics, also while a scan is perceived."""
        while not self._closed.wait(REPORT_EVERY_S) and self._diagnostics is not None:
            self._diagnostics.publish(self._messages.encode(self._report()))

    def _report(self) -> Any:
        n_failed, rates = self._rates.taken(self.n_scans, self._n_failed)
        error, newest = self._error, self._newest
        level: int | None = None
        message: str | None = None
        if self._state != "active":
            level, message = 0, self._state
        elif error is not None:
            level, message = 2, f"{type(error).__name__}: {error}"
        elif newest is not None:
            health = self._stream.health
            level, message = {"OK": (0, "OK"), "LATE": (1, "LATE"), "STALE": (3, "STALE: no answer of late")}[health]
            if level == 0 and n_failed:
                level, message = 1, f"{n_failed} clouds of the last second failed"
            elif level == 0 and self._rolling is not None and self._pose is None:
                level, message = 1, f"the odometry does not place the newest cloud: {self._unplaced}"
        values = {
            "topic": self._topic,
            "state": self._state,
            "clouds received": self.n_scans,
            "clouds dropped": self.n_dropped,
            "clouds failed": self._n_failed,
            "answers": self._rates.n_answers,
            **rates,
        }
        if newest is not None:
            values["age of the newest answer [ms]"] = f"{1e3 * self._stream.age_s:.0f}"
        if self._rolling is not None:
            values |= {"clouds without a pose": self._n_unplaced, "odometry not read": self._poses.n_failed}
            values |= {"the last of them": self._unplaced} if self._unplaced else {}
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


class _Rates:
    """Counts answers, and what came since the last report."""

    def __init__(self) -> None:
        self.n_answers = 0
        self._last = (time.monotonic(), 0, 0, 0)
        self._latencies_s: deque[float] = deque(maxlen=_LATENCIES)

    def add(self, latency_s: float) -> None:
        self._latencies_s.append(latency_s)
        self.n_answers += 1

    def taken(self, n_clouds: int, n_failed: int) -> tuple[int, dict[str, str]]:
        """Clouds that failed since the last report; rates since then, and latencies of the last answers."""
        last, self._last = self._last, (time.monotonic(), n_clouds, self.n_answers, n_failed)
        elapsed_s, clouds, answers, failed = (now - then for now, then in zip(self._last, last, strict=True))
        elapsed_s = max(elapsed_s, 1e-3)
        values = {"clouds [Hz]": f"{clouds / elapsed_s:.1f}", "answers [Hz]": f"{answers / elapsed_s:.1f}"}
        if self._latencies_s:
            latencies_ms = 1e3 * np.percentile(np.array(self._latencies_s), (50, 99))
            values |= {f"latency p{p} [ms]": f"{ms:.0f}" for p, ms in zip((50, 99), latencies_ms, strict=True)}
        return int(failed), values


def _topics_of(outputs: Sequence[str], prefix: str, with_rolling: bool) -> dict[str, str]:
    """The topic of each output. Raises OptionError."""
    topics: dict[str, str] = {}
    for text in outputs:
        name, _, topic = text.partition("=")
        if name not in messages.LIVE_OUTPUTS or (topic and name == "diagnostics"):
            raise OptionError(
                f"outputs has {text!r}; expected some of {', '.join(messages.LIVE_OUTPUTS)}, or NAME=TOPIC"
            )
        if "=" in text:
            full_name(topic)
        if name == messages.ROLLING and not with_rolling:
            raise OptionError(
                "the output rolling needs poses; pass rolling= or --odometry, with a topic of nav_msgs/Odometry"
            )
        full = topic or f"{prefix.rstrip('/')}/{name}"
        if topics.setdefault(name, full) != full:
            raise OptionError(f"outputs has {name} with two topics, {topics[name]} and {full}; expected one")
    topics.pop("diagnostics", None)
    if with_rolling:
        topics.setdefault(messages.ROLLING, f"{prefix.rstrip('/')}/{messages.ROLLING}")
    return topics


def _check_distinct(topics: Sequence[str], namespace: str) -> None:
    """Refuse two things on one topic: the node would answer itself, or wait for ever. Raises OptionError."""
    full = [name if name.startswith("/") else f"{namespace}/{name}" for name in topics]
    if twice := sorted({name for name in full if full.count(name) > 1}):
        raise OptionError(
            f"clouds, odometry and outputs share the topic {', '.join(twice)}; expected one for each: another prefix, "
            "or NAME=TOPIC"
        )
