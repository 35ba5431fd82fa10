"""Writer of what a video becomes on disk: EXR files or lossless films, a film to watch, and the state to resume from.

Frames are written in parts of `PART` frames. A part's films are complete files in DIR/.polsep-STEM; its record, written
last, makes it count, and its state is what the next part depends on. A run that was killed resumes at the first part
without a record, so its files are byte-identical to those of an uninterrupted run. `SequenceWriter.finish` joins the
films, writes DIR/STEM.json and DIR/STEM.jsonl with a line per frame, and removes the parts.

Conventions: images are linear light, 1.0 = one measurement at the white level. EXR: half floats, layers as in
`io.results.separation_writer`. Films: 16 bits, of which 65535 is the value in `FILM_WHITE`.
"""

from __future__ import annotations

import glob
import json
import shutil
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from polsep.compute.threads import own_threads
from polsep.io.raw.videos import load_library
from polsep.io.results.exr import COMPRESSIONS, encode_exr_halves
from polsep.io.results.films import LOSSLESS, WATCHABLE, Film, FilmKind, join_films
from polsep.io.results.separation_writer import TOTAL, UNITS, stokes_layers
from polsep.io.results.sidecars import exr_notes, require_same_settings
from polsep.io.store.atomic import (
    OutputError,
    atomic_path,
    hold_lock,
    refuse_existing,
    release_cache,
    replace_bytes,
    replace_text,
    require_writable,
)
from polsep.io.store.json_text import parse_json, read_text

#: Frames per part, about a second; films have a key frame at least as often.
PART = 25
#: Images as an EXR file per frame, as lossless films, or only as the film to watch.
FORMATS = ("exr", "ffv1", "ffvhuff", "none")
#: Formats that are films.
LOSSLESS_CODECS = FORMATS[1:3]
#: Frames per second where neither the user nor the input says them.
RATE = 25.0
#: Rates that films to watch may have.
_LEAST_RATE, _MOST_RATE = 0.001, 100_000
#: Largest rate of lossless films: Matroska counts milliseconds, and FFmpeg's AVI takes no more.
_LOSSLESS_RATE = 1000
#: Threads that write at once: an EXR file or two lossless films, and the film to watch.
_WRITERS = 3
#: EXR files after which one of them is on the disk.
_CACHED = 8
#: The file by which a run holds its parts.
LOCK = "lock"
#: The file by which a run that is resumed knows that it replaces what is there.
REPLACING = "replacing"
#: Settings that follow from others and the first frame.
FOUND = ("first_frame_sha256", "light_color", "light", "gain", "black_level", "defects")
#: The value of code 65535 in lossless films.
FILM_WHITE = {"diffuse": 2.0, "specular": 8.0}

State = dict[str, NDArray[Any]]


class Picture(NamedTuple):
    """Results of a frame: float32 ``diffuse``, ``specular [h, w, C]``, ``panels`` to watch, a ``line`` for the log.

    ``combined``: for EXR files only, of frames that were edited. ``stokes [3, h, w, C]``, and the ``report`` of which
    headers tell: for EXR files too. A frame that is missing has black images, and a line with the key "damaged".
    """

    diffuse: NDArray[np.float32]
    specular: NDArray[np.float32]
    panels: NDArray[np.uint8] | None
    line: dict[str, Any]
    combined: NDArray[np.float32] | None = None
    stokes: NDArray[np.float32] | None = None
    report: Mapping[str, Any] | None = None


