"""Make the pictures of README.md: python examples/make_readme_pictures.py docs/images

Separates the embedded capture with every method and draws them in rows, all panels at one exposure in sRGB; renders 16
random views (extra render).
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
from polsep.io.results.previews import contact_sheet, exposure_of, srgb

WIDTH, TITLE, GAP = 470, 30, 6


def panel(image: np.ndarray, gain: float, title: str) -> Image.Image:
    """A titled sRGB picture of linear light, shrunk by area averaging before the tone curve."""
    height = round(WIDTH * image.shape[0] / image.shape[1])
    planes = [Image.fromarray(image[..., c]).resize((WIDTH, height), Image.Resampling.BOX) for c in range(3)]
    channels = [np.asarray(plane) for plane in planes]
    pixels = (srgb(np.stack(channels, -1) * gain) * 255).round().astype(np.uint8)
    canvas = Image.new("RGB", (WIDTH, height + TITLE), (22, 22, 24))
    canvas.paste(Image.fromarray(pixels), (0, TITLE))
    ImageDraw.Draw(canvas).text((4, 5), title, fill=(235, 235, 235), font=ImageFont.load_default(size=17))
    return canvas


def main(directory: str) -> None:
    """Write still_life.jpg (rows of methods), contact_sheet.jpg (what every frame gets) and rendered.jpg."""
    warnings.simplefilter("ignore")
    raw = imagecodecs.imread(Path(polsep.__file__).parent / "data" / "still_life.png")
    rows = []
    for method, name in (("analytic", "paper's analytic split"), ("joint", "polsep")):
        found = polsep.separate(raw, method=method, white_level=4095)
        if not rows:
            gain = exposure_of(found.diffuse + found.specular)
        diffuse = panel(found.diffuse, gain, f"diffuse: {name}")
        rows.append([diffuse, panel(2 * found.specular, gain, f"specular x2: {name}")])
    valid = np.repeat(found.valid[..., None], 3, -1).astype(np.float32)
    plain = [panel(found.diffuse + found.specular, gain, "input (s0)"), panel(valid, 1.0, "valid")]
    grid = list(zip(plain, rows[0], rows[1], strict=True))
    width, height = grid[0][0].size
    sheet = Image.new("RGB", (3 * width + 2 * GAP, 2 * height + GAP), (22, 22, 24))
    for i, row in enumerate(grid):
        for j, image in enumerate(row):
            sheet.paste(image, (j * (width + GAP), i * (height + GAP)))
    out = Path(directory)
    out.mkdir(parents=True, exist_ok=True)
    sheet.save(out / "still_life.jpg", quality=90)
    preview = Image.fromarray(contact_sheet(found)).resize((1420, 949), Image.Resampling.LANCZOS)
    preview.save(out / "contact_sheet.jpg", quality=85)
    with TemporaryDirectory() as folder:
        for _ in render_dataset(RenderOptions(8, 2, 512, 3, "validation"), Path(folder) / "set", default_workers()):
            pass
        Image.open(Path(folder) / "set" / "contact.png").save(out / "rendered.jpg", quality=88)


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else "docs/images")
