"""One run of a camera: three threads that never wait for each other, and their counters.

    camera -> acquisition -+-> ring of N frames -> recorder -> DIR/frames.raw
                           +-> ring of 1 frame  -> live view -> DIR/live.jpg, page

The acquisition puts every frame into both rings. The recorder's ring drops its oldest frame when the disk is slower
than the camera for longer than N frames; the ring of the live view always holds the newest. At the end received =
recorded + dropped. After a camera is lost, connecting is tried every second, and the same recording continues.
"""

from __future__ import annotations

import math
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, nullcontext
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from types import FrameType
from typing import Any

from polsep.capture.folder import FolderSource
from polsep.capture.live import LiveView, Shown
from polsep.capture.page import serve_page
from polsep.capture.ring import Ring
from polsep.capture.sources import Camera, CameraError, CameraInfo, CameraLost, CameraSource, EndOfFrames, Loss
from polsep.io.raw.recording import INDEX, PICTURE, RAW, RECORD, Header, RawImage, RecordingWriter, refuse_recording
from polsep.io.store.atomic import OutputError, refuse_inputs
from polsep.physics.stokes import axis_deg
from polsep.sensor.camera import Layout

#: Seconds between attempts to connect to a lost camera.
RETRY_S = 1.0
#: Longest wait of a thread before it checks whether to stop.
TICK_S = 0.2


@dataclass(frozen=True)
class Limits:
    """Limits of a run: seconds of acquisition or frames received, whichever is first; or a camera lost for
    ``timeout_s``. ``ring``: frames buffered while the disk is busy. Raises ValueError on numbers of 0 or less.
    """

    seconds: float | None = None
    frames: int | None = None
    timeout_s: float = 30.0
    ring: int = 32

    def __post_init__(self) -> None:
        for name, value in asdict(self).items():
            if value is not None and not value > 0:
                raise ValueError(f"expected {name} above 0, found {value:g}")


@dataclass(frozen=True)
class CapturePlan:
    """Plan of a capture: record into ``output``, separate with ``method``, serve a page on ``port``.

    None leaves each of them out. ``layout``: of the mosaic; None is that of a recording that is played, else derived
    from the name of the pixel format.
    ``calibration`` and ``ambient``: files that correct the frames shown; recorded ones stay as the camera sent them.
    """

    output: Path | None = None
    method: str | None = "auto-fast"
    layout: Layout | None = None
    port: int | None = None
    overwrite: bool = False
    calibration: Path | None = None
    ambient: tuple[Path, ...] = ()


@dataclass
class Counters:
    """Frames received complete, lost in transfer, dropped by a full ring, recorded, shown; interruptions.

    Each number is written by one thread only.
    """

    received: int = 0
    lost: int = 0
    dropped: int = 0
    recorded: int = 0
    shown: int = 0
    interruptions: int = 0
    away_s: float = 0.0


@dataclass(frozen=True)
class Status:
    """State of a run: seconds of acquisition, recent frames per second, counters, angle of the light's polarizer."""

    seconds: float
    rate_hz: float
    counters: Counters
    light_deg: float | None = None

    def line(self) -> str:
        """The status as one line for the terminal."""
        count = self.counters
        light = "" if self.light_deg is None else f", light {axis_deg(self.light_deg):.0f} deg"
        away = f", {count.interruptions} interruptions ({count.away_s:.1f} s)" if count.interruptions else ""
        return (
            f"{self.seconds:.1f} s, {self.rate_hz:.1f} frames/s: {count.received} received, {count.lost} lost, "
            f"{count.dropped} dropped, {count.recorded} recorded, {count.shown} shown{away}{light}"
        )


def _refuse_folder_of(files: Sequence[Path], output: Path) -> None:
    """Raise OutputError where a recording would be written beside the frames of its source, and hide them."""
    if os.path.realpath(output) in {os.path.realpath(file.parent) for file in files}:
        raise OutputError(
            f"expected a folder apart from that of the frames, found {output}: a recording would hide them"
        )


