"""The command on recordings: video."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import click

from polsep.cli.app import (
    COMPRESSION,
    COUNT,
    DAMAGED,
    DEVICE,
    DIR,
    ENGINE,
    LIT_READING,
    OVERWRITE,
    PIXEL_FORMAT,
    RATE,
    SIZE,
    STOKES,
    Word,
    app,
    correcting_files,
    has_extra,
    print_note,
    read_light,
    read_options,
    require_extra,
    require_paths,
)
from polsep.cli.progress import report_step, show_progress


@app.command()
@click.argument("recording", type=click.Path(path_type=Path), metavar="IN")
@click.option("-o", "--output", type=DIR, required=True, metavar="DIR", help="Folder of the results.")
@click.option(
    "--method", default="auto-fast", metavar="NAME", help="Method; auto-fast is joint-fast where it fits the frames."
)
@LIT_READING
@click.option(
    "--format",
    type=Word("exr", "ffv1", "ffvhuff", "none"),
    default="exr",
    metavar="exr|ffv1|ffvhuff|none",
    help="A file per frame; lossless videos, small or fast; or only a preview.",
)
@click.option(
    "--compression", type=COMPRESSION, default="none", metavar="none|zip|piz", help="Compression of EXR files."
)
@click.option(
    "--preview/--no-preview",
    default=None,
    help="Write a video of input, diffuse and specular to watch.  [default: where the extra video is installed]",
)
@click.option(
    "--rate",
    type=RATE,
    metavar="N",
    help="Frames per second of the videos written, like 24 or 24000/1001.  [default: those of the recording, else 25]",
)
@click.option(
    "--filter",
    type=Word("temporal", "none"),
    default="temporal",
    metavar="temporal|none",
    help="temporal: average over frames where nothing moves.",
)
@click.option("--frames", type=COUNT, metavar="N", help="Separate the first N frames at most.")
@click.option(
    "--damaged", type=DAMAGED, default="stop", metavar="stop|skip", help="Stop at a damaged frame, or skip it."
)
@STOKES
@SIZE
@PIXEL_FORMAT
@OVERWRITE
@DEVICE
@ENGINE
def video(recording: Path, output: Path, **options: Any) -> None:
    """Separate every frame of a recording.

    IN is a folder of frames or of 'polsep capture', a TIFF or NPY file of many frames, a lossless grey video (FFV1 in
    .mkv, raw .avi), or a headerless raw stream. DIR gets STEM_000123.exr (half floats, layers diffuse and specular) for
    every frame, or STEM_diffuse and STEM_specular as .mkv (FFV1, 16 bits) or .avi (FFVHuff, 16 bits: ten times as fast,
    1.6 times as large); STEM_preview.mp4 to watch; STEM.jsonl with a line of statistics per frame; and STEM.json. Run
    the same command again to resume a run that was stopped. Reading and writing videos needs the extra video; a folder
    of frames to EXR files needs none.

    \b
    polsep video frames/ -o out --white-level 4095
    polsep video run.raw --size 2448x2048 --pixel-format BayerRG12p -o out --rate 24
    polsep video run.mkv -o out --format ffv1 --method joint
    """
    require_paths(recording)
    from polsep.io.raw.extensions import LOSSLESS

    if options["rate"] is not None and options["format"] == "exr" and options["preview"] is False:
        raise ValueError("expected a film for --rate, found EXR files and --no-preview")
    if options["engine"] == "ray":
        require_extra("ray")
    if options["format"] in ("ffv1", "ffvhuff") or recording.suffix.lower() in LOSSLESS:
        require_extra("video")
    read = read_options(options)
    from polsep.compute.workers import keep_memory
    from polsep.io.results.sequences import SequenceKind
    from polsep.methods import check_method
    from polsep.video.recordings import Target, VideoOptions, separate_video

    keep_memory()
    check_method(options["method"])
    light = read_light(options)
    shared = {name: options[name] for name in ("method", "device", "damaged", "frames", "engine", "filter", "stokes")}
    run = VideoOptions(light_color=light, **shared)
    kind = SequenceKind(options["format"], options["compression"], with_preview(options["preview"]), options["rate"])
    target = Target(output, kind, options["overwrite"], correcting_files(options))
    with show_progress(f"separating {recording}") as progress:
        failures = sum(report_step(step, progress) for step in separate_video(recording, read, run, target))
    if failures:
        sys.exit(2)


def with_preview(asked: bool | None) -> bool:
    """True if a video to watch is to be written: as asked, else where its library is. Raises ValueError."""
    if asked:
        require_extra("video")
    if asked is None and not has_extra("video"):
        print_note("no video to watch is written: it needs the extra 'video' (pip install 'polsep[video]')")
    return has_extra("video") if asked is None else asked
