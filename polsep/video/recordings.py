"""A recording in, a separated sequence out: reading, separating and writing overlap, memory is bounded, runs resume.

Frames go through three threads: one reads and unpacks, one separates, the caller's thread writes. Queues between them
are short, so that the slowest sets the pace. The output bytes depend on the settings and the frames alone, not on
interruptions (`io.results.sequences`) and not on where frames are separated (``engine``).

Where nothing moves, raw samples and images are averaged over frames (`temporal`); that state is saved with the run.
The exposure of the preview is estimated from the first frame, dead and hot pixels from the first few, the light's
colour from frames spread over the first part, and then fixed, so that they cause no flicker.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Generator, Iterator
from contextlib import closing
from dataclasses import asdict, dataclass, field, replace
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from polsep.compute.cluster import map_ordered
from polsep.compute.devices import find_device
from polsep.compute.threads import get_threads, own_threads
from polsep.compute.workers import DEPTH, ahead, map_ahead
from polsep.io.raw.frames import Frame, ReadOptions
from polsep.io.raw.sequences import DamagedFrame, FrameSequence, input_files, open_sequence, refuse_frames
from polsep.io.results.sequences import Picture, SequenceKind, SequenceWriter, State
from polsep.io.store.atomic import OutputError, refuse_inputs
from polsep.io.store.errors import InputError
from polsep.light.light_color import LightColor
from polsep.methods import find_method
from polsep.pipeline import make_frame, move_capture
from polsep.sensor.camera import Mosaic
from polsep.sensor.defects import repair
from polsep.video.first_frame import FirstFrame, of_one_camera, separate_first
from polsep.video.panels import black_picture, draw_panels
from polsep.video.reports import describe_run, shared_report
from polsep.video.temporal import Images, TemporalState, filter_frame, steady_images

Floats = NDArray[np.float32]

#: Largest number of frames that this process separates at once: each needs the memory of its method.
AT_ONCE = 4
#: Names of the averaged images in the saved state.
IMAGES = ("diffuse", "specular")
#: Filters against flicker.
FILTERS = ("temporal", "none")
#: Ways to treat a damaged frame.
ON_DAMAGE = ("stop", "skip")


@dataclass(frozen=True)
class VideoOptions:
    """Options of the separation, as in `pipeline.separate`; at most ``frames`` of them; ``damaged``: of `ON_DAMAGE`.

    ``engine``: of `ENGINES`, which changes no byte. ``stokes``: EXR files also get Stokes images. ``filter``: of
    `FILTERS`; "temporal" averages raw samples and images where nothing moves (`temporal`).
    """

    method: str = "auto-fast"
    light_color: LightColor | str = "auto"
    device: str = "auto"
    damaged: str = "stop"
    frames: int | None = None
    engine: str = "local"
    filter: str = "temporal"
    stokes: bool = False

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
    """Place and format in which results are written. ``kept``: files that they may not replace, besides frames."""

    directory: Path
    kind: SequenceKind = field(default_factory=SequenceKind)
    overwrite: bool = False
    kept: tuple[Path, ...] = ()


@dataclass(frozen=True)
class SeparatedImages:
    """Diffuse and specular images of a separated frame, and its ``report``; Stokes images on request."""

    images: Images
    report: dict[str, Any]
    stokes: Floats | None = None


class Job(NamedTuple):
    """A frame to separate on a ``device`` like the ``first`` one, with Stokes images or without."""

    frame: Frame
    first: FirstFrame
    device: str
    stokes: bool


@dataclass(frozen=True)
class Separated:
    """The result of a frame, or its damage, and the state of the temporal filter after it, if there is one."""

    index: int
    result: SeparatedImages | DamagedFrame
    state: TemporalState | None


@dataclass(frozen=True)
class Progress:
    """``done`` of ``count`` frames; ``warning``: a line for the user; ``written``: the files of a complete run.

    ``damaged``: this frame is missing or, for a complete run, some frame is, also where an earlier run left it out.
    ``report``: what matters in the reports of all frames of a complete run, as `SeparatedFrame.report` has it.
    """

    done: int
    count: int
    warning: str | None = None
    damaged: bool = False
    written: tuple[Path, ...] = ()
    report: dict[str, Any] | None = None


def separate_video(path: Path, read: ReadOptions, options: VideoOptions, target: Target) -> Iterator[Progress]:
    """Separate a recording and yield the progress after every frame, from where an earlier run ended.

    Raises ValueError on what cannot be read or written and, with ``damaged`` "stop", at the first damaged frame;
    frames done by then stay, and the same call resumes there.
    """
    if options.stokes and target.kind.format != "exr":
        raise ValueError(f"expected the format exr for Stokes images, found {target.kind.format}")
    recording = open_sequence(path, read)
    kind = target.kind.at(recording.rate)
    inputs = [*input_files(path), *target.kept]
    refuse_frames(path, target.kept)
    refuse_inputs([target.directory / f"{recording.stem}{end}" for end in (".json", ".jsonl")], inputs)
    count = recording.count if options.frames is None else min(recording.count, options.frames)
    first = separate_first(recording, options)
    settings = {
        "source": path.name,
        "first_frame_sha256": first.sha256,
        "frames": options.frames,
        "read": read.settings(),
        "filter": options.filter,
        "stokes": options.stokes,
        "kind": asdict(kind),
        "method": first.method,
        "light_color": list(first.light),
        "light": first.facts,
        "gain": first.gain,
        "black_level": first.black_level,
        "defects": 0 if first.defects is None else int(np.count_nonzero(first.defects)),
        "shape": list(first.shape),
        "colors": first.size[2],
        "device": find_device(options.device),
    }
    sequence = SequenceWriter(target.directory, recording.stem, kind, settings, target.overwrite)
    _refuse_other_files(sequence, recording)
    for warning in (*_rate_notes(recording, target.kind, kind), *first.warnings):
        yield Progress(sequence.first, count, warning)
    yield Progress(sequence.first, count)
    last = sequence.first
    with closing(_pictures(recording, options, first, sequence)) as pictures:
        for step in write_pictures(sequence, pictures, options.damaged, count):
            last = step.done
            yield step
    lines = sequence.lines()
    report = describe_run({**settings, "damaged": options.damaged}, first, lines)
    written = tuple(sequence.finish(report))
    yield Progress(last, last, damaged=bool(report["damaged"]), written=written, report=shared_report(first, lines))


def _rate_notes(recording: FrameSequence, asked: SequenceKind, kind: SequenceKind) -> tuple[str, ...]:
    """A note where films cannot have the rate of a recording, and nobody said another."""
    if asked.rate is not None or recording.rate in (None, kind.rate):
        return ()
    return (f"no film of {kind.format} has the recording's {recording.rate:g} frames/s: {kind.rate:g}, or say --rate",)


def _refuse_other_files(sequence: SequenceWriter, recording: FrameSequence) -> None:
    """Raise OutputError where a folder's files no longer have the numbers of those that an earlier run separated."""
    for line, name in zip(sequence.lines(), recording.names, strict=False):
        if line.get("file", name) != name:
            found = f"found {name} in its place; --overwrite begins anew"
            raise OutputError(f"expected frame {line['frame']} in {line['file']}, as the run was begun, {found}")