@dataclass(frozen=True)
class SequenceKind:
    """Format of a sequence: one of `FORMATS`, EXR's compression, a film to watch or none, frames per second.

    ``rate`` None: that of the input where it has one, else `RATE`.
    """

    format: str = "exr"
    compression: str = "none"
    preview: bool = True
    rate: float | None = None

    def __post_init__(self) -> None:
        if self.format not in FORMATS:
            raise OutputError(f"expected a format of {', '.join(FORMATS)}, found {self.format!r}")
        if self.compression not in COMPRESSIONS:
            raise OutputError(f"expected a compression of {', '.join(COMPRESSIONS)}, found {self.compression!r}")
        if self.format != "exr" and self.compression != "none":
            raise OutputError(f"expected the format exr for compression {self.compression}, found {self.format}")
        rate = RATE if self.rate is None else self.rate
        if not _LEAST_RATE <= rate <= _MOST_RATE:
            expected = f"a rate of {_LEAST_RATE} to {_MOST_RATE} frames per second"
            raise OutputError(f"expected {expected}, found {rate:g}")
        if self.format in LOSSLESS_CODECS and rate > _LOSSLESS_RATE:
            raise OutputError(
                f"expected a rate of at most {_LOSSLESS_RATE} frames per second in {self.format}, found {rate:g}"
            )
        if self.format == "none" and not self.preview:
            raise OutputError("expected something to write, found format none and no preview")

    def at(self, rate: float | None) -> SequenceKind:
        """The kind with the rate of an input, or with `RATE` where films cannot have that; its own one stays."""
        most = _LOSSLESS_RATE if self.format in LOSSLESS_CODECS else _MOST_RATE
        found = rate if rate is not None and _LEAST_RATE <= rate <= most else RATE
        return replace(self, rate=found if self.rate is None else self.rate)


