"""A recording in, a separated one out: reading, separating and writing overlap, memory is bounded, kills do no harm.

Frames go through three threads: one reads and unpacks, one separates, the caller's writes; queues between them are
short, so that the slowest sets the pace. What decides about the bytes of a run are its settings and its frames alone,
not how often it was interrupted (`io.results.sequences`) and not where frames were separated (`engine`).

Where nothing moves, raw samples and images are averaged over frames (`temporal`), whose state is part of a run's.
What is estimated of a scene, its light's colour and the exposure of the film to watch, is so from its first frame, and
then fixed: pictures do not flicker because of it.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Generator, Iterator
from contextlib import closing
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray

from polsep.compute.cluster import map_ordered
from polsep.compute.threads import get_threads, own_threads
from polsep.compute.workers import DEPTH, ahead, map_ahead
from polsep.io.raw.frames import Frame, ReadOptions
from polsep.io.raw.sequences import DamagedFrame, FrameSequence, open_sequence
from polsep.io.results.previews import exposure_of, srgb
from polsep.io.results.sequences import PART, Picture, SequenceKind, SequenceWriter, State
from polsep.methods import Capture, find_method
from polsep.pipeline import LightColor, find_device, make_frame, separate_capture, to_device
from polsep.sensor.camera import Mosaic
from polsep.video.panels_kernel import STEPS, make_panels
from polsep.video.temporal import Images, TemporalState, filter_frame, steady_images

Floats = NDArray[np.float32]
Item = TypeVar("Item")

#: Frames that are separated at once by this process, at most: each takes the memory of its method.
AT_ONCE = 4
#: Names under which steady images are kept for the next part.
IMAGES = ("diffuse", "specular")
#: Widest panel of the film to watch.
PANEL = 640
#: The tone curve by equal steps of the root of linear light.
_TONES = np.rint(255 * srgb((np.arange(STEPS + 1) / STEPS) ** 2)).astype(np.uint8)
#: What is done against flicker.
FILTERS = ("temporal", "none")
#: What becomes of a run with a damaged frame.
ON_DAMAGE = ("stop", "skip")


@dataclass(frozen=True)
class VideoOptions:
    """How frames are separated, as in `pipeline.separate`; at most ``frames`` of them; ``damaged``: of `ON_DAMAGE`.

    ``engine``: of `ENGINES`, where frames are separated, which changes no byte. ``filter``: of `FILTERS`; "temporal"
    averages raw samples and images where nothing moves (`temporal`).
    """

    method: str = "auto"
    light_color: LightColor | str = (1.0, 1.0, 1.0)
    device: str = "auto"
    damaged: str = "stop"
    frames: int | None = None
    engine: str = "local"
    filter: str = "temporal"

    def __post_init__(self) -> None:
        if self.damaged not in ON_DAMAGE:
            raise ValueError(f"expected stop or skip for damaged frames, found {self.damaged!r}")
        if self.filter not in FILTERS:
            raise ValueError(f"expected a filter of {', '.join(FILTERS)}, found {self.filter!r}")
        if self.engine not in ENGINES:
            raise ValueError(f"expected an engine of {', '.join(ENGINES)}, found {self.engine!r}")
        if self.frames is not None and self.frames < 1:
            raise ValueError(f"expected at least one frame to separate, found {self.frames}")


@dataclass(frozen=True)
class Target:
    """Where and how results are written."""

    directory: Path
    kind: SequenceKind = field(default_factory=SequenceKind)
    overwrite: bool = False


@dataclass(frozen=True)
class Look:
    """What the first frame says of all: colour of the ``light``, ``gain`` of the film to watch, ``size`` of the images.

    ``size`` counts colours too. ``shape``: of raw frames. ``warnings``: what the owner should know.
    """

    method: str
    light: tuple[float, ...]
    gain: float
    size: tuple[int, int, int]
    shape: tuple[int, ...]
    warnings: tuple[str, ...]


@dataclass(frozen=True)
class Found:
    """What is kept of a separated frame: diffuse and specular images, and its ``report``."""

    images: Images
    report: dict[str, Any]


@dataclass(frozen=True)
class Separated:
    """A frame that was separated, or is damaged, and the state of the filter behind it, if there is one."""

    index: int
    found: Found | DamagedFrame
    state: TemporalState | None


@dataclass(frozen=True)
class Progress:
    """``done`` of ``count`` frames; ``warning``: a line for the user; ``written``: the files of a run that is done.

    ``damaged``: this frame is missing or, of a run that is done, some frame is, also where an earlier run left it out.
    """

    done: int
    count: int
    warning: str | None = None
    damaged: bool = False
    written: tuple[Path, ...] = ()


def separate_video(path: Path, read: ReadOptions, options: VideoOptions, target: Target) -> Iterator[Progress]:
    """Separate a recording and say how far it is, frame after frame, beginning with what an earlier run did.

    Raises ValueError on what cannot be read or written and, with ``damaged`` "stop", at the first damaged frame; what
    was done by then stays, and the same call goes on there.
    """
    footage = open_sequence(path, read)
    count = footage.count if options.frames is None else min(footage.count, options.frames)
    look = look_at(footage, options)
    settings = {
        "source": path.name,
        "frames": options.frames,
        "read": {**asdict(read), "layout": read.layout.spec if read.layout else None},
        "filter": options.filter,
        "kind": asdict(target.kind),
        "method": look.method,
        "light_color": list(look.light),
        "gain": look.gain,
        "shape": list(look.shape),
        "colors": look.size[2],
        "device": str(find_device(options.device)),
    }
    sequence = SequenceWriter(target.directory, footage.stem, target.kind, settings, target.overwrite)
    for warning in look.warnings:
        yield Progress(sequence.first, count, warning)
    yield Progress(sequence.first, count)
    last = sequence.first
    for step in _run(footage, options, look, sequence):
        last = step.done
        yield replace(step, count=max(count, step.done))
    lines = sequence.lines()
    report = _report({**settings, "damaged": options.damaged}, look, lines)
    yield Progress(last, last, damaged=bool(report["damaged"]), written=tuple(sequence.finish(report)))


def look_at(footage: FrameSequence, options: VideoOptions) -> Look:
    """Separate the first frame that is whole. Raises ValueError where there is none among those of one part."""
    reason = "none at all"
    for _, frame in zip(range(PART), footage.begin(0), strict=False):
        if isinstance(frame, DamagedFrame):
            reason = frame.reason
            continue
        found = separate_capture(frame.data, options.method, options.light_color, options.device)
        gain = exposure_of(found.diffuse + found.specular)
        light = tuple(float(c) for c in found.report["light_color"])
        size = (found.diffuse.shape[0], found.diffuse.shape[1], found.diffuse.shape[2])
        notes = (*frame.notes, *found.report["warnings"])
        return Look(found.report["method"], light, gain, size, tuple(frame.data.data.shape), notes)
    raise ValueError(f"expected a frame that can be read, found {reason}")


def _run(footage: FrameSequence, options: VideoOptions, look: Look, sequence: SequenceWriter) -> Iterator[Progress]:
    """The frames that are not done, into the sequence, part after part."""
    kept = sequence.state()
    images: Images | None = tuple(kept.pop(name) for name in IMAGES) if set(IMAGES) <= set(kept) else None
    start = sequence.first, TemporalState.from_arrays(kept) if kept else None
    with closing(sequence), closing(ENGINES[options.engine](footage, options, look, start)) as ready:
        for frame in ready:
            warning = None
            if isinstance(frame.found, DamagedFrame):
                if options.damaged == "stop":
                    raise ValueError(frame.found.reason)
                picture = _missing(frame.found, look, sequence.kind.preview)
                warning = f"frame {frame.index} is left out: {frame.found.reason}"
            else:
                images = _steady(frame.found.images, images, frame.state)
                picture = as_picture(frame, images, look, sequence.kind.preview)
            sequence.append(frame.index, picture, partial(_as_arrays, frame.state, images))
            yield Progress(frame.index + 1, 0, warning, damaged=warning is not None)
        sequence.end_part()


def _steady(images: Images, before: Images | None, state: TemporalState | None) -> Images:
    """A frame's images, steadier where nothing has moved, if there is a filter."""
    return images if state is None else steady_images(images, before, state)


