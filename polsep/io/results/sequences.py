"""What a video becomes on disk: EXR files or lossless films, a film to watch, and what a killed run goes on from.

The work is done in parts of `PART` frames. A part's films are whole files in DIR/.polsep-STEM; its record, written
last, makes it count, and holds what the next part depends on. A run that was killed begins anew at the first part
without a record, so its files are those of a run that was not. `finish` joins the films and leaves DIR/STEM.json,
DIR/STEM.jsonl with a line per frame, and no part behind.

Conventions: images are linear light, 1.0 = one measurement at the white level. EXR: half floats, layers as in
`io.results.separation_writer`. Films: 16 bits, of which 65535 is the value in `FILM_WHITE`.
"""

from __future__ import annotations

import glob
import io
import json
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from polsep.io.raw.videos import load_library
from polsep.io.results.exr import COMPRESSIONS, as_half_planes, encode_exr, write_exr_halves
from polsep.io.results.films import LOSSLESS, LOSSLESS_GREY, WATCHABLE, Film, FilmKind, as_codes, join_films
from polsep.io.results.separation_writer import UNITS
from polsep.io.results.sidecars import require_same_settings
from polsep.io.store.atomic import OutputError, atomic_path, replace_bytes, replace_text, write_checked

#: Frames after which a run can go on: a second, about. Films have a key frame at least as often.
PART = 25
#: What images become: an EXR file per frame, a lossless film each, or nothing but the film to watch.
FORMATS = ("exr", "ffv1", "none")
#: The value of code 65535 in lossless films.
FILM_WHITE = {"diffuse": 2.0, "specular": 8.0}

State = dict[str, NDArray[Any]]


class Picture(NamedTuple):
    """What is kept of a frame: float32 ``diffuse``, ``specular [h, w, C]``, ``panels`` to watch, a ``line`` to log.

    ``combined``: for EXR files only, of frames that were edited.
    """

    diffuse: NDArray[np.float32]
    specular: NDArray[np.float32]
    panels: NDArray[np.uint8] | None
    line: dict[str, Any]
    combined: NDArray[np.float32] | None = None


@dataclass(frozen=True)
class SequenceKind:
    """How images are kept: one of `FORMATS`, EXR's compression, whether there is a film to watch, frames per second."""

    format: str = "exr"
    compression: str = "none"
    preview: bool = True
    rate: float = 25.0

    def __post_init__(self) -> None:
        if self.format not in FORMATS:
            raise OutputError(f"expected a format of {', '.join(FORMATS)}, found {self.format!r}")
        if self.compression not in COMPRESSIONS:
            raise OutputError(f"expected a compression of {', '.join(COMPRESSIONS)}, found {self.compression!r}")
        if not 0.001 <= self.rate <= 100_000:
            raise OutputError(f"expected a rate of 0.001 to 100000 frames per second, found {self.rate:g}")
        if self.format == "none" and not self.preview:
            raise OutputError("expected something to write, found format none and no preview")


