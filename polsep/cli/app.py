"""The group of commands, the options that several commands share, and how failures are reported.

Exit status: 0 only when everything asked for was written; 2 after bad input, with one line per failure on stderr;
130 after Ctrl-C, 143 after SIGTERM, 129 where the terminal was closed.
"""

from __future__ import annotations

import io
import math
import os
import shlex
import signal
import sys
from collections.abc import Callable, Iterable, Mapping
from functools import reduce
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any, NoReturn

import click

from polsep import __version__
from polsep.compute.installed import is_installed
from polsep.io.raw.extensions import PLACEHOLDER
from polsep.io.store.errors import MOST, one_line, printable

if TYPE_CHECKING:
    from polsep.io.raw.frames import ReadOptions
    from polsep.light.light_color import LightColor
    from polsep.sensor.camera import Layout

    _ParamType = click.ParamType[Any]
else:
    _ParamType = click.ParamType  # generic from click 8.4 on

Command = Callable[..., Any]
Decorator = Callable[[Command], Command]

SETTINGS = {"help_option_names": ["-h", "--help"], "show_default": True, "max_content_width": 100}

#: Signals that ask the program to end, Ctrl-C apart: by the system, and where the terminal is closed (not on Windows).
ENDINGS = ("SIGTERM", "SIGHUP")


class Place(click.Path):
    """A path; an empty one, which would be the current folder, is an error that names its option."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Return the path. Raises BadParameter."""
        if value == "":
            self.fail("expected a path, found an empty one", param, ctx)
        return super().convert(value, param, ctx)


DIR = Place(path_type=Path)
FILE = Place(path_type=Path, dir_okay=False)


class Number(_ParamType):
    """A finite number in a range, of type ``kind``; another one is an error that names its option as typed.

    ``above``: the lower end itself is excluded.
    """

    name = "number"

    def __init__(
        self, kind: Callable[[Any], float], low: float = -math.inf, high: float = math.inf, above: bool = False
    ) -> None:
        self.kind, self.low, self.high, self.above = kind, low, high, above

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Return the number. Raises BadParameter."""
        try:
            number = self.kind(value)
            fits = math.isfinite(number) and self.low <= number <= self.high and not (self.above and number == self.low)
        except (ValueError, ArithmeticError):
            fits = False
        if not fits:
            self.fail(f"expected {self._range()}, found {str(value)!r:.40}", param, ctx)
        return number

    def _range(self) -> str:
        noun = "a whole number" if self.kind is int else "a finite number"
        if self.high < math.inf:
            return f"{noun} from {self.low:.10g} to {self.high:.10g}"
        if self.low > -math.inf:
            return f"{noun} above {self.low:g}" if self.above else f"{noun} of {self.low:g} or more"
        return noun


def _ratio(text: Any) -> float:
    """A number, or the ratio of two, like NTSC's 24000/1001. Raises ValueError, ZeroDivisionError."""
    over, slash, under = str(text).partition("/")
    return float(over) / float(under) if slash else float(over)


class Word(_ParamType):
    """One of a few words; another one is an error that names its option as typed."""

    name = "word"

    def __init__(self, *words: str) -> None:
        self.words = words

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Return the word. Raises BadParameter."""
        if value not in self.words:
            self.fail(
                f"expected {', '.join(self.words[:-1])} or {self.words[-1]}, found {str(value)!r:.40}", param, ctx
            )
        return value


class Stem(_ParamType):
    """The name of output files, which get their endings; one with an ending is an error that names its option."""

    name = "stem"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Return the name. Raises BadParameter."""
        if Path(value).suffix.lower() in (".exr", ".npz", ".tif", ".tiff", ".png", ".json", ".glb", ".mp4"):
            self.fail(f"expected a name without an ending, as {Path(value).stem}, found {str(value)!r:.80}", param, ctx)
        return value


STEM = Stem()
COUNT, POSITIVE, FINITE = Number(int, 1), Number(float, 0, above=True), Number(float)
RATE = Number(_ratio, 0.001, 100_000)
COMPRESSION, DAMAGED = Word("none", "zip", "piz"), Word("stop", "skip")

