"""Make the pictures of README.md and docs: python examples/make_readme_pictures.py docs/images

still_life.jpg: the demo capture, separated by two methods, all panels at one exposure in sRGB. contact_sheet.jpg: the
preview of a frame. mistakes.jpg: the demo capture under four mistakes. rendered.jpg: 16 random views (extra render).
"""

import sys
import warnings
from pathlib import Path
from tempfile import TemporaryDirectory

import imagecodecs
import numpy as np
from PIL import Image, ImageDraw, ImageFont

import polsep
from polsep.datasets.rendered import RenderOptions, default_workers, render_dataset
from polsep.io.results.previews import contact_sheet, exposure_of
from polsep.physics.srgb import srgb

WIDTH, TITLE, GAP = 470, 30, 6


def panel(image: np.ndarray, gain: float, title: str, width: int = WIDTH) -> Image.Image:
    """Return a titled sRGB picture of linear light, shrunk by area averaging before the tone curve."""
    height = round(width * image.shape[0] / image.shape[1])
    planes = [Image.fromarray(image[..., c]).resize((width, height), Image.Resampling.BOX) for c in range(3)]
    channels = [np.asarray(plane) for plane in planes]
    pixels = (srgb(np.stack(channels, -1) * gain) * 255).round().astype(np.uint8)
    canvas = Image.new("RGB", (width, height + TITLE), (22, 22, 24))
    canvas.paste(Image.fromarray(pixels), (0, TITLE))
    ImageDraw.Draw(canvas).text((4, 5), title, fill=(235, 235, 235), font=ImageFont.load_default(size=17))
    return canvas


def tile(grid: list[list[Image.Image]]) -> Image.Image:
    """Return rows of panels of one size as one picture."""
    width, height = grid[0][0].size
    sheet = Image.new("RGB", (len(grid[0]) * (width + GAP) - GAP, len(grid) * (height + GAP) - GAP), (22, 22, 24))
    for i, row in enumerate(grid):
        for j, image in enumerate(row):
            sheet.paste(image, (j * (width + GAP), i * (height + GAP)))
    return sheet


def mistakes(raw: np.ndarray) -> Image.Image:
    """Return diffuse (above) and specular images of a correct capture and of captures with one mistake each.

    The lamp is stated to be white. Its colour is divided out of the panels, so that only the mistake differs.
    """
    layout, white = polsep.Layout(), 4095.0
    colors = np.array([[layout.filter_at(row, col).channel for col in range(4)] for row in range(4)])
    lamp = np.array([0.55, 1.0, 0.7], np.float32)  # a white lamp's raw RGB
    tinted = raw * lamp[np.tile(colors, (raw.shape[0] // 4, raw.shape[1] // 4))]
    tinted = np.where(raw >= 4090, white, tinted)  # what clips goes on clipping
    captures = {
        "correct": (raw, 1.0),
        "lamp's colour wrong": (tinted, 1 / lamp),
        "room light": (np.minimum(raw + 0.05 * white, white), 1.0),
        "overexposed 4 times": (np.minimum(raw * 4.0, white), 0.25),
        "gamma on": (white * (raw / white) ** (1 / 2.2), 0.25),
    }
    rows: list[list[Image.Image]] = [[], []]
    for name, (frame, scale) in captures.items():
        found = polsep.separate(frame.astype(np.float32), white_level=white, light_color="white")
        rows[0].append(panel((found.diffuse * scale).astype(np.float32), 2, name, 380))
        rows[1].append(panel((found.specular * scale).astype(np.float32), 4, "", 380))
    return tile(rows)


def main(directory: str) -> None:
    """Write the pictures into the directory."""
    warnings.simplefilter("ignore")
    raw = imagecodecs.imread(Path(polsep.__file__).parent / "data" / "still_life.png")
    rows = []
    for method, name in (("analytic", "paper's analytic split"), ("auto", "polsep")):
        found = polsep.separate(raw, method=method, white_level=4095)
        if not rows:
            gain = exposure_of(found.diffuse + found.specular)
        diffuse = panel(found.diffuse, gain, f"diffuse: {name}")
        rows.append([diffuse, panel(2 * found.specular, gain, f"specular x2: {name}")])
    valid = np.repeat(found.valid[..., None], 3, -1).astype(np.float32)
    plain = [panel(found.diffuse + found.specular, gain, "input (s0)"), panel(valid, 1.0, "valid")]
    sheet = tile([list(row) for row in zip(plain, rows[0], rows[1], strict=True)])
    out = Path(directory)
    out.mkdir(parents=True, exist_ok=True)
    sheet.save(out / "still_life.jpg", quality=90)
    found.report["source"] = "still_life.png"
    preview = Image.fromarray(contact_sheet(found))
    preview = preview.resize((1420, round(1420 * preview.height / preview.width)), Image.Resampling.LANCZOS)
    preview.save(out / "contact_sheet.jpg", quality=85)
    mistakes(raw).save(out / "mistakes.jpg", quality=88)
    with TemporaryDirectory() as folder:
        for _ in render_dataset(RenderOptions(8, 2, 512, 3, "validation"), Path(folder) / "set", default_workers()):
            pass
        Image.open(Path(folder) / "set" / "contact.png").save(out / "rendered.jpg", quality=88)


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else "docs/images")
