"""One run of a camera: three threads that never wait for each other, and what they count.

    camera -> acquisition -+-> ring of N frames -> recorder -> DIR/frames.raw
                           +-> ring of 1 frame  -> live view -> DIR/live.jpg, page

The acquisition puts every frame into both rings. The recorder's drops its oldest frame when the disk is slower than the
camera for longer than N frames; the live view's always holds the newest. In the end received = recorded + dropped.
A camera that is lost is asked for every second, and the same recording goes on when it is back.
"""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, nullcontext
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from types import FrameType
from typing import Any

from polsep.capture.live import LiveView, Shown
from polsep.capture.page import serve_page
from polsep.capture.ring import Ring
from polsep.capture.sources import Camera, CameraError, CameraInfo, CameraLost, CameraSource, EndOfFrames, Loss
from polsep.io.raw.recording import PICTURE, Header, RawImage, RecordingWriter, refuse_recording
from polsep.io.store.atomic import OutputError
from polsep.sensor.camera import Layout

#: Seconds between attempts to connect to a camera that was lost.
RETRY_S = 1.0
#: Longest wait of a thread before it looks whether it should stop.
TICK_S = 0.2


@dataclass(frozen=True)
class Limits:
    """When a run ends, by itself: after so many seconds of acquisition or frames received, whichever is first; or when
    a lost camera is not back within ``timeout_s``. ``ring``: frames kept while the disk is busy. ValueError otherwise.
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
    """What to do with the frames: record into ``output``, separate with ``method``, serve a page on ``port``.

    None leaves each of them out. ``layout``: of the mosaic, None for what the pixel format's name says.
    """

    output: Path | None = None
    method: str | None = "auto-fast"
    layout: Layout | None = None
    port: int | None = None
    overwrite: bool = False


@dataclass
class Counters:
    """Frames received whole, lost on the wire, dropped by a full ring, recorded, shown; interruptions and their time.

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
    """Where a run stands: seconds of acquisition, frames per second of late, counters, the light's polarizer."""

    seconds: float
    rate_hz: float
    counters: Counters
    light_deg: float | None = None

    def line(self) -> str:
        """All of it for the terminal."""
        count = self.counters
        light = "" if self.light_deg is None else f", light {self.light_deg:.0f} deg"
        away = f", {count.interruptions} interruptions ({count.away_s:.1f} s)" if count.interruptions else ""
        return (
            f"{self.seconds:.1f} s, {self.rate_hz:.1f} frames/s: {count.received} received, {count.lost} lost, "
            f"{count.dropped} dropped, {count.recorded} recorded, {count.shown} shown{away}{light}"
        )


