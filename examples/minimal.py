"""polsep on one page: python examples/minimal.py [FRAME.png] prints the share of specular light and saves an EXR."""

import sys
from pathlib import Path

import imagecodecs

import polsep
from polsep.io.results.separation_writer import write_separation

path = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(polsep.__file__).parent / "data" / "still_life.png"
raw = imagecodecs.imread(path)  # uint16 [2048, 2448], 12-bit values
out = polsep.separate(raw, white_level=4095)

print(f"diffuse {out.diffuse.shape}, specular {out.specular.shape}, valid {out.valid.mean():.2%}")
print(f"specular share of the light: {out.specular.sum() / (out.diffuse + out.specular).sum():.3f}")
print("written:", *write_separation(out, Path("polsep-out"), path.stem, overwrite=True))