class SequenceWriter:
    """Writer of the outputs ``stem`` in a directory; ``settings`` decide about every byte of them. To be closed.

    State: which parts are complete, and the films and log of the part that is being written. Raises OutputError where
    ``overwrite`` is False and files of its outputs exist that are not of a run to resume, or parts of other settings.
    """

    def __init__(
        self, directory: Path, stem: str, kind: SequenceKind, settings: dict[str, Any], overwrite: bool = False
    ) -> None:
        self.directory, self.stem, self.kind, self._settings = directory, stem, kind, settings
        self._parts = _parts_of(directory, stem)
        self._report, self._log_path = directory / f"{stem}.json", directory / f"{stem}.jsonl"
        require_writable(directory)
        replacing = self._parts / REPLACING
        if not overwrite and self._report.exists() and not replacing.exists():
            raise OutputError(f"expected no {self._report}, found one from before; --overwrite replaces it")
        self._kinds = self._film_kinds()
        begun = self._parts / "run.json"
        if not begun.exists():
            refuse_existing(directory, self._targets(), overwrite)
        if self._kinds:
            load_library()  # fail before the first frame is separated
        self._parts.mkdir(parents=True, exist_ok=True)
        self._unlock = self._lock()
        if overwrite:
            for path in self._parts.iterdir():
                path.unlink() if path.name != LOCK else None
            replacing.touch()
        self._overwrite = replacing.exists()
        if begun.exists():
            require_same_settings(begun, settings, f"{directory / stem}", "; --overwrite begins anew", FOUND)
        else:
            replace_text(begun, json.dumps(settings, sort_keys=True))
        self._done = 0
        while self._record(self._done).exists():
            self._done += 1
        self._films: dict[str, Film] = {}
        self._log: list[dict[str, Any]] = []
        self._pool: ThreadPoolExecutor | None = None
        self._begun: list[Future[None]] = []

    def _lock(self) -> Callable[[], object]:
        """Hold the parts for this run; return what lets them go. Raises OutputError where another run has them."""
        try:
            return hold_lock(self, self._parts / LOCK)
        except BlockingIOError:
            found = "found one that is under way"
            raise OutputError(f"expected no other run that writes {self.directory / self.stem}, {found}") from None

    def _film_kinds(self) -> dict[str, FilmKind]:
        """The kinds of the films of a run, by the images they show."""
        kinds: dict[str, FilmKind] = {}
        if self.kind.format in LOSSLESS_CODECS:
            lossless = LOSSLESS[self.kind.format, self._settings["colors"]]
            kinds |= {"diffuse": lossless, "specular": lossless}
        return kinds | ({"preview": WATCHABLE} if self.kind.preview else {})

    def _targets(self) -> list[Path]:
        """Files that would be replaced: films and the log, and frames of before."""
        films = [self._film(image) for image in self._kinds]
        return [*films, self._log_path, *(self._frames() if self.kind.format == "exr" else ())]

    def _film(self, image: str) -> Path:
        return self.directory / f"{self.stem}_{image}{self._kinds[image].suffix}"

    def _frames(self) -> list[Path]:
        """EXR files of single frames that are there."""
        return sorted(self.directory.glob(f"{glob.escape(self.stem)}_{6 * '[0-9]'}.exr"))

    def _record(self, part: int) -> Path:
        return self._parts / f"{part:06d}.json"

    def _state_path(self, part: int) -> Path:
        return self._parts / f"{part:06d}.npz"

    def _film_path(self, part: int, image: str) -> Path:
        return self._parts / f"{part:06d}_{image}{self._kinds[image].suffix}"

    def _exr_path(self, index: int) -> Path:
        return self.directory / f"{self.stem}_{index:06d}.exr"

    @property
    def first(self) -> int:
        """The number of the first frame, counted from the beginning of the run, that no complete part has."""
        if not self._done:
            return 0
        return PART * (self._done - 1) + len(self._record(self._done - 1).read_text().splitlines())

    def state(self) -> State:
        """The state that the last complete part left for the next one; empty where there is none."""
        path = self._state_path(self._done - 1)
        if not self._done or not path.exists():
            return {}
        with np.load(path, allow_pickle=False) as archive:
            return {name: archive[name] for name in archive.files}

    def append(self, index: int, picture: Picture, state: State | None = None) -> None:
        """Write a frame: number ``index`` names its EXR file, which a missing frame has not.

        It is written in threads of its own, while the caller makes the next one; their errors are raised by the next
        call. ``state``: what the next part depends on; it is written at the end of a part.
        """
        self._wait()
        if self._overwrite and not self._done and not self._log:
            self._report.unlink(missing_ok=True)  # its frames are replaced from now on
        if self.kind.format == "exr" and "damaged" not in picture.line:
            self._start(self._write_exr, index, picture)
        for image, kind in self._kinds.items():
            pixels = getattr(picture, "panels" if image == "preview" else image)
            if image not in self._films:
                size = (pixels.shape[0], pixels.shape[1])
                self._films[image] = Film(self._film_path(self._done, image), kind, size, self.kind.rate or RATE)
            self._start(_write_pixels, self._films[image], pixels, FILM_WHITE.get(image))
        self._log.append(picture.line)
        if len(self._log) == PART:
            self.end_part(state)

    def _start(self, write: Callable[..., None], *given: Any) -> None:
        """Call a function in another thread, whose kernels use that one alone."""
        self._pool = self._pool or ThreadPoolExecutor(_WRITERS, "polsep-writer")

        def work() -> None:
            with own_threads(1):
                write(*given)

        self._begun.append(self._pool.submit(work))

    def _write_exr(self, index: int, picture: Picture) -> None:
        """Write the EXR file of a frame; the system keeps the last few in memory."""
        write_exr(self._exr_path(index), picture, self.kind.compression)
        for number in (index, index - _CACHED):
            release_cache(self._exr_path(number))

    def _wait(self) -> None:
        """Wait for what was started, all of it before an error is raised."""
        begun, self._begun = self._begun, []
        wait(begun)
        for future in begun:
            future.result()

    def end_part(self, state: State | None = None) -> None:
        """Complete the part that is being written, if any; to call behind the last frame."""
        if not self._log:
            return
        self._wait()
        self._close_films()
        if state:
            with atomic_path(self._state_path(self._done)) as part, part.open("wb") as stream:
                np.savez(stream, **state)  # type: ignore[arg-type]  # names are not parameters of savez
        replace_text(self._record(self._done), "".join(json.dumps(line) + "\n" for line in self._log))
        self._state_path(self._done - 1).unlink(missing_ok=True)
        self._done, self._log = self._done + 1, []

    def close(self) -> None:
        """End the films of the part that is being written. The next run writes an incomplete part anew."""
        if self._pool is not None:
            self._pool.shutdown()  # waits for what writes into films, also where Ctrl-C has ended a wait for it
            self._pool = None
        self._begun = []
        self._close_films()
        self._unlock()

    def _close_films(self) -> None:
        films, self._films = self._films, {}
        for film in films.values():
            film.close()

    def lines(self) -> list[dict[str, Any]]:
        """The log of all frames in complete parts."""
        return [json.loads(line) for k in range(self._done) for line in self._record(k).read_text().splitlines()]

    def finish(self, report: dict[str, Any]) -> list[Path]:
        """Join the films, write report and log, remove the parts; return the files of the run but for single frames."""
        self._unlock()
        self._unlock = self._lock()
        written = []
        for image, kind in self._kinds.items():
            target = self._film(image)
            parts = [path for k in range(self._done) if (path := self._film_path(k, image)).exists()]
            with atomic_path(target) as joined:
                join_films(parts, joined, kind, self.kind.rate or RATE)
            written.append(target)
        replace_bytes(self._log_path, b"".join(self._record(k).read_bytes() for k in range(self._done)))
        units = {name: UNITS[name] for name in ("diffuse", "specular")}
        if self.kind.format in LOSSLESS_CODECS:
            units = {name: f"{units[name]}; code 65535 is {white:g}" for name, white in FILM_WHITE.items()}
        replace_text(self._report, json.dumps({**report, "units": units}, indent=2) + "\n")
        if self._overwrite:
            self._remove_older()
        shutil.rmtree(self._parts)
        self._unlock()
        return [*written, self._log_path, self._report]

    def _remove_older(self) -> None:
        """Remove films and single frames of the run that this one replaces, where it has none of that name."""
        kinds = [("preview", WATCHABLE), *((image, kind) for image in FILM_WHITE for kind in LOSSLESS.values())]
        films = {self.directory / f"{self.stem}_{image}{kind.suffix}" for image, kind in kinds}
        for film in films - {self._film(image) for image in self._kinds}:
            film.unlink(missing_ok=True)
        own = {self._exr_path(line["frame"]) for line in self.lines() if "damaged" not in line}
        for path in self._frames():
            if self.kind.format != "exr" or path not in own:
                path.unlink()


