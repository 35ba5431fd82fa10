"""The sample frames that come with polsep, rendered by the project and free for every use (CC0)."""

from __future__ import annotations

import shutil
from importlib.resources import files
from pathlib import Path

from polsep.io.store.atomic import refuse_existing, write_set

#: The frame of the demo, 2448x2048 in colour, and its white level: 12 bits.
DEMO, DEMO_WHITE = Path(str(files("polsep") / "data" / "still_life.png")), 4095.0


def sample_folder() -> Path:
    """The folder of the sample frames in the package; README.md there says what each shows."""
    return Path(str(files("polsep") / "data" / "samples"))


def write_samples(directory: Path, overwrite: bool = False) -> list[Path]:
    """Copy the sample frames, their README and licence into a folder, all or none; return their paths.

    Raises OutputError where files exist and ``overwrite`` is False, or where writing fails.
    """
    sources = {path.name: path for path in sorted(sample_folder().iterdir()) if path.is_file()}
    targets = [directory / name for name in sources]
    refuse_existing(directory, targets, overwrite)

    def write(folder: Path) -> None:
        for name, source in sources.items():
            shutil.copyfile(source, folder / name)

    write_set(targets, directory.name, write)
    return targets
