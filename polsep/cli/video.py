"""The command on recordings: video."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import click

from polsep.cli.app import (
    AMBIENT,
    BLACK_LEVEL,
    CALIBRATION,
    DEVICE,
    DIR,
    ENGINE,
    LAYOUT,
    LIGHT_COLOR,
    OVERWRITE,
    PIXEL_FORMAT,
    SIZE,
    WHITE_LEVEL,
    app,
    extra_needed,
    print_note,
    progress_bar,
    read_options,
)


@app.command()
@click.argument("recording", type=click.Path(path_type=Path), metavar="IN")
@click.option("-o", "--output", type=DIR, required=True, metavar="DIR", help="Folder of the results.")
@click.option(
    "--method", default="auto-fast", metavar="NAME", help="Method; auto-fast is joint-fast where it fits the frames."
)
@LAYOUT
@BLACK_LEVEL
@WHITE_LEVEL
@CALIBRATION
@AMBIENT
@LIGHT_COLOR
@click.option(
    "--format",
    default="exr",
    metavar="exr|ffv1|ffvhuff|none",
    help="A file per frame; lossless videos, small or fast; or only a preview.",
)
@click.option("--compression", default="none", metavar="none|zip|piz", help="Compression of EXR files.")
@click.option("--preview/--no-preview", default=True, help="Write a video of input, diffuse and specular to watch.")
@click.option("--rate", type=float, default=25.0, metavar="N", help="Frames per second of the videos written.")
@click.option(
    "--filter", default="temporal", metavar="temporal|none", help="temporal: average over frames where nothing moves."
)
@click.option("--frames", type=int, metavar="N", help="Separate the first N frames at most.")
@click.option("--damaged", default="stop", metavar="stop|skip", help="Stop at a damaged frame, or skip it.")
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
    the same command again to resume a run that was stopped. Writing videos needs the extra video.

    \b
    polsep video frames/ -o out --white-level 4095
    polsep video run.raw --size 2448x2048 --pixel-format BayerRG12p -o out --rate 24
    polsep video run.mkv -o out --format ffv1 --method joint
    """
    from polsep.compute.workers import keep_memory
    from polsep.io.results.sequences import SequenceKind
    from polsep.methods import check_method
    from polsep.pipeline import parse_light_color
    from polsep.video.recordings import Target, VideoOptions, separate_video

    keep_memory()
    read = read_options(options)
    check_method(options["method"])
    light = parse_light_color(options["light_color"])
    shared = {name: options[name] for name in ("method", "device", "damaged", "frames", "engine", "filter")}
    run = VideoOptions(light_color=light, **shared)
    kind = SequenceKind(options["format"], options["compression"], options["preview"], options["rate"])
    target = Target(output, kind, options["overwrite"])
    failures = 0
    with extra_needed("ray", "ray"), progress_bar() as progress:
        task = progress.add_task("separating", total=None, speed="")
        for step in separate_video(recording, read, run, target):
            speed = progress.tasks[0].speed
            shown = f"{speed:.1f} frames/s" if speed else ""
            progress.update(task, completed=step.done, total=step.count, speed=shown)
            if step.warning is not None:
                print_note(step.warning)
            for path in step.written:
                print(path)
            failures += step.damaged
    if failures:
        sys.exit(2)