def is_unfinished(directory: Path, stem: str) -> bool:
    """True for a sequence whose run was stopped, or is under way."""
    return _parts_of(directory, stem).is_dir() and not (directory / f"{stem}.json").exists()


def _parts_of(directory: Path, stem: str) -> Path:
    return directory / f".polsep-{stem}"


def read_rate(report: Path) -> float | None:
    """Frames per second in the report of a sequence; None where there is none, or it has none."""
    try:
        rate: Any = parse_json(read_text(report))
        for name in ("settings", "kind", "rate"):
            rate = rate[name]
    except (OSError, ValueError, LookupError, TypeError):
        return None
    return float(rate) if isinstance(rate, int | float) and rate > 0 else None


def write_exr(path: Path, picture: Picture, compression: str) -> None:
    """Write half floats, layers diffuse, specular, any combined or Stokes images, and all light, atomically."""
    layers = {"diffuse": picture.diffuse, "specular": picture.specular, **stokes_layers(picture.stokes)}
    if picture.combined is not None:
        layers["combined"] = picture.combined
    notes = exr_notes({layer: UNITS[layer] for layer in layers}, picture.report)
    layers[TOTAL] = picture.diffuse + picture.specular if picture.combined is None else picture.combined
    with atomic_path(path) as part, part.open("wb") as stream:
        stream.writelines(encode_exr_halves(layers, notes, compression))


def _write_pixels(film: Film, pixels: NDArray[Any], white: float | None) -> None:
    """Append an image to a film; ``white``: the value of the largest code of linear light."""
    if white is not None:
        from polsep.io.results.pixels_kernel import code_planes

        pixels = code_planes(pixels, white)
    film.write(pixels)
