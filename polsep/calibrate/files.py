"""Files of frames in, a section of a calibration file out, and one line about what was found."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import islice
from pathlib import Path

from polsep import __version__
from polsep.calibrate.exposures import merge_exposures
from polsep.compute.arrays import to_numpy
from polsep.io.raw.corrections import read_mosaics
from polsep.io.raw.frames import Frame, ReadOptions, forgets_level, refuse_forgotten
from polsep.io.raw.sequences import input_files
from polsep.io.raw.tiff import write_merged
from polsep.io.store.atomic import refuse_existing, refuse_inputs, require_writable
from polsep.io.store.calibrations import maps_path, read_calibration, refuse_foreign_maps, write_calibration
from polsep.io.store.errors import input_error, refuse_repeated
from polsep.physics.stokes import axis_deg
from polsep.sensor.ambient import equally_exposed
from polsep.sensor.black_level import check_black_level
from polsep.sensor.calibration import Calibration
from polsep.sensor.camera import Mosaic
from polsep.sensor.corrections import Corrections
from polsep.sensor.encoding import MAX_EXPONENT, encoding_warning
from polsep.sensor.layout_check import check_layout
from polsep.sensor.levels import BlackFrame, Overexposed

#: Several pages of a file are frames: four of a turned polarizer, or of two exposures, obey the law of four angles too.
PAGES = "frames"
#: Frames of a file in which black is looked for.
LOOKS = 8
#: Words of a measurement before which nobody measured or said a level.
ASSUMED_BLACK = "; black was taken to be at 0: if it is not, measure it first ('polsep calibrate dark') and this again"
#: Difference of two sides of a flat frame from which on it is no lens's, and a degree that analysers hardly fall below.
LOPSIDED, LEAST_DIATTENUATION = 0.15, 0.9
#: A measurement: frames and the calibration so far to a calibration with one more section.
Measure = Callable[[Iterator[Mosaic], Calibration | None], Calibration]


def calibrate_files(
    paths: Sequence[Path], read: ReadOptions, output: Path, kind: str, measure: Measure
) -> tuple[str, tuple[str, ...]]:
    """Measure a ``kind`` from files of frames, write it into ``output``; a line about it, and notes.

    Other sections of ``output`` stay, and those that come before it (`corrections_for`) correct the frames. Raises
    ValueError.
    """
    refuse_foreign_maps(output)
    refuse_inputs([output, maps_path(output)], paths)
    require_writable(output.parent)
    before = read_calibration(output) if output.exists() else None
    if before is not None and read.layout is None:
        read = replace(read, layout=before.layout)
    used = None if before is None else corrections_for(kind, before)
    read = replace(read, corrections=used, pages=PAGES)
    if kind != "dark":
        require_black_level(paths, read)
    notes, first = dict[str, str](), iter([] if kind == "dark" else [None])
    times, merged = list[float](), list[bool]()

    def check(path: Path, frame: Frame) -> None:
        _require_white_level(path, frame)
        times.extend([] if frame.exposure is None else [frame.exposure])
        merged.append(frame.merged)
        found = [note for note in frame.notes if not isinstance(note, Overexposed | BlackFrame)]
        for _ in first:  # the first frame shows the layout of all
            found += _warnings(frame)
        for note in found:
            notes.setdefault(note, f"{frame.stem}: {note}")

    found = measure(read_mosaics(paths, read, check), before)
    if kind == "dark":
        found.require_black_level(read.black_level, "--black-level")
    written = write_calibration(output, found, __version__)
    known = kind == "dark" or read.black_level or found.black_level is not None or all(merged)
    black = "" if known else ASSUMED_BLACK
    line = f"{kind}: {describe(found, kind)}{black} -> {', '.join(str(path) for path in written)}"
    return line, (*notes.values(), *(_time_notes(times) if kind == "dark" else ()))


def _time_notes(times_s: Sequence[float]) -> tuple[str, ...]:
    """A note where dark frames were exposed for different times: what their pixels collect without light grows."""
    if not times_s or equally_exposed(times_s):
        return ()
    found = f"{min(times_s):.4g} s to {max(times_s):.4g} s"
    return (f"the dark frames were exposed for {found}: use the exposure time of the frames to come",)


def _warnings(frame: Frame) -> list[str]:
    """Warnings of a frame whose samples are encoded, or else of another layout."""
    assert isinstance(frame.data, Mosaic)  # as `read_mosaics` makes sure
    encoded = encoding_warning(frame.data)
    warning = check_layout(frame.data).warning if encoded is None else encoded
    return [] if warning is None else [warning]


def _require_white_level(path: Path, frame: Frame) -> None:
    """Raise InputError where nobody said the white level of a frame: the calibration would say it of all others."""
    if forgets_level(frame):
        wanted = "--white-level N, which the calibration keeps for all frames, such as 4095 for 12-bit values"
        raise input_error(path, f"expected {wanted} in 16-bit words, or 65535 for 16-bit ones; found none")


def require_black_level(paths: Sequence[Path], read: ReadOptions) -> None:
    """Raise InputError where the first frames of a file show black above 0, and nobody says or measured a level.

    It is looked for before frames are corrected, but for the white level that a calibration says: samples that are
    divided by gains are no codes any more.
    """
    measured = None if read.corrections is None else read.corrections.calibration
    if read.black_level or (measured is not None and measured.black_level is not None):
        return
    plain = None if measured is None else Corrections(Calibration(measured.layout, measured.white_level))
    for path in paths:
        frames = islice(read_mosaics([path], replace(read, corrections=plain)), LOOKS)
        level = next((level for frame in frames if (level := check_black_level(frame).level) is not None), None)
        if level is not None:
            advice = f"say --black-level {level:.4g}, or measure it first ('polsep calibrate dark')"
            raise input_error(
                path, f"expected black at 0, found it at {level:.4g} by the noise of dark parts: {advice}"
            )


def merge_files(
    paths: Sequence[Path], read: ReadOptions, output: Path, times: Sequence[float] | None, overwrite: bool
) -> tuple[str, tuple[str, ...]]:
    """Merge the frames of files into a float TIFF; a line about it, and notes. Times: as stated, else of the files.

    Raises ValueError.
    """
    if output.suffix.lower() not in (".tif", ".tiff"):
        raise ValueError(f"expected an output that ends in .tiff, found {output.name!r}")
    inputs = [file for path in paths for file in input_files(path)]
    refuse_repeated(inputs, "frames of different exposures")
    refuse_inputs([output], inputs)
    refuse_existing(output.parent, [output], overwrite)
    read = replace(read, pages=PAGES)
    require_black_level(paths, read)
    notes, recorded, forgotten = list[str](), list[float | None](), list[tuple[Path, Frame]]()

    def note(path: Path, frame: Frame) -> None:
        recorded.append(frame.exposure)
        forgotten.extend([(path, frame)] if forgets_level(frame) else [])
        found = [text for text in frame.notes if not isinstance(text, Overexposed)]
        notes.extend(f"{frame.stem}: {text}" for text in (*found, *_warnings(frame)))

    frames = list(read_mosaics(paths, read, note))
    if len(forgotten) == len(frames) > 0:  # a short exposure alone may be dark
        refuse_forgotten(*forgotten[0])
    known = [time for time in recorded if time is not None]
    said = "as stated" if times is not None else "of the files" if len(known) == len(frames) else "found in the frames"
    if times is None and 0 < len(known) < len(frames):
        notes.append(f"{len(known)} of {len(frames)} frames say their exposure time: all are {said}, or say --times")
    merged = merge_exposures(frames, known if times is None and len(known) == len(frames) else times)
    facts = {
        "exposure_times": [float(f"{time:.6g}") for time in merged.times],
        "noise_gain": merged.noise.gain,
        "noise_floor": merged.noise.floor,
        **(read.corrections.sources if read.corrections is not None else {}),
    }
    write_merged(output, merged.mosaic, facts)
    shortest, longest = min(merged.times), max(merged.times)
    clipped = float(to_numpy(merged.mosaic.clipped()).mean())
    count, times_said = len(merged.times), ", ".join(f"{time:.4g}" for time in merged.times)
    line = (
        f"{count} frame{'s' * (count != 1)}, exposure time{'s' * (count != 1)} {times_said} ({said}), range "
        f"{longest / shortest:.3g}, {clipped:.2%} of the samples clipped in the shortest -> {output}"
    )
    return line, (*notes, *merged.notes)


def corrections_for(kind: str, before: Calibration) -> Corrections:
    """The corrections of frames that measure a ``kind``: all that do not depend on it."""
    used = replace(before, lamp=None)
    if kind in ("dark", "flat"):
        used = replace(used, hot=None, dead=None)
    if kind == "dark":
        used = replace(used, black_level=None, black_pattern=None, black_map=None)
    if kind in ("dark", "flat"):
        used = replace(used, gains=None, gain_map=None, falloff=None)
    if kind != "light":
        used = replace(used, analysers=None)
    return Corrections(used)


def describe(found: Calibration, kind: str) -> str:
    """One line about a section, for people."""
    facts = found.details[kind]
    if kind == "dark":
        return (
            f"black level {found.black_level:.5g} +- {facts['black_level_error_codes']:.2g} of {found.white_level:g}, "
            f"pattern {facts['pattern_rms_codes']:.2g} codes rms over filters, {facts['lines_rms_codes']:.2g} over "
            f"lines, {facts['pixels_rms_codes']:.2g} over pixels, read noise {found.read_noise:.3g} codes, "
            f"{facts['hot_pixels']} hot pixels, {facts['frames']} frames"
        )
    if kind == "flat":
        gains = [gain for row in found.gains or () for gain in row]
        return (
            f"gains of filters {min(gains):.3f} to {max(gains):.3f} +- {facts['place_gains_error']:.2g}, of pixels "
            f"{facts['pixel_gains_rms']:.2%} rms, falloff to {facts['falloff_least']:.2f}, {facts['dead_pixels']} dead "
            f"pixels, apparent DoLP {facts['apparent_dolp']:.1%}, {facts['frames']} frames at "
            f"{facts['brightness']:.0%} of white{_uneven(facts['falloff_lopsided'])}{_encoded(facts['noise_exponent'])}"
        )
    if kind == "analysers":
        ratios = sorted(a.extinction for row in found.analysers or () for a in row)
        return (
            f"angles off by {facts['angle_off_rms_deg']:.2f} deg rms, {facts['angle_off_largest_deg']:.2f} at most "
            f"(+- {facts['angle_error_deg']:.2f}), extinction {ratios[0]:.0f} to {ratios[-1]:.0f} (diattenuation "
            f"{facts['diattenuation']:.4f} +- {facts['diattenuation_error']:.2g}), gains +- {facts['gain_error']:.2g}, "
            f"{facts['frames']} frames that differ by {facts['residual_rms']:.2%} from the model"
            f"{_poor(facts['diattenuation'])}"
        )
    assert kind == "light" and found.lamp is not None
    color = ", ".join(f"{c:.3f}" for c in found.lamp.color)
    line = f"colour {color} +- {facts['color_error_deg']:.2f} deg, from {facts['from']}"
    if "aolp_concentration" not in facts:
        return line
    concentration = f"(concentration {facts['aolp_concentration']:.2f})"
    if found.lamp.dolp is None:
        return f"{line}, polarizer not found: its light shows many angles {concentration}, a shiny ball shows one"
    polarizer = axis_deg(facts["polarizer_deg"], 1)
    return (
        f"{line}, polarizer at {polarizer:.1f} deg {concentration}, degree of polarization at least "
        f"{found.lamp.dolp:.3f}"
    )


def _uneven(lopsided: float) -> str:
    """Words on light that was uneven, which would be divided out of every image."""
    side = f"; one side is {lopsided:.0%} darker than the other: was it lit evenly? Else turn the camera between frames"
    return side if lopsided > LOPSIDED else ""


def _encoded(exponent: float | None) -> str:
    """Words on noise that does not grow with light: gains of encoded samples are wrong for linear ones."""
    seen = f"; noise follows light to the power of {exponent}, of linear samples 1: is gamma off in the camera?"
    return "" if exponent is None or exponent >= MAX_EXPONENT else seen


def _poor(diattenuation: float) -> str:
    """Words on analysers that are worse than those of sensors."""
    low = "; is the extinction the sensor's, or was the polarizer poor, light beside it, or the black level wrong?"
    return low if diattenuation < LEAST_DIATTENUATION else ""