class Sequence:
    """The outputs ``stem`` in a directory, open to be written; ``settings`` decide about every byte of them.

    State: which parts are done. Raises OutputError where finished outputs, or parts of a run with other settings, are
    there and ``overwrite`` is False.
    """

    def __init__(
        self, directory: Path, stem: str, kind: SequenceKind, settings: dict[str, Any], overwrite: bool = False
    ) -> None:
        self.directory, self.stem, self.kind, self._settings = directory, stem, kind, settings
        self._overwrite = overwrite
        self._parts = directory / f".polsep-{stem}"
        self.report = directory / f"{stem}.json"
        if overwrite:
            shutil.rmtree(self._parts, ignore_errors=True)
        elif self.report.exists():
            raise OutputError(f"expected no {self.report}, found one from before; --overwrite replaces it")
        if self.films():
            load_library()  # or else the first part would miss it
        self._parts.mkdir(parents=True, exist_ok=True)
        kept = self._parts / "run.json"
        if kept.exists():
            require_same_settings(kept, settings, f"{directory / stem}", "; --overwrite begins anew")
        else:
            replace_text(kept, json.dumps(settings, sort_keys=True))
        self.done = 0
        while self._record(self.done).exists():
            self.done += 1

    def _record(self, part: int) -> Path:
        return self._parts / f"{part:06d}.json"

    def _film(self, part: int, image: str, kind: FilmKind) -> Path:
        return self._parts / f"{part:06d}_{image}{kind.suffix}"

    @property
    def first(self) -> int:
        """The first frame that is not done."""
        return PART * self.done

    def state(self) -> State:
        """What the last part that is done left for the next one."""
        path = self._parts / f"{self.done - 1:06d}.npz"
        if not self.done or not path.exists():
            return {}
        with np.load(path, allow_pickle=False) as archive:
            return {name: archive[name] for name in archive.files}

    def films(self) -> dict[str, FilmKind]:
        """The films of a run by what they show."""
        films: dict[str, FilmKind] = {}
        if self.kind.format == "ffv1":
            films |= dict.fromkeys(
                ("diffuse", "specular"), LOSSLESS if self._settings["colors"] == 3 else LOSSLESS_GREY
            )
        return films | ({"preview": WATCHABLE} if self.kind.preview else {})

    def exr_path(self, index: int) -> Path:
        """The file of a frame."""
        return self.directory / f"{self.stem}_{index:06d}.exr"

    def begin_part(self) -> Part:
        """The next part, to be written frame by frame."""
        return Part(self, self.done)

    def end_part(self, part: Part, state: State) -> None:
        """Let a part count."""
        part.close()
        if state:
            stream = io.BytesIO()
            np.savez(stream, **state)  # type: ignore[arg-type]  # names are not parameters of savez
            replace_bytes(self._parts / f"{part.number:06d}.npz", stream.getvalue())
        replace_text(self._record(part.number), "".join(json.dumps(line) + "\n" for line in part.lines))
        with_state = self._parts / f"{part.number - 1:06d}.npz"
        with_state.unlink(missing_ok=True)
        self.done = part.number + 1

    def finish(self, report: dict[str, Any]) -> list[Path]:
        """Join the films, write report and log, remove the parts; the files of the run but for single frames."""
        written = []
        for image, kind in self.films().items():
            target = self.directory / f"{self.stem}_{image}{kind.suffix}"
            parts = [path for k in range(self.done) if (path := self._film(k, image, kind)).exists()]
            with atomic_path(target) as joined:
                join_films(parts, joined, kind, self.kind.rate)
            written.append(target)
        log = self.directory / f"{self.stem}.jsonl"
        replace_bytes(log, b"".join(self._record(k).read_bytes() for k in range(self.done)))
        units = {name: UNITS[name] for name in ("diffuse", "specular")}
        if self.kind.format == "ffv1":
            units = {name: f"{units[name]}; code 65535 is {white:g}" for name, white in FILM_WHITE.items()}
        replace_text(self.report, json.dumps({**report, "units": units}, indent=2) + "\n")
        if self._overwrite:
            self._drop_older_frames()
        shutil.rmtree(self._parts)
        return [*written, log, self.report]

    def _drop_older_frames(self) -> None:
        """Remove single frames of the run that this one replaces, where it has none of that number."""
        own = {self.exr_path(line["frame"]) for line in self.lines() if "damaged" not in line}
        for path in self.directory.glob(f"{glob.escape(self.stem)}_{6 * '[0-9]'}.exr"):
            if self.kind.format != "exr" or path not in own:
                path.unlink()

    def lines(self) -> list[dict[str, Any]]:
        """What was logged of every frame that is done."""
        return [json.loads(line) for k in range(self.done) for line in self._record(k).read_text().splitlines()]


class Part:
    """Some frames of a sequence while they are written. State: the films' encoders, and what is logged."""

    def __init__(self, sequence: Sequence, number: int) -> None:
        self.number, self.lines = number, list[dict[str, Any]]()
        self._sequence, self._films = sequence, dict[str, Film]()

    def __len__(self) -> int:
        return len(self.lines)

    def write(self, index: int, picture: Picture) -> None:
        """A frame into its file, or at the end of its films."""
        sequence = self._sequence
        if sequence.kind.format == "exr":
            write_exr(sequence.exr_path(index), picture, sequence.kind.compression)
        self.show(picture)

    def show(self, picture: Picture) -> None:
        """A frame in the films only, as black pictures stand for one that is missing."""
        for image, kind in self._sequence.films().items():
            pixels = picture.panels if image == "preview" else as_codes(getattr(picture, image), FILM_WHITE[image])
            assert pixels is not None
            self._film(image, kind, pixels).write(pixels)
        self.lines.append(picture.line)

    def _film(self, image: str, kind: FilmKind, pixels: NDArray[Any]) -> Film:
        if image not in self._films:
            path = self._sequence._film(self.number, image, kind)
            self._films[image] = Film(path, kind, (pixels.shape[0], pixels.shape[1]), self._sequence.kind.rate)
        return self._films[image]

    def close(self) -> None:
        """End the films; those of a part that does not count are overwritten by the next run."""
        for film in self._films.values():
            film.close()
        self._films = {}


def write_exr(path: Path, picture: Picture, compression: str) -> None:
    """One part of half floats, layers diffuse, specular and any combined, beside its place and then renamed."""
    layers = {"diffuse": picture.diffuse, "specular": picture.specular}
    if picture.combined is not None:
        layers["combined"] = picture.combined
    planes = as_half_planes(layers)
    notes = {f"{layer}Units": UNITS[layer] for layer in layers}
    with atomic_path(path) as part:
        if compression == "none":
            write_exr_halves(part, planes, notes)
        else:
            write_checked(part, encode_exr(planes, notes, compression))
