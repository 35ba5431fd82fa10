"""polsep on one page: python examples/minimal.py [FRAME.png] prints the share of specular light and saves an EXR."""

import sys
from pathlib import Path

import polsep

path = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(polsep.__file__).parent / "data" / "still_life.png"
frame = next(polsep.read_frames(path, polsep.ReadOptions(white_level=4095)))  # uint16 [2048, 2448], 12-bit values
out = polsep.separate(frame.data)

print(f"diffuse {out.diffuse.shape}, specular {out.specular.shape}, valid {out.valid.mean():.2%}")
print(f"specular share of the light: {out.specular.sum() / (out.diffuse + out.specular).sum():.3f}")
print("written:", *out.save(Path("polsep-out") / f"{path.stem}.exr", overwrite=True))