def write_pictures(
    sequence: SequenceWriter, pictures: Iterator[tuple[Picture, State]], on_damage: str, count: int
) -> Iterator[Progress]:
    """Write pictures, each with the state behind it, part after part; ``count``: expected frames of the sequence.

    Pictures with ``damaged`` in their line are black frames of videos only. Raises InputError at the first of them with
    ``on_damage`` "stop".
    """
    with closing(sequence):
        for done, (picture, state) in enumerate(pictures, sequence.first + 1):
            number, reason = picture.line["frame"], picture.line.get("damaged")
            if reason is not None and on_damage == "stop":
                raise InputError(reason)
            sequence.append(number, picture, state)
            warning = None if reason is None else f"frame {number} is left out: {reason}"
            yield Progress(done, max(count, done), warning, damaged=reason is not None)
        sequence.end_part()


def _pictures(
    recording: FrameSequence, options: VideoOptions, first: FirstFrame, sequence: SequenceWriter
) -> Generator[tuple[Picture, State], None, None]:
    """The frames that an earlier run has not written, each with the state that the next part depends on."""
    saved = sequence.state()
    before: Images | None = tuple(saved.pop(name) for name in IMAGES) if set(IMAGES) <= set(saved) else None
    state = TemporalState.from_arrays(saved) if saved else None
    preview = sequence.kind.preview
    with closing(ENGINES[options.engine](recording, options, first, sequence.first, state)) as frames:
        for frame in frames:
            if isinstance(frame.result, DamagedFrame):
                line = _line_of(recording, frame.index) | {"damaged": frame.result.reason}
                picture = black_picture(first.size, preview, line)
            else:
                images, report = frame.result.images, frame.result.report
                if frame.state is not None:
                    images = steady_images(images, before, frame.state)
                before = images
                line = _line_of(recording, frame.index) | report["statistics"]
                if report["warnings"]:
                    line["warnings"] = report["warnings"]
                diffuse, specular = images
                panels = draw_panels(diffuse, specular, first.gain) if preview else None
                stokes = frame.result.stokes
                picture = Picture(diffuse, specular, panels, line, stokes=stokes, report=report)
            kept: State = {}
            if frame.state is not None:
                kept = frame.state.to_arrays() | (dict(zip(IMAGES, before, strict=True)) if before else {})
            yield picture, kept


