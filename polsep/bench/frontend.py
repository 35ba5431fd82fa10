"""Demosaickers and the separation after them, beside the packages that users choose instead.

Real captures are the four-angle pictures of ``data``/four_angle, taken at full resolution behind a turning polarizer:
they are mosaicked by Sony's layout without noise. Rendered ones are 12-bit mosaics with noise and clipping; their truth
is limited to the white level, as demosaicking restores nothing that clipped. For demosaicking every sample counts at
face value, in all methods (`at_face_value`); the separation knows which ones clipped. All are compared at half
resolution, the mean over each 2x2 cell; real ones also at full resolution by the methods that have it.

Metrics, over all colours, without a border of 8 (half) or 16 (full) pixels and inside the object mask of renders:

* PSNR of the four analysers (mean of the four) and of the analytic split's diffuse and specular, against the analytic
  split of the truth: peak 1, both images limited to [0, 1].
* PSNR of s0, s1, s2: peak 1 too, not limited. s0 = m0 + m90, so it reaches 2.
* DoLP: rms error, both limited to 1. AoLP: rms of the circular error where the true DoLP exceeds 0.05.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from polsep.bench.peers import demosaic_by_peers, find_peers
from polsep.bench.rows import Row
from polsep.bench.truth import SCENE_SEEDS, captures, render_scene
from polsep.demosaic.bilinear import demosaic_bilinear, demosaic_bilinear_half, mean_cells
from polsep.demosaic.guided import demosaic_guided, demosaic_guided_half
from polsep.io.raw.frames import read_frames
from polsep.metrics import psnr, psnr_unlimited
from polsep.physics.stokes import Measurements, Stokes, aolp, dolp, fit_stokes, measure
from polsep.sensor.camera import Layout, Mosaic, sample_mosaic
from polsep.separation.analytic import separate_analytic
from polsep.separation.color_affine import separate_color_affine

Demosaicker = Callable[[Mosaic], Measurements]

#: polsep's demosaickers to half and, where there is one, to full resolution.
DEMOSAICKERS: dict[str, tuple[Demosaicker, Demosaicker | None]] = {
    "polsep bilinear": (demosaic_bilinear_half, demosaic_bilinear),
    "polsep guided": (demosaic_guided_half, demosaic_guided),
}
SPLITS = {"analytic": separate_analytic, "color-affine": separate_color_affine}

#: Pixels left out at the border, of half-resolution images.
BORDER = 8
#: Below this true DoLP an angle of polarization says nothing.
MIN_DOLP = 0.05
#: Rendered materials: the saturation of their colours, and their share of mixed ones, of which a quarter is grey.
MATERIALS = {"colour": (1.0, 0.375), "desaturated": (0.3, 0.375), "grey": (0.0, 0.25)}
#: Scenes whose demosaicking is scored; the separation takes all of `SCENE_SEEDS`.
SCORED_SEEDS = SCENE_SEEDS[:4]

UNITS = {
    "analysers PSNR": "dB",
    "s0 PSNR": "dB",
    "s1 PSNR": "dB",
    "s2 PSNR": "dB",
    "DoLP error": "rms",
    "AoLP error": "deg rms",
    "diffuse PSNR": "dB",
    "specular PSNR": "dB",
}


@dataclass(frozen=True)
class Case:
    """A raw frame in [0, 1] with the truth ``[4, 3, H, W]`` behind it and where ``[H/2, W/2]`` it is compared."""

    name: str
    mosaic: Mosaic
    truth: Tensor
    mask: Tensor


def bench_frontend(data: Path) -> Iterator[Row]:
    """Demosaickers, and the separation after them, beside those of others (POLSEP_PEERS: their python): accuracy.

    Needs the real pictures of ``data``/four_angle. Raises ValueError without them, and without the peers.
    """
    yield from _measure(data, find_peers())


def bench_frontend_quick(data: Path) -> Iterator[Row]:
    """`bench_frontend` without the peers."""
    yield from _measure(data, None)


def _measure(data: Path, peers: str | None) -> Iterator[Row]:
    cases = list(read_cases(data))
    theirs = ask_peers(cases, peers)
    yield from score_cases("real", "real captures", ((case, demosaic_case(case, theirs)) for case in cases))
    mixed: dict[tuple[str, str], float] = {}
    for case, (saturation, share) in MATERIALS.items():
        for row in _bench_rendered(case, saturation, peers):
            yield row
            if row.metric.endswith("gain"):
                key = (row.method, row.metric)
                mixed[key] = mixed.get(key, 0.0) + share * row.value
    for (method, metric), value in mixed.items():
        yield Row("frontend/split", "mixed renders, half", method, metric, value, "dB")


def read_cases(data: Path) -> Iterator[Case]:
    """The real four-angle captures of ``data``/four_angle, cropped to whole periods and mosaicked."""
    folders = sorted(path for path in (data / "four_angle").glob("*") if path.is_dir())
    if not folders:
        raise ValueError(f"expected folders of four-angle captures in {data / 'four_angle'}, found none")
    for folder in folders:
        found = next(read_frames(folder / "{angle}.png")).data
        if not isinstance(found, Measurements) or found.data.shape[-3] != 3:
            raise ValueError(f"expected RGB pictures 0, 45, 90 and 135 in {folder}, found others")
        height, width = (n // 4 * 4 for n in found.data.shape[-2:])
        truth = torch.from_numpy(found.data)[..., :height, :width]
        raw = sample_mosaic(Measurements(truth, found.angles), Layout())
        everywhere = torch.ones(height // 2, width // 2, dtype=torch.bool)
        yield at_face_value(Case(folder.name, Mosaic(raw, Layout(), 0.0, 1.0), truth, everywhere))


def at_face_value(case: Case) -> Case:
    """The case exposed 1 % darker, so that no sample counts as clipped."""
    black = case.mosaic.black_level
    mosaic = replace(case.mosaic, white_level=black + 1.01 * (case.mosaic.white_level - black))
    return replace(case, mosaic=mosaic, truth=case.truth / 1.01)


def inside(mask: Tensor, border: int) -> Tensor:
    """The mask ``[h, w]`` without its border."""
    kept = torch.zeros_like(mask)
    kept[border:-border, border:-border] = mask[border:-border, border:-border]
    return kept


def score_images(found: Tensor, truth: Tensor, mask: Tensor) -> dict[str, float]:
    """Every metric of `UNITS` of analyser images ``[4, C, h, w]`` inside ``mask [h, w]``, as the module says."""
    found, truth = (images[..., mask][..., None, :] for images in (found, truth))
    mask = torch.ones(found.shape[-2:], dtype=torch.bool)
    ours, true = (Measurements(images, Layout().angles) for images in (found, truth))
    stokes, true_stokes = fit_stokes(ours), fit_stokes(true)
    split, true_split = separate_analytic(ours), separate_analytic(true)
    pairs = {s: (getattr(stokes, s), getattr(true_stokes, s)) for s in ("s0", "s1", "s2")}
    degree, angle = score_stokes(stokes, true_stokes, mask)
    return {
        "analysers PSNR": statistics.fmean(psnr(found[k], truth[k], mask) for k in range(4)),
        **{f"{name} PSNR": psnr_unlimited(*pair, mask) for name, pair in pairs.items()},
        "DoLP error": degree,
        "AoLP error": angle,
        "diffuse PSNR": psnr(split.diffuse, true_split.diffuse, mask),
        "specular PSNR": psnr(split.specular, true_split.specular, mask),
    }


def score_stokes(found: Stokes, truth: Stokes, mask: Tensor) -> tuple[float, float]:
    """Rms errors of DoLP and, in degrees, of AoLP inside ``mask [h, w]``; AoLP 0 where nothing is polarized."""
    inside_mask = mask.expand_as(truth.s0)
    error = (dolp(found).clamp(max=1) - dolp(truth).clamp(max=1))[inside_mask]
    polarized = inside_mask & (dolp(truth) > MIN_DOLP)
    apart = aolp(found)[polarized] - aolp(truth)[polarized]
    apart = torch.rad2deg(torch.remainder(apart + math.pi / 2, math.pi) - math.pi / 2)
    angle = float(apart.double().square().mean().sqrt()) if apart.numel() else 0.0
    return float(error.double().square().mean().sqrt()), angle


Found = dict[tuple[str, str], Tensor]


def demosaic_case(case: Case, theirs: dict[str, dict[str, Tensor]]) -> Found:
    """Images ``[4, 3, h, w]`` by resolution ("half", "full") and method, of polsep's demosaickers and of the peers."""
    found = {}
    for name, (half, full) in DEMOSAICKERS.items():
        found["half", name] = half(case.mosaic).data
        if full is not None:
            found["full", name] = full(case.mosaic).data
    for name, images in theirs.items():
        image = images[case.name]
        if image.shape[-2:] == case.mask.shape:
            found["half", name] = image
        else:
            found["half", name], found["full", name] = mean_cells(image), image
    return found


