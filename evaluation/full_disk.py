"""Programs on a disk that is too small: of every size from 0 to what they need, then with enough.

Each disk is a file system in memory (tmpfs), mounted where no other program sees it: in a namespace of this process
alone, which `fill_elsewhere` starts as ``python -m evaluation.full_disk ARGUMENTS``.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from evaluation.faults import (
    FILM,
    POLSEP,
    WORKS,
    Ended,
    Work,
    count_partial,
    make_inputs,
    read_contents,
    run_program,
    run_undisturbed,
)

#: Steps of the size of a disk, and more than any work needs [KiB].
STEP, ENOUGH = 4, 2**13
#: What is counted.
DISK_METRICS: tuple[str, ...] = ("disk sizes", "refused", "completed", "crashes", "not one line", "partial files")
DISK_METRICS += ("failed resumptions", "other bytes")

_SHOT = (*POLSEP, "separate", "../shot0.npy", "-o", "out", "--white-level", "4095", "--method", "analytic")
_SHORT = (*FILM, "--method", "analytic", "--frames", "8", "--format")
DISK_WORKS = {
    "video with preview": Work((*FILM, "--method", "analytic")),
    "video, lossless": Work((*_SHORT, "ffv1")),
    "video, preview alone": Work((*_SHORT, "none")),
    **{f"separate, {kind}": Work((*_SHOT, "--format", kind)) for kind in ("exr", "npz", "tiff", "png")},
    "calibrate": WORKS["calibrate"],
}


def fill_elsewhere(name: str, folder: Path, every: int = 1, sizes: Sequence[int] = ()) -> Counter[str]:
    """`fill_disks` in a process with disks of its own. Raises RuntimeError where none can be mounted."""
    folder.mkdir(parents=True)
    own = ("unshare", "--mount", "--propagation", "private", *(() if os.geteuid() == 0 else ("--map-root-user",)))
    command = (*own, sys.executable, "-m", "evaluation.full_disk", json.dumps([name, str(folder), every, list(sizes)]))
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    *faulty, last = done.stdout.splitlines() or [""]
    for line in faulty:
        print(line, flush=True)
    if done.returncode != 0:
        raise RuntimeError(f"expected a disk of {name}, found none: {done.stderr.strip()[-200:]}")
    return Counter(json.loads(last))


def fill_disks(work: Work, folder: Path, every: int = 1, sizes: Sequence[int] = ()) -> Counter[str]:
    """Run a work on disks, and count `DISK_METRICS`; prints what is faulty.

    ``sizes`` in `STEP`; none: every ``every``-th up to the first that is enough.
    """
    disk = folder / "disk"
    disk.mkdir()
    make_inputs(folder)
    with mounted(disk, ENOUGH):
        usual = run_undisturbed(work, disk / "out")
    counts: Counter[str] = Counter()
    for size in sizes or choose_sizes(work, disk, every):
        with mounted(disk, STEP * size):
            ended = run_on(work, disk)
            found, hidden = read_contents(disk / "out", work.kept), list((disk / "out").glob(".*.part"))
            seen = Counter({"disk sizes": 1, "refused": ended.status == 2, "completed": ended.status == 0})
            seen["crashes"] = ended.status not in (0, 2)
            lines = [line for line in ended.lines if line not in usual.warnings]
            seen["not one line"] = ended.status == 2 and (len(lines) != 1 or not lines[0].startswith("polsep: error: "))
            seen["partial files"] = count_partial(found, usual) + len(hidden)
            if ended.status != 0:
                subprocess.run(["mount", "-o", f"remount,size={ENOUGH}k", disk], check=True)
                seen["failed resumptions"] = run_on(work, disk).status != 0
            seen["other bytes"] = read_contents(disk / "out", work.kept) != usual.after
        counts += seen
        if any(seen[metric] for metric in DISK_METRICS[3:]):
            print(f"{STEP * size} KiB: {ended}, {dict(seen)}, {sorted(found)[:4]}", flush=True)
    return counts


def choose_sizes(work: Work, disk: Path, every: int) -> list[int]:
    """Every ``every``-th size of a disk, the last one that is too small, and the first that is enough [`STEP`]."""
    low, high = 0, ENOUGH // STEP
    while high - low > 1:
        size = (low + high) // 2
        with mounted(disk, STEP * size):
            enough = run_on(work, disk).status == 0
        low, high = (low, size) if enough else (size, high)
    return sorted({*range(0, high + 1, every), low, high})


def run_on(work: Work, disk: Path) -> Ended:
    """Run a work on a disk; where not even its files from before fit, that is how it ended."""
    if work.before is not None:
        try:
            work.before(disk / "out")
        except RuntimeError as error:
            found: Ended = error.args[0]
            return found
    return run_program(work.command, disk / "out")


@contextmanager
def mounted(disk: Path, size: int) -> Iterator[None]:
    """A disk with ``size`` KiB free."""
    subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size + STEP}k", "tmpfs", disk], check=True)
    try:
        (disk / "filler").write_bytes(bytes(1024 * STEP))  # because a size of 0 means as much as there is memory
        yield
    finally:
        subprocess.run(["umount", "--lazy", disk], check=True)


if __name__ == "__main__":
    name, folder, every, sizes = json.loads(sys.argv[1])
    print(json.dumps(fill_disks(DISK_WORKS[name], Path(folder), every, sizes)))