def _line_of(recording: FrameSequence, index: int) -> dict[str, Any]:
    """The number of a frame for the log, and its file in a folder."""
    return {"frame": index} | ({"file": recording.names[index]} if recording.names else {})


def separate_here(
    recording: FrameSequence, options: VideoOptions, first: FirstFrame, begin: int, state: TemporalState | None
) -> Generator[Separated, None, None]:
    """Separate frames from number ``begin`` on, in order, in threads of this process, one thread per frame.

    That keeps all cores busy; threads that share a frame would wait for the slowest one. ``state``: of the temporal
    filter before the first of these frames.
    """
    device, cores = find_device(options.device), get_threads()
    workers = min(cores, AT_ONCE)

    def separate(ready: tuple[Frame | DamagedFrame, TemporalState | None]) -> Separated:
        frame, after = ready
        if isinstance(frame, DamagedFrame):
            return Separated(frame.index, frame, after)
        with own_threads(cores // workers):
            return Separated(frame.index, separate_one(Job(frame, first, device, options.stokes)), after)

    with closing(ahead(_prepared(recording, options, first, begin, state), 1)) as frames:
        yield from map_ahead(separate, frames, workers)


def separate_on_ray(
    recording: FrameSequence, options: VideoOptions, first: FirstFrame, begin: int, state: TemporalState | None
) -> Generator[Separated, None, None]:
    """`separate_here` on a Ray cluster; this process reads and writes."""
    workers, device = get_threads(), find_device(options.device)
    submitted: deque[tuple[int | DamagedFrame, TemporalState | None]] = deque()

    def jobs() -> Iterator[Job]:
        for frame, after in frames:
            submitted.append((frame if isinstance(frame, DamagedFrame) else frame.index, after))
            if not isinstance(frame, DamagedFrame):
                yield Job(frame, first, device, options.stokes)

    def damaged_frames() -> Iterator[Separated]:
        while submitted and isinstance(submitted[0][0], DamagedFrame):
            damaged, after = submitted.popleft()
            assert isinstance(damaged, DamagedFrame)
            yield Separated(damaged.index, damaged, after)

    with closing(ahead(_prepared(recording, options, first, begin, state))) as frames:
        for result in map_ordered(separate_one, jobs(), workers, DEPTH * workers):
            yield from damaged_frames()
            index, after = submitted.popleft()
            assert isinstance(index, int)
            yield Separated(index, result, after)
        yield from damaged_frames()


#: The places where frames can be separated.
ENGINES = {"local": separate_here, "ray": separate_on_ray}


def separate_one(job: Job) -> SeparatedImages:
    """Separate one frame with the method and the light colour of the first one."""
    frame, light, data = job.frame, job.first.light, move_capture(job.frame.data, job.device)
    method = find_method(job.first.method, data)
    found = make_frame(method.run(data, light, False), method, data, light)
    stokes = replace(found, capture=frame.data).with_stokes().stokes if job.stokes else None
    report = found.report | {"warnings": [*frame.notes, *found.report["warnings"]]} | frame.taken()
    return SeparatedImages((found.diffuse, found.specular), report, stokes)


def _prepared(
    recording: FrameSequence, options: VideoOptions, first: FirstFrame, begin: int, state: TemporalState | None
) -> Iterator[tuple[Frame | DamagedFrame, TemporalState | None]]:
    """Frames from number ``begin`` on, temporally filtered where asked, each with the state after it."""
    count = None if options.frames is None else max(options.frames - begin, 0)
    for frame in islice(recording.begin(begin), count):
        frame = of_one_camera(frame, first.camera)
        if isinstance(frame, Frame) and isinstance(frame.data, Mosaic):
            data = frame.data
            if first.black_level is not None:
                data = replace(data, black_level=first.black_level)
            if first.defects is not None:
                data = repair(data, first.defects)
            if options.filter == "temporal":
                data, state = filter_frame(data, state)
            frame = replace(frame, data=data)
        yield frame, state