def ask_peers(cases: list[Case], peers: str | None) -> dict[str, dict[str, Tensor]]:
    """The peers' images of the cases, by method and case; empty without peers."""
    return demosaic_by_peers(peers, {case.name: case.mosaic.linear() for case in cases}) if peers else {}


def score_cases(bench: str, title: str, cases: Iterable[tuple[Case, Found]]) -> Iterator[Row]:
    """All metrics of every case, their means over the cases, and the worst of them."""
    scores: dict[tuple[str, str, str], list[float]] = {}
    for case, found in cases:
        for (resolution, method), images in found.items():
            for metric, value in _score_at(images, case).items():
                scores.setdefault((resolution, method, metric), []).append(value)
                yield Row("frontend/scenes", f"{case.name}, {resolution}", method, metric, value, UNITS[metric])
    for (resolution, method, metric), values in sorted(scores.items(), key=lambda item: item[0][0]):
        name, unit = f"{title}, {resolution}", UNITS[metric]
        yield Row(f"frontend/{bench}", name, method, metric, statistics.fmean(values), unit)
        yield Row("frontend/worst", name, method, metric, min(values) if unit == "dB" else max(values), unit)


def _score_at(images: Tensor, case: Case) -> dict[str, float]:
    """`score_images` at the images' own resolution."""
    if images.shape[-2:] == case.mask.shape:
        return score_images(images, mean_cells(case.truth), inside(case.mask, BORDER))
    mask = case.mask.repeat_interleave(2, 0).repeat_interleave(2, 1)
    return score_images(images, case.truth, inside(mask, 2 * BORDER))