class Session:
    """The state that the threads of one run share; callers only use `run`, `stop` and `status`."""

    def __init__(self, source: CameraSource, plan: CapturePlan, limits: Limits, notify: Callable[[str], None]) -> None:
        """``notify`` receives lines for the user.

        Raises OutputError if a recording exists and may not be replaced, or is what the run reads.
        """
        if plan.output is not None:
            read = [*plan.ambient, *([plan.calibration] if plan.calibration is not None else [])]
            played = source.files if isinstance(source, FolderSource) else []
            read += played
            refuse_inputs([plan.output / name for name in (RAW, INDEX, RECORD, PICTURE)], read)
            _refuse_folder_of(played, plan.output)
            refuse_recording(plan.output, plan.overwrite)
        self._source, self._plan, self._limits, self._notify = source, plan, limits, notify
        picture = plan.output / PICTURE if plan.output is not None else None
        corrections = (plan.calibration, plan.ambient)
        self._live = LiveView(plan.method, plan.layout, picture, *corrections) if plan.method is not None else None
        self._to_disk: Ring[RawImage] = Ring(limits.ring)
        self._to_view: Ring[RawImage] = Ring(1)
        self._stop, self._view_ready = threading.Event(), threading.Event()
        self._failures: list[Exception] = []
        self._info: CameraInfo | None = None
        self._writer: RecordingWriter | None = None
        self._counters, self._interruptions = Counters(), list[dict[str, Any]]()
        self._started, self._last = 0.0, 0.0
        self._back_at = math.inf
        self._away_since, self._lost_at = 0.0, 0.0  # last frame before an interruption; the loss that is waited out
        self._incomplete = 0  # incomplete frames since the last complete one
        self._unwritten = 0  # frames queued for a recorder that failed
        self._began, self._line, self._reason = "", "waiting for the camera", ""
        self._recent: list[tuple[float, int]] = []

    def run(self, report: Callable[[Status], None], every_s: float = 0.5) -> Status:
        """Capture until the limits, the end of the source or `stop`; ``report`` receives the status regularly.

        Ctrl-C, SIGTERM and SIGHUP call `stop`; the second one ends. Raises CameraError if the camera is missing or
        does not come back, OutputError if the disk is full, ValueError if the method does not fit the frames. The
        recording up to then is complete.
        """
        port = self._plan.port
        page = nullcontext("") if port is None else serve_page(port, self._shown, lambda: self._line)
        with page as address, _stopping(self.stop):
            if address:
                self._notify(f"live view at {address}")
            acquisition, recorder = self._thread(self._acquire), self._thread(self._record)
            view = self._thread(self._view)
            while acquisition.is_alive():
                acquisition.join(every_s)
                status = self.status()
                self._line = status.line()
                report(status)
            recorder.join()
            view.join()
        self._finish()
        ended = self.status()
        return replace(ended, rate_hz=(ended.counters.received - 1) / ended.seconds if ended.seconds > 0 else 0.0)

    def _finish(self) -> None:
        """Finish the record, and raise the first error."""
        if self._writer is not None:
            if self._failures:  # a failed recorder leaves frames in its ring
                self._unwritten = self._counters.received - self._counters.recorded - self._to_disk.dropped
            try:
                self._update_record(finished=not self._failures)
            except OSError as error:
                self._failures.append(OutputError(f"expected to finish the record, found: {error}"))
            self._writer.close()
        if self._failures:
            raise self._failures[0]

    def stop(self) -> None:
        """End the run after the frames received so far."""
        self._stop.set()

    def status(self) -> Status:
        """The state of the run."""
        counters = replace(self._counters, dropped=self._to_disk.dropped + self._unwritten)
        now = time.monotonic()
        recent = [*(point for point in self._recent if now - point[0] < 3), (now, counters.received)]
        self._recent = recent
        rate = (recent[-1][1] - recent[0][1]) / max(recent[-1][0] - recent[0][0], 1e-9)
        shown = self._shown()
        seconds = self._last - self._started if counters.received else 0.0
        return Status(seconds, rate, counters, shown.light_deg if shown else None)

    def _shown(self) -> Shown | None:
        """The latest picture."""
        return None if self._live is None else self._live.latest

    def _thread(self, work: Callable[[], None]) -> threading.Thread:
        """A running thread whose failure ends the run."""

        def guarded() -> None:
            try:
                work()
            except Exception as error:
                self._failures.append(error)
                self.stop()

        thread = threading.Thread(target=guarded, name=work.__name__, daemon=True)
        thread.start()
        return thread

    def _acquire(self) -> None:
        """Connect, deliver frames, and connect again after a loss, until the run is over."""
        try:
            while True:
                with ExitStack() as stack:
                    camera = self._connect(stack)
                    if camera is None:
                        return
                    try:
                        self._prepare(camera.info)
                        camera.start()
                        # A triggered camera is back with its start, if it stays: it may send nothing for any time.
                        self._back_at = time.monotonic() if math.isinf(camera.info.patience_s) else math.inf
                        self._started = self._started or time.monotonic()
                        self._pump(camera)
                        return
                    except EndOfFrames:
                        return
                    except CameraLost as error:
                        self._note_loss(error)
        finally:
            if self._away_since:
                self._counters.away_s += time.monotonic() - self._away_since
            self._to_disk.close()
            self._to_view.close()

    def _connect(self, stack: ExitStack) -> Camera | None:
        """The connected camera; after a loss, retry until the timeout. None if the run ends meanwhile."""
        limit = self._limits.timeout_s
        while True:
            if self._lost_at:
                if time.monotonic() - self._lost_at > limit:
                    raise CameraError(f"expected the camera back within {limit:g} s, found: {self._reason}")
                if self._stop.wait(RETRY_S) or self._over():
                    return None
            try:
                return stack.enter_context(self._source.connect())
            except CameraError as error:
                if not self._lost_at:
                    raise
                self._reason = str(error)

    def _prepare(self, info: CameraInfo) -> None:
        """Prepare for frames of this format; after an interruption, check that it is the same format."""
        if self._info is not None:
            if info.describe() != self._info.describe():
                raise CameraError(f"expected the camera back with {self._info.describe()}, found {info.describe()}")
            return
        layout = self._plan.layout.spec if self._plan.layout is not None else info.layout
        header = Header(info.width, info.height, info.pixel_format, info.name, info.settings, layout)
        self._info = info
        while self._live is not None and not self._view_ready.wait(TICK_S):  # only here the recorder waits for the view
            if self._stop.is_set():
                return
        if self._plan.output is not None:
            self._writer = RecordingWriter(self._plan.output, header, self._plan.overwrite)
        self._notify(f"{info.name}: {info.describe()}")

    def _pump(self, camera: Camera) -> None:
        """Deliver frames until the run is over. Raises CameraLost when no frame comes for too long."""
        quiet_since = time.monotonic()
        while not self._over():
            event = camera.read(TICK_S)
            now = time.monotonic()
            if event is None:
                if now - quiet_since > camera.info.patience_s:
                    raise CameraLost(f"no frame for {now - quiet_since:.0f} s")
                continue
            quiet_since = now
            if isinstance(event, Loss):
                self._incomplete += 1
                self._count_lost(1, event.reason)
            else:
                self._deliver(event, now)

    def _over(self) -> bool:
        """True if the run should end."""
        limits, now = self._limits, time.monotonic()
        late = limits.seconds is not None and self._started > 0 and now - self._started >= limits.seconds
        enough = limits.frames is not None and self._counters.received >= limits.frames
        return self._stop.is_set() or late or enough

    def _deliver(self, image: RawImage, now: float) -> None:
        """Count a frame and pass it to the recorder and the live view."""
        lost = max(image.lost_before, self._incomplete)
        if lost > self._incomplete:  # incomplete frames are already counted
            self._count_lost(lost - self._incomplete, f"ids are missing before frame {image.frame_id}")
        self._incomplete, image = 0, replace(image, lost_before=lost)
        if self._away_since:
            away, self._away_since, self._lost_at = now - self._away_since, 0.0, 0.0
            self._counters.away_s += away
            self._interruptions.append({"received_before": self._counters.received, "seconds": round(away, 3)})
            self._notify(f"camera back after {away:.1f} s, frames in between are not counted as lost")
            image = replace(image, away_s=away)
        if not self._counters.received:  # a trigger may have let it wait for any time
            self._began = datetime.now(UTC).isoformat(timespec="milliseconds")
        self._counters.received += 1
        self._last = now
        if self._plan.output is not None:
            self._to_disk.put(image)
        if self._live is not None:
            self._to_view.put(image)

    def _count_lost(self, frames: int, reason: str) -> None:
        """Count frames lost in transfer; notify the user the first time."""
        if not self._counters.lost:
            self._notify(f"lost in transfer: {reason}; further losses are only counted")
        self._counters.lost += frames

    def _note_loss(self, error: CameraLost) -> None:
        """Notify the user of a lost camera, until it is back, and count the interruption."""
        self._reason, now = str(error), time.monotonic()
        if not self._away_since:
            self._away_since = self._last or now
            self._counters.interruptions += 1
        if self._lost_at and now - self._back_at <= self._limits.timeout_s:
            return
        self._lost_at = now
        self._notify(f"camera lost: {error}; trying again every second for {self._limits.timeout_s:g} s")

    def _record(self) -> None:
        """Write every frame of the recorder's ring to the disk, in the recorder's thread."""
        while not self._to_disk.finished:
            image = self._to_disk.take(TICK_S)
            if image is None:
                continue
            assert self._writer is not None, "expected a writer before the first frame"
            try:
                self._writer.append(image)
            except OSError as error:
                reason = error.strerror or str(error)
                raise OutputError(f"expected to keep recording into {self._plan.output}, found: {reason}") from None
            self._counters.recorded += 1

    def _view(self) -> None:
        """Show the newest frame repeatedly, in the live view's thread."""
        if self._live is None:
            return
        while self._info is None:
            if self._to_view.finished:
                return
            time.sleep(0.01)
        self._live.warm_up(self._info)
        self._view_ready.set()
        try:
            self._show_frames(self._live)
        except (ValueError, RuntimeError, OSError) as error:
            self._failures.append(ValueError(f"expected to show every frame, found: {error}"))
            self._notify(f"the live view has ended, the recording continues: {error}")

    def _show_frames(self, live: LiveView) -> None:
        """Show the newest frame until there are no more; notify the user of remarks on the first."""
        while not self._to_view.finished:
            image = self._to_view.take(TICK_S)
            if image is None:
                continue
            shown = live.show(image)
            for remark in shown.remarks if not self._counters.shown else ():
                self._notify(f"frame {image.frame_id}: {remark}")
            self._counters.shown += 1

    def _update_record(self, finished: bool) -> None:
        """Update the record."""
        if self._writer is not None:
            counters = asdict(self.status().counters)
            counters["away_s"] = round(counters["away_s"], 3)
            remarks = {"began": self._began or None, "counters": counters, "interruptions": self._interruptions}
            self._writer.note(remarks, finished)


@contextmanager
def _stopping(stop: Callable[[], None]) -> Iterator[None]:
    """Call ``stop`` on Ctrl-C, SIGTERM or where the terminal is closed; a second signal has its usual effect."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    numbers = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]
    before = {number: handler for number in numbers if (handler := signal.getsignal(number)) is not signal.SIG_IGN}

    def caught(number: int, frame: FrameType | None) -> None:
        del frame
        signal.signal(number, before[signal.Signals(number)])
        stop()

    for number in before:
        signal.signal(number, caught)
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
