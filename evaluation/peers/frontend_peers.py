"""Colour polarization demosaickers of other packages, for `polsep bench frontend`; run by the peers' python.

    frontend_peers.py demosaic IN OUT     every IN/STEM.npy by every peer: OUT/METHOD/STEM.npy, and OUT/timing.json
    frontend_peers.py chains              the names of the chains that `polsep bench speed` times, as JSON

Raws are uint16 [H, W] mosaics, 90 45 / 135 0 under RGGB; IN is scaled to white = 65535. Results are float32 in units of
the white level, [4, 3, H, W] (or [4, 3, H/2, W/2] where a method has no more), angles 0 45 90 135, colours R G B.
Versions: evaluation/peers/requirements.txt; the names of the methods carry those that ran.

"Regrouped": the four analysers of a cell are taken as one point, as users do by hand. "Registered": every analyser is
interpolated from where its samples are, by OpenCV's bilinear filter. Regrouped, colour-demosaicing loses 3 dB; cubic
and Lanczos filters lose 0.1 to 0.4 dB.
"""

from __future__ import annotations

import json
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from importlib.metadata import version
from itertools import repeat
from pathlib import Path
from typing import Any

import numpy as np

warnings.simplefilter("ignore")

#: Row and column of the analysers 0, 45, 90, 135 in a cell.
PLACES = ((1, 1), (0, 1), (0, 0), (1, 0))
WHITE, WHITE_12_BIT = 65535.0, 4095.0

Array = np.ndarray[Any, Any]


def demosaic_polanalyser(raw: Array, code: str) -> Array:
    """polanalyser's demosaicing: four BGR images, 0 45 90 135."""
    import polanalyser as pa

    images = pa.demosaicing(raw, getattr(pa, code))
    return np.stack(images)[..., ::-1]


def demosaic_opencv(raw: Array) -> Array:
    """OpenCV's bilinear Bayer interpolation of every analyser plane, at half resolution."""
    import cv2

    planes = (np.ascontiguousarray(raw[row::2, col::2]) for row, col in PLACES)
    return np.stack([cv2.cvtColor(plane, cv2.COLOR_BayerRGGB2RGB) for plane in planes])


def demosaic_eari(raw: Array) -> Array:
    """eari-demosaic, which answers 90, 0, 45, 135."""
    import pyeari

    images = dict(zip((90, 0, 45, 135), pyeari.CEARI(raw, "RGGB"), strict=True))
    return np.stack([images[angle] for angle in (0, 45, 90, 135)])


def demosaic_colour(raw: Array, algorithm: str) -> Array:
    """colour-demosaicing on every analyser plane, at half resolution, in float64."""
    import colour_demosaicing

    function = getattr(colour_demosaicing, f"demosaicing_CFA_Bayer_{algorithm}")
    return np.stack([function(raw[row::2, col::2], "RGGB") for row, col in PLACES])


def register(planes: Array) -> Array:
    """Analyser planes [4, h, w, 3] interpolated to every pixel of the mosaic, [4, 2h, 2w, 3]."""
    import cv2

    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    size = (2 * planes.shape[2], 2 * planes.shape[1])
    full = []
    for plane, (row, col) in zip(planes.astype(np.float32), PLACES, strict=True):
        matrix = np.array([[0.5, 0.0, -col / 2], [0.0, 0.5, -row / 2]])
        full.append(cv2.warpAffine(plane, matrix, size, flags=flags, borderMode=cv2.BORDER_REFLECT_101))
    return np.stack(full)


