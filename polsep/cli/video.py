"""The command on recordings: video."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from polsep.cli.app import DIR, app, parse_size, say

if TYPE_CHECKING:
    from polsep.video.recordings import Progress


@app.command()
@click.argument("recording", type=click.Path(path_type=Path), metavar="IN")
@click.option("-o", "--output", type=DIR, required=True, metavar="DIR", help="Where results go.")
@click.option("--method", default="auto-fast", metavar="NAME", help="auto-fast: joint-fast where it fits the frames.")
@click.option("--layout", metavar="color|mono|SPEC", help="The sensor's filters, as for 'polsep separate'.")
@click.option("--black-level", type=float, default=0.0, metavar="N", help="Sample value of no light.")
@click.option(
    "--white-level", type=float, metavar="N", help="Sample value where the sensor clips.  [default: the type's largest]"
)
@click.option("--light-color", default="1,1,1", metavar="R,G,B", help="Camera RGB of the light, or 'estimate'.")
@click.option("--format", default="exr", metavar="exr|ffv1|none", help="A file per frame, a lossless film, or neither.")
@click.option("--compression", default="none", metavar="none|zip|piz", help="Of EXR files.")
@click.option("--preview/--no-preview", default=True, help="A film to watch: input, diffuse and specular.")
@click.option("--rate", type=float, default=25.0, metavar="N", help="Frames per second of films.")
@click.option("--filter", default="temporal", metavar="temporal|none", help="Averages over frames what does not move.")
@click.option("--frames", type=int, metavar="N", help="No more than the first N frames.")
@click.option("--damaged", default="stop", metavar="stop|skip", help="What to do at a damaged frame.")
@click.option("--size", metavar="WxH", help="Size of headerless raw, like 2448x2048.")
@click.option("--pixel-format", metavar="NAME", help="GenICam pixel format of headerless raw, like BayerRG12p.")
@click.option("--overwrite", is_flag=True, help="Replace results that exist.")
@click.option("--device", default="auto", metavar="NAME", help="auto, cpu or cuda.")
@click.option("--engine", default="local", metavar="NAME", help="local, or ray: the cluster of RAY_ADDRESS.")
def video(recording: Path, output: Path, **options: Any) -> None:
    """Separate every frame of a recording.

    IN is a folder of frames or of 'polsep capture', a TIFF or NPY file of many, a lossless grey video (FFV1 in .mkv,
    raw .avi), or a headerless raw stream. DIR gets STEM_000123.exr (half floats, layers diffuse and specular) for every
    frame, or STEM_diffuse.mkv and STEM_specular.mkv (FFV1, 16 bits); STEM_preview.mp4 to watch; STEM.jsonl with a line
    of statistics per frame; and STEM.json. A run that was stopped or killed goes on when the same command is given
    again. Films need the extra video.

    \b
    polsep video frames/ -o out --white-level 4095
    polsep video run.raw --size 2448x2048 --pixel-format BayerRG12p -o out --rate 24
    polsep video run.mkv -o out --format ffv1 --method joint
    """
    from polsep.compute.workers import keep_memory
    from polsep.io.raw.frames import ReadOptions
    from polsep.io.results.sequences import SequenceKind
    from polsep.methods import check_method
    from polsep.pipeline import parse_light_color
    from polsep.sensor.camera import Layout
    from polsep.video.recordings import Target, VideoOptions, separate_video

    keep_memory()
    try:
        read = ReadOptions(
            Layout.parse(options["layout"]) if options["layout"] else None,
            options["black_level"],
            options["white_level"],
            parse_size(options["size"]),
            options["pixel_format"],
        )
        check_method(options["method"])
        light = parse_light_color(options["light_color"])
        given = {name: options[name] for name in ("method", "device", "damaged", "frames", "engine", "filter")}
        run = VideoOptions(light_color=light, **given)
        kind = SequenceKind(options["format"], options["compression"], options["preview"], options["rate"])
        target = Target(output, kind, options["overwrite"])
        failures = sum(_follow(step) for step in _with_progress(separate_video(recording, read, run, target)))
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] != "ray":
            raise
        raise click.ClickException("expected the extra 'ray' (pip install 'polsep[ray]'), found none") from None
    except (ValueError, RuntimeError) as error:
        raise click.ClickException(str(error)) from None
    if failures:
        sys.exit(2)


def _follow(step: Progress) -> int:
    """Say what a step has to say; 1 if it is that a frame is left out."""
    if step.warning is not None:
        say(step.warning)
    for path in step.written:
        print(path)
    return int(step.damaged)


def _with_progress(steps: Iterator[Progress]) -> Iterator[Progress]:
    """The same steps under a progress bar with frames per second, where someone watches."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (
        TextColumn("separating"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[speed]}"),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=Console(stderr=True), disable=not sys.stderr.isatty()) as progress:
        task = progress.add_task("frames", total=None, speed="")
        for step in steps:
            speed = progress.tasks[0].speed
            shown = f"{speed:.1f} frames/s" if speed else ""
            progress.update(task, completed=step.done, total=step.count, speed=shown)
            yield step