LAYOUT = click.option(
    "--layout", metavar="color|mono|SPEC", help="Filter layout of the sensor, as in 'polsep separate'."
)
BLACK_LEVEL = click.option("--black-level", type=FINITE, default=0.0, metavar="N", help="Sample value without light.")
WHITE_LEVEL = click.option(
    "--white-level",
    type=FINITE,
    metavar="N",
    help="Sample value at which the sensor clips; 12-bit values in 16-bit words need it.  "
    "[default: largest of the data type]",
)
LIGHT_COLOR = click.option(
    "--light-color",
    default="auto",
    metavar="auto|white|R,G,B",
    help="Colour of the light: auto finds it in the frame; or camera RGB.",
)
SIZE = click.option(
    "--size", "--frame-size", "size", metavar="WxH", help="Size of headerless raw frames, like 2448x2048."
)
PIXEL_FORMAT = click.option(
    "--pixel-format", metavar="NAME", help="GenICam pixel format of headerless raw frames, like BayerRG12p."
)
CALIBRATION = click.option(
    "--calibration", type=FILE, metavar="FILE", help="Calibration of the sensor, of 'polsep calibrate'."
)
AMBIENT = click.option(
    "--ambient",
    type=click.Path(path_type=Path),
    multiple=True,
    metavar="FRAME",
    help="Frame with the lamp off, subtracted; of several (the option repeated, or in a file) their mean.",
)
OVERWRITE = click.option("--overwrite", is_flag=True, help="Replace existing results.")
SEPARATED_BY = click.option(
    "--method", default="auto", metavar="NAME", help="Method that separates raw frames; see 'polsep methods'."
)
INTEGRATION = click.option(
    "--integration",
    type=Word("bilateral", "smooth"),
    default="bilateral",
    metavar="bilateral|smooth",
    help="Depth with jumps, or one smooth surface.",
)
TURNTABLE = click.option(
    "--turntable", is_flag=True, help="Also write DIR/STEM.mp4, the turning mesh; needs the extra video."
)
WEIGHTS = click.option(
    "--weights", type=click.Path(path_type=Path), metavar="FILE", help="Weights of 'polsep train'.  [default: shipped]"
)
STOKES = click.option("--stokes", is_flag=True, help="EXR files also get the measured Stokes images S0, S1, S2.")
DEVICE = click.option("--device", default="auto", metavar="NAME", help="Device: auto, cpu or cuda (extra torch).")
ENGINE = click.option(
    "--engine",
    type=Word("local", "ray"),
    default="local",
    metavar="NAME",
    help="local: this machine; ray: the cluster of RAY_ADDRESS (extra ray).",
)


def add_options(*options: Decorator) -> Decorator:
    """The decorator that gives a command these options, in the order of its help."""

    def decorate(command: Command) -> Command:
        return reduce(lambda decorated, option: option(decorated), reversed(options), command)

    return decorate


#: How raw frames are corrected, and how they are read too; whole frames of the light's colour too.
CORRECTING = add_options(BLACK_LEVEL, WHITE_LEVEL, CALIBRATION, AMBIENT)
READING = add_options(LAYOUT, CORRECTING)
LIT_READING = add_options(READING, LIGHT_COLOR)


class Group(click.Group):
    """Commands, which the help lists by their whole first sentence."""

    group_class = type

    def add_command(self, cmd: click.Command, name: str | None = None) -> None:
        """Add a command."""
        cmd.short_help = (cmd.help or "").partition("\n\n")[0]
        super().add_command(cmd, name)


@click.group(cls=Group, context_settings=SETTINGS, no_args_is_help=True)
@click.version_option(__version__, message="polsep %(version)s")
def app() -> None:
    """One raw frame of a polarization camera in, a diffuse and a specular image out."""


def print_note(line: str) -> None:
    """Print one line for the user on stderr; stdout is for results."""
    print(f"polsep: {printable(line)}", file=sys.stderr)


