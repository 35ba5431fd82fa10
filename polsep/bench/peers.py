"""Other packages, run in a virtual environment of their own that `POLSEP_PEERS` names.

evaluation/peers/frontend_peers.py does the work there; evaluation/peers/requirements.txt says what to install.
"""

from __future__ import annotations

import json
import os
import subprocess
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
from torch import Tensor

from polsep.io.store.rows import read_array, write_array

#: The environment variable that holds the peers' python.
PEERS_VARIABLE = "POLSEP_PEERS"
SCRIPT = Path(__file__).parents[2] / "evaluation" / "peers" / "frontend_peers.py"
#: Everything that is timed has two threads, whatever library it uses.
TWO_THREADS = dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"), "2")


def find_peers() -> str:
    """The peers' python. Raises ValueError where none is named, and when it is not there."""
    python = os.environ.get(PEERS_VARIABLE)
    if not python:
        raise ValueError(
            f"expected the peers' python in {PEERS_VARIABLE} (see evaluation/peers; --quick: no peers), found none"
        )
    for path in (Path(python), SCRIPT):
        if not path.is_file():
            raise ValueError(f"expected the peers' python in {PEERS_VARIABLE} and {SCRIPT.name}, found no {path}")
    return python


def run_json(*command: str) -> Any:
    """Run a program with two threads and return its JSON. Raises ValueError with its last line when it fails."""
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=os.environ | TWO_THREADS)
    if done.returncode:
        raise ValueError(f"{Path(command[0]).name} failed: {(done.stderr.strip().splitlines() or ['no message'])[-1]}")
    return json.loads(done.stdout or "null")


def demosaic_by_peers(python: str, raws: dict[str, Tensor]) -> dict[str, dict[str, Tensor]]:
    """Images ``[4, 3, h, w]`` of raws ``[H, W]`` in [0, 1], first by method and then by the raw's name.

    Peers get uint16 with white at 65535; angles are sorted, colours RGB; h, w are H, W or half of them.
    """
    with TemporaryDirectory() as folder:
        source, target = Path(folder) / "raw", Path(folder) / "found"
        for name, raw in raws.items():
            write_array(source / f"{name}.npy", torch.round(65535 * raw).numpy().astype(np.uint16))
        write_array(target / "started.npy", np.zeros(1))
        run_json(python, str(SCRIPT), "demosaic", str(source), str(target))
        methods = sorted(path for path in target.iterdir() if path.is_dir())
        return {m.name: {n: torch.from_numpy(read_array(m / f"{n}.npy")) for n in raws} for m in methods}
