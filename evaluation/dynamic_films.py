"""Make the films of docs/video.md (the paper's Fig. 7): python -m evaluation.dynamic_films docs/images

Renders the three selection films (extras render, video), separates them as recordings and keeps films: what the
camera sees, diffuse, specular. dynamic.jpg shows three frames of each.
"""

import sys
from pathlib import Path
from shutil import copyfile
from tempfile import TemporaryDirectory

import av
import numpy as np
from PIL import Image

from evaluation.testsets.dynamic import FILMS, RATE, play
from polsep.io.raw.frames import ReadOptions
from polsep.io.results.sequences import SequenceKind
from polsep.video.recordings import Target, VideoOptions, separate_video


def main(out: Path) -> None:
    """Write dynamic_turning.mp4, dynamic_light.mp4, dynamic_crossing.mp4 and dynamic.jpg."""
    out.mkdir(parents=True, exist_ok=True)
    rows = []
    for film in FILMS.values():
        with TemporaryDirectory() as folder:
            recording = Path(folder) / f"{film.name}.npy"
            frames = [frame.mosaic.data.numpy().astype(np.uint16) for frame in play(film)]
            np.save(recording, np.stack(frames))
            kind = SequenceKind("none", rate=RATE)
            read, options = ReadOptions(white_level=4095.0), VideoOptions("joint", "white")
            *_, end = separate_video(recording, read, options, Target(Path(folder) / "out", kind))
            copyfile(end.written[0], out / f"dynamic_{film.name}.mp4")
            with av.open(str(end.written[0])) as container:
                shown = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
            rows.append(np.concatenate([shown[k] for k in (10, 50, 90)], axis=1))
            print(out / f"dynamic_{film.name}.mp4", end.done, "frames")
    Image.fromarray(np.concatenate(rows)).save(out / "dynamic.jpg", quality=88)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