def print_results(notes: Iterable[str], results: Iterable[object]) -> None:
    """Print notes for the user, then a line for each result, such as a file that was written."""
    for note in notes:
        print_note(note)
    for result in results:
        print(result)


def said_command(program: str) -> str:
    """The command that runs, with its arguments and the options given to it, but for files and folders."""
    context = click.get_current_context()
    words = [program, context.info_name or ""]
    for parameter in context.command.params:
        name, given = parameter.name or "", context.params.get(parameter.name or "")
        if isinstance(parameter, click.Argument):
            words.append(str(given))
        elif is_given(name):
            if getattr(parameter, "is_flag", False):
                words.append(max(parameter.opts, key=len))
            elif not isinstance(parameter.type, click.Path):
                words += [max(parameter.opts, key=len), shlex.quote(str(given))]
    return " ".join(words)


def parse_size(text: str | None) -> tuple[int, int] | None:
    """Width and height from ``WIDTHxHEIGHT``. Raises ValueError, which names the option of the command."""
    if text is None:
        return None
    option = next(param.opts[0] for param in click.get_current_context().command.params if param.name == "size")
    width, x, height = text.lower().partition("x")
    if not (x and width.isdecimal() and height.isdecimal() and int(width) and int(height)):
        raise ValueError(f"expected {option} WIDTHxHEIGHT like 2448x2048, found {text!r}")
    return int(width), int(height)


def parse_numbers(
    text: str, expected: str, fits: Callable[[tuple[float, ...]], bool] = lambda _: True
) -> tuple[float, ...]:
    """Numbers from text with commas. Raises ValueError, which says what was ``expected``, also where they don't fit."""
    try:
        found = tuple(float(part) for part in text.split(","))
    except ValueError:
        found = None
    if found is None or not fits(found):
        raise ValueError(f"expected {expected}, found {text!r:.40}")
    return found


def check_read_options(options: Mapping[str, Any]) -> None:
    """Raise ValueError on levels, sizes and files that `read_options` would refuse; without heavy imports."""
    black, white = options["black_level"], options["white_level"]
    if white is not None and not white > black:
        raise ValueError(f"expected --white-level above the black level, found white {white:g}, black {black:g}")
    parse_size(options.get("size"))
    require_paths(*filter(None, [options.get("calibration"), *options.get("ambient", ())]))


def read_light(options: Mapping[str, Any]) -> LightColor | str:
    """The colour of the light from the options of a command. Raises ValueError, which names the option."""
    from polsep.light.light_color import parse_light_color

    try:
        return parse_light_color(options["light_color"])
    except ValueError as error:
        raise ValueError(f"--light-color: {error}") from None


def chosen_layout(options: Mapping[str, Any]) -> Layout | None:
    """The layout that ``--layout`` says, None if it was not given. Raises ValueError."""
    from polsep.sensor.camera import Layout

    try:
        return None if options["layout"] is None else Layout.parse(options["layout"])
    except ValueError as error:
        raise ValueError(f"--layout: {error}") from None


def read_options(options: Mapping[str, Any]) -> ReadOptions:
    """Options of reading raw frames, from the options of a command. Raises ValueError."""
    check_read_options(options)
    from polsep.io.raw.corrections import with_corrections
    from polsep.io.raw.frames import ReadOptions

    read = ReadOptions(
        chosen_layout(options),
        options["black_level"],
        options["white_level"],
        parse_size(options.get("size")),
        options.get("pixel_format"),
        options.get("pages", "auto"),
    )
    return with_corrections(read, options.get("calibration"), options.get("ambient", ()))


def is_given(name: str) -> bool:
    """True for an option of the command that runs, by its name in Python, that the user typed."""
    return click.get_current_context().get_parameter_source(name) == click.core.ParameterSource.COMMANDLINE


#: Options that say something of raw frames alone.
OF_FRAMES = ("white_level", "black_level", "layout", "calibration", "ambient", "size", "pixel_format", "method")


