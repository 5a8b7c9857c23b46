"""Live sources: perceive the newest scan and drop older ones, without a queue."""

from __future__ import annotations

import math
import os
import threading
import time
import warnings
import weakref
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from numbers import Real
from pathlib import Path
from typing import Any, Literal

from .errors import EdgepercError, OptionError, PointsError, StampError
from .readers.captures import read_scans, sensor_of
from .readers.identify import contradicts
from .readers.ports import is_port
from .readers.times import TimedScan, accumulate
from .system.clock import LATEST_S, Clock, as_seconds
from .system.fields import MAX_NUMBER, SCANS
from .types.perception import Perception
from .types.points import as_points
from .types.sensor import SensorProfile

Health = Literal["OK", "LATE", "STALE"]

# Longest time that `Stream.close` waits for the reading thread.
PATIENCE_S = 1.0

# Longest pause of a recording that is replayed as it is [s], or 5 periods of the sensor if these are longer.
_PAUSE_S = 2.0


@dataclass(frozen=True, slots=True, eq=False)
class Answer:
    """The perception of the newest scan, and its age.

    Attributes
    ----------
    points : array_like
        The scan as the source supplied it; ``perception.points.labels`` holds a label for each of its points.
    perception : Perception
    tracks : object
        Result of the tracker; None without a tracker, or if the tracker raises `StampError` because the scan's time is
        not finite or out of its range.
    stamp_s : float
        Time stamp from the source [s]; without one, the arrival time on this computer's monotonic clock.
    age_s : float
        Time from the arrival of the scan until the answer was ready [s].
    health : {"OK", "LATE", "STALE"}
        From ``age_s``, see `Stream`.
    n_scans : int
        Number of scans that had arrived when this one was taken.
    n_dropped : int
        Number of them that were dropped because a newer scan had arrived.
    """

    points: Any
    perception: Perception
    tracks: Any
    stamp_s: float
    age_s: float
    health: Health
    n_scans: int
    n_dropped: int


def stream(
    source: str | os.PathLike[str] | Iterable[Any],
    perceiver: Callable[..., Perception],
    tracker: Callable[[Perception], Any] | None = None,
    *,
    rate_hz: float = 10.0,
    late_after_s: float | None = None,
    stale_after_s: float | None = None,
    topic: str | None = None,
    accumulate_s: float | None = None,
) -> Stream:
    """Perceive the newest scan of a live source, repeatedly. Reading begins immediately.

    Parameters
    ----------
    source : iterable, str or path
        Either an iterable of scans, each as points or as a tuple (stamp_s, points). A thread reads it as fast as
        possible; the source must not change a scan afterwards. Or the path of a scan, a folder or a capture
        (`edgeperc.read_scans`), replayed in real time: by its stamps or, without stamps, at ``rate_hz``. A step back in
        its stamps, or a pause of more than 2 s or 5 periods of the sensor, is replayed as one period. Or ports to which
        a sensor sends its packets, ``udp:2368``.
    perceiver : callable
        ``perceiver(points, stamp_s=stamp_s) -> Perception``, such as a `Perceiver`.
    tracker : callable, optional
        ``tracker(perception) -> tracks``.
    rate_hz : float
        Scans per second of the sensor [Hz].
    late_after_s, stale_after_s : float, optional
        Ages above which an answer is late or stale [s]; by default two and five periods of the sensor.
    topic : str, optional
        As in `edgeperc.read_scans`.
    accumulate_s : float, optional
        Time over which each scan is gathered, of a sensor that stands still and does not spin (`edgeperc.accumulate`)
        [s]; scans of an iterable then have stamps. By default, each scan is perceived by itself.

    Returns
    -------
    Stream
        An iterator of `Answer`; use it in a ``with`` block.

    Raises
    ------
    PointsError
        The source is neither iterable nor a path, or the path does not exist.
    OptionError
        Perceiver or tracker cannot be called, the rate is not above 0, or not 0 < late_after_s <= stale_after_s.

    Warns
    -----
    UserWarning
        The source is a capture of another sensor than the perceiver's. While iterating, once: the tracker raised
        `StampError`.

    Examples
    --------
    >>> with stream("drive/velodyne", perceive) as live:        # doctest: +SKIP
    ...     for answer in live:
    ...         print(answer.age_s, answer.health, answer.n_dropped, answer.perception.boxes)
    """
    check_rate(rate_hz)
    given = (perceiver,) if tracker is None else (perceiver, tracker)
    if not all(callable(each) and not isinstance(each, type) for each in given):  # a class can be called, too
        told = f"perceiver is {perceiver!r:.200} and tracker {tracker!r:.200}"
        raise OptionError(f"{told}; expected a Perceiver, and a Tracker or None")
    if not all(isinstance(age_s, Real | None) for age_s in (late_after_s, stale_after_s)):
        raise OptionError(f"late_after_s is {late_after_s!r} and stale_after_s {stale_after_s!r}; expected seconds")
    late_s = 2.0 / rate_hz if late_after_s is None else late_after_s
    stale_s = max(5.0 / rate_hz, late_s) if stale_after_s is None else stale_after_s
    if not 0.0 < late_s <= stale_s:
        raise OptionError(f"late_after_s is {late_s} and stale_after_s {stale_s}; expected 0 < late <= stale")
    inbox = _Inbox()
    if isinstance(source, str | os.PathLike):
        _warn_of_another_sensor(source, perceiver, topic)
        read = read_scans(Path(source), topic=topic, accumulate_s=accumulate_s)
        scans: Iterator[Any] = read if is_port(Path(source)) else paced(read, rate_hz, inbox.stopped)
    else:
        scans = SCANS.iterator("source", source, "scans or a path")
        if accumulate_s is not None:
            timed = (TimedScan(stamp_s, as_points(points), None) for points, stamp_s in map(_stamped, scans))
            scans = ((stamp_s, points) for stamp_s, points, _ in accumulate(timed, accumulate_s))
    return Stream(inbox, scans, perceiver, tracker, late_s, stale_s)