def _bench_rendered(title: str, saturation: float, peers: str | None) -> Iterator[Row]:
    """Rendered scenes of one saturation: demosaicking of the first four of colour and grey, separation of all."""
    cases, truths = [], []
    for seed in SCENE_SEEDS:
        scene = render_scene(seed, saturation)
        _, mosaic, mask, truth = list(captures(scene, seed))[-1]
        assert isinstance(mosaic, Mosaic)
        exact = measure(scene.diffuse + scene.specular, Layout().angles).data.clamp(0, 1)
        cases.append(Case(f"scene {seed} {title}", mosaic, exact, mask))
        truths.append(truth)
    if saturation in (0.0, 1.0):
        scored = [at_face_value(case) for case in cases[: len(SCORED_SEEDS)]]
        theirs = ask_peers(scored, peers)
        found = ({key: x for key, x in demosaic_case(c, theirs).items() if key[0] == "half"} for c in scored)
        yield from score_cases("rendered", f"{title} renders", zip(scored, found, strict=True))
    theirs = ask_peers(cases, peers)
    eari = next((images for name, images in theirs.items() if name.startswith("eari")), {})
    yield from _score_splits(title, cases, truths, eari)


def _score_splits(
    title: str, cases: list[Case], truths: list[tuple[Tensor, Tensor]], eari: dict[str, Tensor]
) -> Iterator[Row]:
    """PSNR of both splits after every demosaicker, and what each gains over the first of them."""
    scores: dict[tuple[str, str], list[float]] = {}
    for case, truth in zip(cases, truths, strict=True):
        samples = {name.removeprefix("polsep "): half(case.mosaic) for name, (half, _) in DEMOSAICKERS.items()}
        if eari:
            samples["EARI"] = with_samples(demosaic_bilinear_half(case.mosaic), mean_cells(eari[case.name]))
        for split, separate in SPLITS.items():
            for name, measurements in samples.items():
                found = separate(measurements)
                for output, exact in zip(("diffuse", "specular"), truth, strict=True):
                    score = psnr(getattr(found, output), exact, case.mask)
                    scores.setdefault((f"{split}, {name}", output), []).append(score)
    for (method, output), values in scores.items():
        gains = [value - first for value, first in zip(values, scores["analytic, bilinear", output], strict=True)]
        for metric, value in (
            (f"{output} PSNR", statistics.fmean(values)),
            (f"{output} PSNR gain", statistics.fmean(gains)),
            (f"{output} PSNR gain, worst scene", min(gains)),
        ):
            yield Row("frontend/split", f"{title} renders, half", method, metric, value, "dB")


def with_samples(plain: Measurements, data: Tensor) -> Measurements:
    """Another's images ``[4, C, h, w]`` in place of bilinear ones, with all that `demosaic_guided_half` gives along.

    Note: that one keeps bilinear samples where clipping touched a pixel. Here that would cost EARI 0.3 dB.
    """
    return replace(plain, data=data, uniform=plain)