class Session:
    """The state that the threads of one run share; `run` is all there is to call."""

    def __init__(self, source: CameraSource, plan: CapturePlan, limits: Limits, say: Callable[[str], None]) -> None:
        """``say`` takes lines for the user. Raises OutputError where a recording would be replaced unasked."""
        if plan.output is not None:
            refuse_recording(plan.output, plan.overwrite)
        self._source, self._plan, self._limits, self._say = source, plan, limits, say
        picture = plan.output / PICTURE if plan.output is not None else None
        self._live = LiveView(plan.method, plan.layout, picture) if plan.method is not None else None
        self._to_disk: Ring[RawImage] = Ring(limits.ring)
        self._to_view: Ring[RawImage] = Ring(1)
        self._stop, self._view_ready = threading.Event(), threading.Event()
        self._failures: list[Exception] = []
        self._info: CameraInfo | None = None
        self._writer: RecordingWriter | None = None
        self._counters, self._interruptions = Counters(), list[dict[str, Any]]()
        self._started, self._last, self._away_since = 0.0, 0.0, 0.0
        self._incomplete = 0  # frames that came incomplete since the last whole one
        self._unwritten = 0  # frames that waited for a recorder that failed
        self._began, self._line, self._reason = "", "waiting for the camera", ""
        self._recent: list[tuple[float, int]] = []

    def run(self, tell: Callable[[Status], None], every_s: float = 0.5) -> Status:
        """Capture until the limits, the end of the source or `stop`; ``tell`` hears where it stands.

        Ctrl-C and SIGTERM are `stop`, a second one is at once. Raises CameraError when the camera is not there or does
        not come back, OutputError when the disk takes no more, ValueError when the method cannot take the frames; what
        was recorded until then is whole.
        """
        port = self._plan.port
        page = nullcontext("") if port is None else serve_page(port, self._shown, lambda: self._line)
        with page as address, _stopping(self.stop):
            if address:
                self._say(f"live view at {address}")
            acquisition, recorder = self._thread(self._acquire), self._thread(self._record)
            view = self._thread(self._view)
            while acquisition.is_alive():
                acquisition.join(every_s)
                status = self.status()
                self._line = status.line()
                tell(status)
            recorder.join()
            view.join()
        self._finish()
        ended = self.status()
        return replace(ended, rate_hz=(ended.counters.received - 1) / ended.seconds if ended.seconds > 0 else 0.0)

    def _finish(self) -> None:
        """Finish the record, and raise what went wrong first."""
        if self._writer is not None:
            if self._failures:  # a recorder that failed leaves frames behind
                self._unwritten = self._counters.received - self._counters.recorded - self._to_disk.dropped
            try:
                self._note(finished=not self._failures)
            except OSError as error:
                self._failures.append(OutputError(f"expected to finish the record, found: {error}"))
            self._writer.close()
        if self._failures:
            raise self._failures[0]

    def stop(self) -> None:
        """End the run in good order."""
        self._stop.set()

    def status(self) -> Status:
        """Where the run stands."""
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
        """Connect, deliver, and connect again after a loss, until the run is over."""
        try:
            while True:
                with ExitStack() as stack:
                    camera = self._connect(stack)
                    if camera is None:
                        return
                    try:
                        self._prepare(camera.info)
                        camera.start()
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
        """The camera; after a loss it is tried for until the timeout. None when the run ends meanwhile."""
        limit = self._limits.timeout_s
        while True:
            if self._away_since:
                if time.monotonic() - self._away_since > limit:
                    raise CameraError(f"expected the camera back within {limit:g} s, found: {self._reason}")
                if self._stop.wait(RETRY_S) or self._over():
                    return None
            try:
                return stack.enter_context(self._source.connect())
            except CameraError as error:
                if not self._away_since:
                    raise
                self._reason = str(error)

    def _prepare(self, info: CameraInfo) -> None:
        """Make ready for frames of this kind; after an interruption, see that they are of the same kind."""
        if self._info is not None:
            found, expected = (f"{i.width}x{i.height} {i.pixel_format}" for i in (info, self._info))
            if found != expected:
                raise CameraError(f"expected the camera back with {expected}, found {found}")
            return
        layout = self._plan.layout.spec if self._plan.layout is not None else None
        header = Header(info.width, info.height, info.pixel_format, info.name, info.settings, layout)
        self._info = info
        while self._live is not None and not self._view_ready.wait(TICK_S):  # this once the view goes first
            if self._stop.is_set():
                return
        if self._plan.output is not None:
            self._writer = RecordingWriter(self._plan.output, header, self._plan.overwrite)
        self._began = datetime.now(UTC).isoformat(timespec="milliseconds")
        self._say(f"{info.name}: {info.width}x{info.height} {info.pixel_format}")

    def _pump(self, camera: Camera) -> None:
        """Deliver frames until the run is over. Raises CameraLost when a camera has nothing more to say."""
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
        """True when the run should end."""
        limits, now = self._limits, time.monotonic()
        late = limits.seconds is not None and self._started > 0 and now - self._started >= limits.seconds
        enough = limits.frames is not None and self._counters.received >= limits.frames
        return self._stop.is_set() or late or enough

    def _deliver(self, image: RawImage, now: float) -> None:
        """Count a frame and hand it to recorder and live view."""
        lost = max(image.lost_before, self._incomplete)
        if lost > self._incomplete:  # those that came incomplete are counted already
            self._count_lost(lost - self._incomplete, f"ids are missing before frame {image.frame_id}")
        self._incomplete, image = 0, replace(image, lost_before=lost)
        if self._away_since:
            away, self._away_since = now - self._away_since, 0.0
            self._counters.away_s += away
            self._interruptions.append({"received_before": self._counters.received, "seconds": round(away, 3)})
            self._say(f"camera back after {away:.1f} s, frames in between are not counted as lost")
            image = replace(image, away_s=away)
        self._counters.received += 1
        self._last = now
        if self._plan.output is not None:
            self._to_disk.put(image)
        if self._live is not None:
            self._to_view.put(image)

    def _count_lost(self, frames: int, reason: str) -> None:
        """Count frames that the wire lost; the first time is worth a line."""
        if not self._counters.lost:
            self._say(f"lost on the wire: {reason}; further losses are only counted")
        self._counters.lost += frames

    def _note_loss(self, error: CameraLost) -> None:
        """The camera went: say so once per interruption."""
        self._reason = str(error)
        if self._away_since:
            return
        self._away_since = self._last or time.monotonic()
        self._counters.interruptions += 1
        self._say(f"camera lost: {error}; trying again every second for {self._limits.timeout_s:g} s")

    def _record(self) -> None:
        """The recorder's thread: every frame of its ring to the disk."""
        while not self._to_disk.finished:
            image = self._to_disk.take(TICK_S)
            if image is None:
                continue
            assert self._writer is not None, "expected a writer before the first frame"
            try:
                self._writer.append(image)
            except OSError as error:
                reason = error.strerror or str(error)
                raise OutputError(f"expected to go on recording into {self._plan.output}, found: {reason}") from None
            self._counters.recorded += 1

    def _view(self) -> None:
        """The live view's thread: the newest frame, again and again."""
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
            self._say(f"the live view has ended, the recording goes on: {error}")

    def _show_frames(self, live: LiveView) -> None:
        """The newest frame until there are no more; what is remarkable about the first is worth a line."""
        while not self._to_view.finished:
            image = self._to_view.take(TICK_S)
            if image is None:
                continue
            shown = live.show(image)
            for remark in shown.remarks if not self._counters.shown else ():
                self._say(f"frame {image.frame_id}: {remark}")
            self._counters.shown += 1

    def _note(self, finished: bool) -> None:
        """Bring the record up to date."""
        if self._writer is not None:
            counters = asdict(self.status().counters)
            counters["away_s"] = round(counters["away_s"], 3)
            remarks = {"began": self._began, "counters": counters, "interruptions": self._interruptions}
            self._writer.note(remarks, finished)


@contextmanager
def _stopping(stop: Callable[[], None]) -> Iterator[None]:
    """Ctrl-C and SIGTERM call ``stop`` while the block runs; the second time they do what they did before."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}

    def caught(number: int, place: FrameType | None) -> None:
        del place
        signal.signal(number, before[signal.Signals(number)])
        stop()

    for number in before:
        signal.signal(number, caught)
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