def check_rate(rate_hz: float) -> None:
    """Refuse a rate that is none. Raises OptionError."""
    if not (isinstance(rate_hz, Real) and 0.0 < rate_hz <= MAX_NUMBER):
        raise OptionError(f"rate_hz is {rate_hz!r}; expected scans a second, above 0")


def _warn_of_another_sensor(source: str | os.PathLike[str], perceiver: object, topic: str | None) -> None:
    profile = getattr(perceiver, "sensor", None)
    try:
        recorded_by = sensor_of(source, topic=topic) if isinstance(profile, SensorProfile) else None
    except EdgepercError:  # it need not name its sensor, and reading it tells of damage
        return
    if profile is not None and recorded_by is not None and contradicts(profile, recorded_by):
        warnings.warn(
            f"{os.fspath(source)}: the perceiver's sensor is {profile.name}, the capture names {recorded_by.name}; "
            "pass sensor=edgeperc.sensor_of(source) to the Perceiver",
            stacklevel=3,
        )


class Stream:
    """An iterator of `Answer` that reads its source in a thread; made by `stream`.

    Only the newest scan is kept. Perceiver and tracker run in the caller's thread when the next answer is requested.
    Their errors are raised there, and the next scan can still be requested. A scan without a usable time, of which the
    tracker raises `StampError`, is answered without tracks, and a warning says so once. An error of the source is
    raised after the answer to the last scan, and ends the stream.

    Health depends on age only: ``"OK"`` up to ``late_after_s``, ``"LATE"`` up to ``stale_after_s``, then ``"STALE"``.
    The health of an answer refers to the moment when it was ready. The health of the stream refers to the present age
    of the newest answer, so it also shows that a source has stopped. Any thread may read it while another waits for an
    answer.

    Reading stops at the end of the ``with`` block, at `close`, and when the stream is deleted. A source that blocks
    forever cannot be interrupted. Its thread holds no reference to the perceiver or to results, ends at the next scan,
    and does not keep the process alive.

    Attributes
    ----------
    late_after_s, stale_after_s : float
        Ages above which an answer is late or stale [s].
    """

    def __init__(
        self,
        inbox: _Inbox,
        scans: Iterator[Any],
        perceiver: Callable[..., Perception],
        tracker: Callable[[Perception], Any] | None,
        late_after_s: float,
        stale_after_s: float,
    ) -> None:
        self.late_after_s, self.stale_after_s = late_after_s, stale_after_s
        self.inbox, self._perceiver, self._tracker = inbox, perceiver, tracker
        self._newest_s = -math.inf
        self._is_untimed_reported = False
        self._thread = threading.Thread(target=_read, args=(scans, inbox), name="edgeperc-source", daemon=True)
        weakref.finalize(self, inbox.stop)
        self._thread.start()

    def __iter__(self) -> Stream:
        return self

    def __next__(self) -> Answer:
        answer = self.take()
        assert answer is not None
        return answer

    def take(self, timeout_s: float | None = None) -> Answer | None:
        """Like ``next()``, with a time limit.

        Parameters
        ----------
        timeout_s : float, optional
            Longest wait for a scan, without the time to perceive it.

        Returns
        -------
        Answer or None
            None if no scan arrived in time.

        Raises
        ------
        StopIteration
            The source is at its end, or the stream is closed. asyncio cannot take it from a thread, and waits for
            ever before Python 3.12: pass ``asyncio.to_thread`` the function ``next``, the stream and None.
        Exception
            Any error of the source, the perceiver or the tracker.
        """
        taken = self.inbox.take(timeout_s)
        if taken is None:
            return None
        (points, stamp_s, arrived_s), n_scans, n_dropped = taken
        perception = self._perceiver(points, stamp_s=stamp_s)
        tracks = self._tracked(perception)
        self._newest_s = arrived_s
        age_s = time.monotonic() - arrived_s
        return Answer(points, perception, tracks, stamp_s, age_s, self._health_at(age_s), n_scans, n_dropped)

    def _tracked(self, perception: Perception) -> Any:
        """What the tracker returns; None if the scan has no usable time."""
        if self._tracker is None:
            return None
        try:
            return self._tracker(perception)
        except StampError as exc:
            if not self._is_untimed_reported:
                self._is_untimed_reported = True
                warnings.warn(f"a scan is answered without tracks: {exc} (said once)", stacklevel=3)
            return None

    @property
    def age_s(self) -> float:
        """Time since the arrival of the newest answered scan [s]; infinite before the first."""
        return time.monotonic() - self._newest_s

    @property
    def health(self) -> Health:
        """Health at the present `age_s`."""
        return self._health_at(self.age_s)

    def _health_at(self, age_s: float) -> Health:
        if age_s > self.stale_after_s:
            return "STALE"
        return "LATE" if age_s > self.late_after_s else "OK"

    @property
    def n_scans(self) -> int:
        """Number of scans that have arrived."""
        return self.inbox.n_scans

    @property
    def n_dropped(self) -> int:
        """Number of scans that were dropped because a newer scan had arrived."""
        return self.inbox.n_dropped

    def close(self) -> None:
        """Stop reading. Wait up to 1 s for the reading thread. Waiting calls of `take` raise StopIteration."""
        self.inbox.stop()
        self._thread.join(PATIENCE_S)

    def __enter__(self) -> Stream:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class _Inbox:
    """Hands the newest scan from the reading thread to the caller's thread."""

    def __init__(self) -> None:
        self.stopped = threading.Event()
        self.n_scans, self.n_dropped, self._made_in = 0, 0, os.getpid()
        # Entered as a lock: a signal while a condition is entered leaves it locked.
        self._lock = threading.RLock()
        self._changed = threading.Condition(self._lock)
        self._scan: tuple[Any, float, float] | None = None
        self._ended = False
        self._error: BaseException | None = None

    def put(self, points: Any, stamp_s: float | None) -> None:
        arrived_s = time.monotonic()
        with self._lock:
            self.n_scans += 1
            self.n_dropped += self._scan is not None
            self._scan = points, arrived_s if stamp_s is None else stamp_s, arrived_s
            self._changed.notify()

    def end(self, error: BaseException | None) -> None:
        with self._lock:
            self._ended, self._error = True, error
            self._changed.notify_all()

    def stop(self) -> None:
        with self._lock:
            self.stopped.set()
            self._changed.notify_all()

    def take(self, timeout_s: float | None) -> tuple[tuple[Any, float, float], int, int] | None:
        if os.getpid() != self._made_in:
            raise EdgepercError(f"this stream is read by process {self._made_in}; make another one in its fork")
        if timeout_s is not None and timeout_s > threading.TIMEOUT_MAX:
            timeout_s = None
        with self._lock:
            if not self._changed.wait_for(lambda: self._scan or self._ended or self.stopped.is_set(), timeout_s):
                return None
            if self.stopped.is_set():
                raise StopIteration
            scan, self._scan = self._scan, None
            if scan is not None:
                return scan, self.n_scans, self.n_dropped
            error, self._error = self._error, None
        if error is not None:
            raise error
        raise StopIteration


