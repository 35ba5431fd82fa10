"""The command that trains networks: train."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import click

from polsep.cli.app import COUNT, DIR, POSITIVE, Number, Word, app, is_given, require_extra, require_paths

#: What can be trained.
RUNGS = (
    *("joint-large", "joint", "joint-fast", "material", "shape"),
    *("paper", "unpolarized", "polarized", "shared", "signed", "no-angle", "stokes"),
)
_JOINT, _FROM_FOLDER, _LADDER = RUNGS[:3], RUNGS[3:5], RUNGS[5:]
#: Options that only some rungs have, and those rungs.
OWN: dict[str, tuple[str, ...]] = dict.fromkeys(("data", "looks", "workers", "constants"), (*_JOINT, *_LADDER))
OWN |= dict.fromkeys(("levels", "fold"), _LADDER) | dict.fromkeys(("blocks", "entry", "ablation"), _JOINT)
OWN |= dict.fromkeys(("seen", "examples", "folder", "until"), _FROM_FOLDER)
OWN |= {"part": (*_JOINT, "shape"), "side": ("shape",), "meshes": ("shape",), "cues": ("material",)}


@app.command()
@click.argument("rung", type=Word(*RUNGS))
@click.option("-o", "--output", type=DIR, required=True, metavar="DIR", help="New directory, or one to resume.")
@click.option(
    "--data",
    default="mosaic",
    metavar="NAME",
    help="mosaic: noisy colour frames; mono: no colour filters; co-sited: all samples at one place, as in the paper.",
)
@click.option(
    "--looks",
    default="varied",
    metavar="NAME",
    help="Rendered scenes: real; varied: under a perfect white lamp; usual: as in the paper, no glare or relief.",
)
@click.option("--width", type=COUNT, metavar="N", help="Channels of the network's first level; 32 on the ladder.")
@click.option("--levels", type=COUNT, default=3, metavar="N", help="How often a ladder network halves the resolution.")
@click.option("--fold", type=COUNT, default=2, metavar="N", help="Fold N x N pixels into channels; 1 folds none.")
@click.option("--blocks", metavar="N,N,...", help="Residual blocks per level of a joint network.")
@click.option(
    "--entry",
    type=Number(int, 0),
    metavar="N",
    help="Channels after a joint network's first layer; 0 keeps all inputs.",
)
@click.option("--ablation", default="none", metavar="NAME", help="Ablation of a joint network.")
@click.option(
    "--part",
    default="all",
    metavar="NAME",
    help="Part to train: all; joint networks: details or errors; shape: small, layers that are not rounded.",
)
@click.option(
    "--input",
    "seen",
    default="separated",
    metavar="NAME",
    help="material: unseparated, separated, perfect; shape: separated, stokes, rgb, perfect.",
)
@click.option(
    "--examples", type=COUNT, metavar="N", help="material, shape: number of training examples.  [default: 768, 3200]"
)
@click.option("--side", type=COUNT, default=96, metavar="PX", help="shape: side of the images that the network sees.")
@click.option(
    "--meshes",
    type=DIR,
    metavar="DIR",
    help="shape: folder of GLB, OBJ, OFF, PLY or STL files, +y up, which as many examples again show.",
)
@click.option("--cues", metavar="NAME,...", help="material: inputs beside the images, such as details.")
@click.option(
    "--folder", type=DIR, metavar="DIR", help="material, shape: folder of the examples.  [default: DIR/../examples]"
)
@click.option(
    "--steps",
    type=Number(int, 0),
    default=20_000,
    metavar="N",
    help="Batches of 8 crops, or of 4 materials; 0 with --start: write and score that mean alone.",
)
@click.option("--until", type=COUNT, metavar="N", help="material, shape: end at this step of the schedule.")
@click.option("--rate", type=POSITIVE, default=1e-3, metavar="X", help="Peak learning rate.")
@click.option("--seed", type=Number(int), default=0, metavar="N", help="Random seed of the weights and of the data.")
@click.option("--workers", type=COUNT, default=1, metavar="N", help="Rendering processes per device.")
@click.option("--devices", type=COUNT, default=1, metavar="N", help="Number of GPUs, where there are any.")
@click.option(
    "--start",
    type=click.Path(path_type=Path),
    multiple=True,
    metavar="FILE",
    help="Weights to start from; the mean of several.",
)
@click.option("--refit", is_flag=True, help="Fit the linear filter of a joint network again after --start.")
@click.option(
    "--set",
    "constants",
    multiple=True,
    metavar="NAME=X,...",
    help="Another constant of the examples, as variety.MATTE_SHARE=0.3; polsep/train has them.",
)
@click.option("--precision", default="bf16-mixed", metavar="NAME", help="bf16-mixed or 32-true.")
def train(rung: str, output: Path, data: str, **options: Any) -> None:
    """Train joint-large, joint, joint-fast, material, shape or a rung of the paper's ladder: paper, unpolarized,
    polarized, shared, signed, no-angle, stokes.

    Data are rendered while training, from seeds that no test uses. Run the same command again to resume a run that was
    stopped. 'tensorboard --logdir DIR' shows its curves. Needs the extra train.

    \b
    polsep train joint -o runs/joint
    polsep train paper --data mono -o runs/mono                           for cameras without colour filters
    polsep train paper --width 64 --levels 4 --fold 1 -o runs/unet64      the classic U-Net
    polsep train material --input separated --steps 2000 -o runs/separated
    polsep train shape --steps 5000 -o runs/shape
    """
    refuse_foreign(rung)
    require_extra("train")
    require_paths(*options["start"], *filter(None, [options["meshes"]]))
    from polsep.io.store.atomic import require_writable

    require_writable(output)
    from polsep.train.command import choose_options, plan_run, train_weights
    from polsep.train.constants import read_constant
    from polsep.train.loop import Run, Schedule
    from polsep.train.material_command import choose_material, train_material
    from polsep.train.shape_command import choose_shape, train_shape
    from polsep.train.stream import StreamOptions

    shared = {name: options[name] for name in ("workers", "devices", "start", "refit")}
    if rung in _FROM_FOLDER:
        folder = options["folder"] or output.parent / "examples"
        if rung == "material":
            material, schedule = choose_material(options | {"examples": options["examples"] or 768})
            run = Run(output, schedule=schedule, until=options["until"], **shared)
            path = train_material(material, run, folder, _print_log)
        else:
            shape, schedule = choose_shape(options | {"examples": options["examples"] or 3200})
            run = Run(output, schedule=schedule, until=options["until"], **shared)
            path = train_shape(shape, run, folder, _print_log, options["meshes"])
    else:
        network = choose_options(rung, data, options)
        schedule = Schedule(options["steps"], options["rate"], precision=options["precision"])
        constants = tuple(read_constant(text) for text in options["constants"])
        stream = StreamOptions(looks=options["looks"], constants=constants)
        run = Run(output, stream=stream, schedule=schedule, **shared)
        path = train_weights(network, plan_run(run, network), _print_log)
    print(path)


def refuse_foreign(rung: str) -> None:
    """Raise ValueError on an option that was given and is none of a rung: it would change nothing."""
    for parameter in click.get_current_context().command.params:
        rungs = OWN.get(parameter.name or "", RUNGS)
        if rung not in rungs and is_given(parameter.name or ""):
            raise ValueError(f"expected {parameter.opts[0]} with {', '.join(rungs)}, found it with {rung}")


def _print_log(line: dict[str, Any]) -> None:
    """Print one line of the training log on stderr."""
    values = (f"{name} {value:.4g}" for name, value in line.items())
    print(", ".join(values), file=sys.stderr, flush=True)