def demosaickers() -> dict[str, Callable[[Array], Array]]:
    """Every peer by name: uint16 raw, white 65535, to images [4, h, w, 3] in units of the white level."""
    polanalyser, opencv = f"polanalyser {version('polanalyser')}", f"OpenCV {version('opencv-python-headless')}"
    colour = f"colour-demosaicing {version('colour-demosaicing')}"
    return {
        f"{polanalyser} bilinear": lambda raw: demosaic_polanalyser(raw, "COLOR_PolarRGB") / WHITE,
        f"{polanalyser} EA": lambda raw: demosaic_polanalyser(raw, "COLOR_PolarRGB_EA") / WHITE,
        f"{opencv} bilinear, regrouped": lambda raw: demosaic_opencv(raw) / WHITE,
        f"eari-demosaic {version('eari-demosaic')}": lambda raw: demosaic_eari((raw / WHITE).astype(np.float32)),
        f"{colour} Malvar2004, registered": lambda raw: register(demosaic_colour(raw / WHITE, "Malvar2004")),
        f"{colour} Menon2007, registered": lambda raw: register(demosaic_colour(raw / WHITE, "Menon2007")),
    }


def separate_polanalyser(raw: Array, half: bool) -> tuple[Array, Array]:
    """polanalyser's chain as its README has it; at half resolution, which it lacks, with means over cells before it."""
    import cv2
    import polanalyser as pa

    images = pa.demosaicing(raw, pa.COLOR_PolarRGB)
    if half:
        images = [cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA) for image in images]
    stokes = pa.calcStokes(images, np.deg2rad([0, 45, 90, 135]))
    return pa.cvtStokesToDiffuse(stokes), pa.cvtStokesToSpecular(stokes)


def separate_opencv(raw: Array, half: bool) -> tuple[Array, Array]:
    """The analytic split by hand in float32: at half resolution regrouped, at full resolution registered."""
    import cv2

    images = demosaic_opencv(raw) if half else register(demosaic_opencv(raw))
    m0, m45, m90, m135 = images.astype(np.float32, copy=False) * np.float32(1 / WHITE_12_BIT)
    specular = cv2.magnitude((m0 - m90).reshape(len(m0), -1), (m45 - m135).reshape(len(m0), -1)).reshape(m0.shape)
    return 0.5 * (m0 + m45 + m90 + m135) - specular, specular


def chains() -> dict[str, Callable[[Array, bool], Any]]:
    """Timed chains by name: 12-bit raw to diffuse and specular, at half resolution or full."""
    return {
        f"polanalyser {version('polanalyser')}": separate_polanalyser,
        f"OpenCV {version('opencv-python-headless')} + NumPy by hand": separate_opencv,
    }


def chain_names() -> list[str]:
    """Every chain as `polsep bench speed` names it, "RESOLUTION: NAME"."""
    return [f"{resolution}: {name}" for resolution in ("half", "full") for name in chains()]


def frames(chain: str, path: str) -> tuple[Iterator[Any], int]:
    """The frames of a chain, for ever, of the raw file at ``path``, one at once; for polsep's bench/stopwatch.py."""
    import cv2

    cv2.setNumThreads(2)
    resolution, _, name = chain.partition(": ")
    raw, separate = np.load(path), chains()[name]
    return (separate(raw, resolution == "half") for _ in repeat(None)), 1


def write_results(source: Path, target: Path) -> None:
    """Every raw of a folder by every peer, and the seconds of each."""
    seconds: dict[str, dict[str, float]] = {}
    for name, function in demosaickers().items():
        (target / name).mkdir()
        for path in sorted(source.glob("*.npy")):
            raw = np.load(path)
            start = time.perf_counter()
            images = function(raw)
            seconds.setdefault(name, {})[path.stem] = time.perf_counter() - start
            np.save(target / name / path.name, np.ascontiguousarray(images.transpose(0, 3, 1, 2), dtype=np.float32))
    (target / "timing.json").write_text(json.dumps(seconds))


def main(command: str, *arguments: str) -> None:
    """One of the two commands above."""
    if command == "demosaic":
        write_results(Path(arguments[0]), Path(arguments[1]))
    else:
        print(json.dumps(chain_names()))


if __name__ == "__main__":
    main(*sys.argv[1:])