def _read(scans: Iterator[Any], inbox: _Inbox) -> None:
    """Body of the reading thread: put every scan into the inbox, then the end or the error."""
    error: BaseException | None = None
    try:
        for scan in scans:
            if inbox.stopped.is_set():
                break
            inbox.put(*_stamped(scan))
    except BaseException as exc:  # raised by the next `take`
        error = exc
    inbox.end(error)


def _stamped(scan: Any) -> tuple[Any, float | None]:
    if not isinstance(scan, tuple):
        return scan, None
    try:
        stamp_s, points = scan
        return points, None if stamp_s is None else as_seconds(stamp_s)
    except (TypeError, ValueError) as exc:
        raise PointsError(f"got a tuple that is not a scan ({exc}); expected points or (stamp_s, points)") from exc


def paced(
    scans: Iterator[tuple[float | None, Any]], rate_hz: float, stopped: threading.Event
) -> Iterator[tuple[float, Any]]:
    """Yield recorded scans in real time, by their stamps or at the sensor's rate. Late scans come immediately.

    A scan without a usable time, or after a jump of the clock, comes one period after the one before.
    """
    period_s = 1.0 / rate_hz
    clock = Clock(gap_s=max(_PAUSE_S, 5.0 * period_s))
    due_s = -math.inf
    for k, (stamp_s, points) in enumerate(scans):
        moment_s = k * period_s if stamp_s is None else stamp_s
        last_s, wait_s = clock.last_s, period_s
        if abs(moment_s) <= LATEST_S:
            step, clock = clock.after(moment_s)
            if step == "late":
                wait_s = 0.0
            elif step == "next" and last_s is not None:
                wait_s = moment_s - last_s
        # The time starts after the first scan, because reading it may import libraries.
        due_s = time.monotonic() if k == 0 else due_s + wait_s
        if stopped.wait(max(0.0, due_s - time.monotonic())):
            return
        yield moment_s, points