def refuse_frame_options(other: str) -> None:
    """Raise ValueError on an option of raw frames that was given beside something else: it would change nothing."""
    for option in click.get_current_context().command.params:
        if option.name in OF_FRAMES and is_given(option.name):
            raise ValueError(f"expected {option.opts[0]} with raw frames, found it with {other}")


def correcting_files(options: Mapping[str, Any]) -> tuple[Path, ...]:
    """The files of a calibration and of lamp-off frames, which no output may replace."""
    from polsep.io.raw.sequences import input_files

    paths = [options.get("calibration"), *options.get("ambient", ())]
    return tuple(file for path in paths if path is not None for file in input_files(path))


#: A module of each extra by which it is known; several where an extra has several uses.
EXTRAS = {
    "torch": ("torch",),
    "mesh": ("embreex", "scipy"),
    "render": ("embreex", "numba", "scipy", "torch"),
    "ray": ("ray",),
    "video": ("av",),
    "train": ("embreex", "lightning_fabric", "numba", "skimage", "tensorboard", "torch"),
    "export": ("onnx", "onnxscript", "torch"),
    "view": ("gradio",),
    "photos": ("cv2", "rawpy"),
    "napari": ("napari",),
    "camera": ("pypylon",),
    "bench": ("embreex", "flip_evaluator", "matplotlib", "numba", "scipy", "torch"),
    "mitsuba": ("mitsuba",),
}


def has_extra(extra: str) -> bool:
    """True if all modules of an extra are installed; imports none."""
    return missing_module(extra) is None


def missing_module(extra: str) -> str | None:
    """A module of an extra that is not installed, None if all are."""
    return next((name for name in EXTRAS[extra] if not is_installed(name)), None)


def require_extra(extra: str, otherwise: str = "") -> None:
    """Raise ValueError, which names the extra to install, unless it is there. To call before any work.

    ``otherwise``: options that need no extra.
    """
    if (missing := missing_module(extra)) is not None:
        other = f" or {otherwise}" if otherwise else ""
        raise ValueError(f"expected the extra {extra!r} (pip install 'polsep[{extra}]'){other}, found no {missing}")


def require_paths(*paths: str | Path) -> None:
    """Raise ValueError, which names the first path where nothing is. To call before heavy imports."""
    for path in paths:
        if PLACEHOLDER not in str(path) and not os.path.lexists(path):
            raise ValueError(one_line(f"{path}: expected a file, found nothing at this path"))


def main() -> None:
    """Run the program: bad input is one line on stderr and exit status 2."""
    _prepare()
    try:
        app(standalone_mode=False)
    except click.exceptions.NoArgsIsHelpError as error:
        print(error.format_message())
        sys.exit(2)
    except (KeyboardInterrupt, click.Abort):
        print_note("stopped")
        sys.exit(130)
    except BrokenPipeError:
        sys.stderr.close()  # nobody reads our output any more
        sys.exit(1)
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] != "torch":
            raise
        print_note("error: expected the extra 'torch' (pip install 'polsep[torch]'), found no torch")
        sys.exit(2)
    except (click.ClickException, ValueError, RuntimeError, OSError, MemoryError) as error:
        message = error.format_message() if isinstance(error, click.ClickException) else str(error) or "out of memory"
        print_note(f"error: {one_line(message, 2 * MOST)}")
        sys.exit(2)


def _prepare() -> None:
    """Have requests to end remove temporary files, and names of files printed that do not fit the terminal."""
    for name in ENDINGS:
        number = getattr(signal, name, None)
        if number is not None and signal.getsignal(number) is not signal.SIG_IGN:  # as by nohup
            signal.signal(number, _exit_on_signal)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper) and stream.errors == "strict":
            stream.reconfigure(errors="backslashreplace")


def _exit_on_signal(number: int, frame: FrameType | None) -> NoReturn:
    """Exit on one of `ENDINGS` as on Ctrl-C, so that temporary files are removed."""
    sys.exit(128 + number)