def _as_arrays(state: TemporalState | None, images: Images | None) -> State:
    """What the next part depends on."""
    if state is None:
        return {}
    return state.to_arrays() | (dict(zip(IMAGES, images, strict=True)) if images else {})


def separate_here(
    footage: FrameSequence, options: VideoOptions, look: Look, start: tuple[int, TemporalState | None]
) -> Generator[Separated, None, None]:
    """Frames from number ``start[0]`` on, in order, by threads of this process: each separates a frame by itself.

    That keeps all cores busy whatever else runs; threads that share a frame would wait for the slowest one.
    """
    device, cores = find_device(options.device), get_threads()
    workers = min(cores, AT_ONCE)

    def separate(ready: tuple[Frame | DamagedFrame, TemporalState | None]) -> Separated:
        frame, state = ready
        if isinstance(frame, DamagedFrame):
            return Separated(frame.index, frame, state)
        with own_threads(cores // workers):
            return Separated(frame.index, separate_one((frame.data, look, device)), state)

    with closing(ahead(_prepared(footage, options, look, start), 1)) as frames:
        yield from map_ahead(separate, frames, workers)


def separate_on_ray(
    footage: FrameSequence, options: VideoOptions, look: Look, start: tuple[int, TemporalState | None]
) -> Generator[Separated, None, None]:
    """The same by a Ray cluster; this process reads and writes."""
    workers, device = get_threads(), find_device(options.device)
    asked: deque[tuple[int | DamagedFrame, TemporalState | None]] = deque()

    def whole_frames() -> Iterator[tuple[Capture, Look, torch.device]]:
        for frame, state in frames:
            asked.append((frame if isinstance(frame, DamagedFrame) else frame.index, state))
            if not isinstance(frame, DamagedFrame):
                yield frame.data, look, device

    def waiting() -> Iterator[Separated]:
        while asked and isinstance(asked[0][0], DamagedFrame):
            damaged, state = asked.popleft()
            assert isinstance(damaged, DamagedFrame)
            yield Separated(damaged.index, damaged, state)

    with closing(ahead(_prepared(footage, options, look, start))) as frames:
        for found in map_ordered(separate_one, whole_frames(), workers, DEPTH * workers):
            yield from waiting()
            index, state = asked.popleft()
            assert isinstance(index, int)
            yield Separated(index, found, state)
        yield from waiting()


#: Where frames are separated.
ENGINES = {"local": separate_here, "ray": separate_on_ray}


def separate_one(job: tuple[Capture, Look, torch.device]) -> Found:
    """One frame by the method, and under the light, that the first one settled."""
    data, look, device = job
    data = to_device(data, device)
    method = find_method(look.method, data)
    frame = make_frame(method.run(data, look.light, False), method, data, look.light)
    return Found((frame.diffuse, frame.specular), frame.report)


def _prepared(
    footage: FrameSequence, options: VideoOptions, look: Look, start: tuple[int, TemporalState | None]
) -> Iterator[tuple[Frame | DamagedFrame, TemporalState | None]]:
    """Frames from number ``start[0]`` on as they are to be separated, each with the state behind it."""
    first, state = start
    for frame in limited(footage.begin(first), first, options.frames):
        frame = whole(frame, look)
        if options.filter == "temporal" and isinstance(frame, Frame) and isinstance(frame.data, Mosaic):
            data, state = filter_frame(frame.data, state)
            frame = replace(frame, data=data)
        yield frame, state


def whole(frame: Frame | DamagedFrame, look: Look) -> Frame | DamagedFrame:
    """The frame, or why it does not belong to the recording: its size."""
    if isinstance(frame, DamagedFrame) or tuple(frame.data.data.shape) == look.shape:
        return frame
    wanted, found = ("x".join(map(str, reversed(shape))) for shape in (look.shape, tuple(frame.data.data.shape)))
    return DamagedFrame(
        frame.index, f"frame {frame.index}: expected {wanted} samples as in the first one, found {found}"
    )


def limited(frames: Iterator[Item], first: int, count: int | None) -> Iterator[Item]:
    """Frames from number ``first`` on, but none from number ``count`` on."""
    for number, frame in enumerate(frames, first):
        if count is not None and number >= count:
            return
        yield frame


def as_picture(frame: Separated, images: Images, look: Look, preview: bool) -> Picture:
    """What is kept of a separated frame and its steady ``images``."""
    assert isinstance(frame.found, Found)
    report, (diffuse, specular) = frame.found.report, images
    line = {"frame": frame.index, **report["statistics"]}
    if report["warnings"]:
        line["warnings"] = report["warnings"]
    return Picture(diffuse, specular, draw_panels(diffuse, specular, look.gain) if preview else None, line)


def draw_panels(diffuse: Floats, specular: Floats, gain: float) -> NDArray[np.uint8]:
    """Input, diffuse and specular ``[h, w, C]`` to watch, sRGB ``uint8 [h', 3 w', 3]``, at a ``gain``."""
    return make_panels((diffuse, specular), gain, _TONES, PANEL)


def _missing(damaged: DamagedFrame, look: Look, preview: bool) -> Picture:
    """A black picture."""
    black = np.zeros(look.size, np.float32)
    panels = draw_panels(black, black, 1.0) if preview else None
    return Picture(black, black, panels, {"frame": damaged.index, "damaged": damaged.reason})


def _report(settings: dict[str, Any], look: Look, lines: list[dict[str, Any]]) -> dict[str, Any]:
    """What is said of a run: settings, how many frames, which are missing, what frames warned of and how often."""
    warnings: dict[str, int] = {}
    for line in lines:
        for warning in line.get("warnings", ()):
            warnings[warning] = warnings.get(warning, 0) + 1
    damaged = [line for line in lines if "damaged" in line]
    counts = {"frames": len(lines), "damaged": damaged}
    return {**counts, "settings": settings, "first_frame_warnings": list(look.warnings), "warnings": warnings}
