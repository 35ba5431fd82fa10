"""`polsep capture` against the fake GigE camera, in a program of its own that has the network for itself.

    python fake_run.py steady-and-slow FOLDER SECONDS FILE...
    python fake_run.py unplugged FOLDER FILE...

steady-and-slow: two runs at 2448x2048 BayerRG12p and 10 frames per second, into FOLDER: "steady", for SECONDS, with a
live view; and "slow", 6 frames, whose disk takes 0.6 s for one. Prints one line of JSON: how often live.jpg was seen to
change, and whether it was ever seen in part. unplugged: one run into FOLDER/unplugged, 5 frames per second, 30 frames,
whose camera is killed after some and started again 3 s later.
"""

from __future__ import annotations

import json
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from polsep.cli import main
from polsep.io.raw.recording import RawImage, RecordingWriter

CAMERA = Path(__file__).with_name("fake_camera.py")


@contextmanager
def plugged_in(files: list[str]) -> Iterator[None]:
    """A camera that sends these frames."""
    command = [sys.executable, str(CAMERA), "2448x2048", "BayerRG12p", "0x010C0059", *files]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as camera:
        assert camera.stdout is not None and camera.stdout.readline() == "ready\n"
        try:
            yield
        finally:
            camera.kill()


def capture(*words: str) -> None:
    """`polsep capture WORDS`."""
    sys.argv = ["polsep", "capture", "aravis:127.0.0.1", *words]
    main()


class Watcher(threading.Thread):
    """Reads a JPEG file as fast as it can, as a viewer beside the program would."""

    def __init__(self, path: Path) -> None:
        super().__init__(daemon=True)
        self._path, self._ended = path, threading.Event()
        self.partial, self.changes = 0, 0

    def run(self) -> None:
        last = 0
        while not self._ended.wait(0.02):
            made = self._path.stat().st_mtime_ns if self._path.exists() else 0
            if made != last:
                last, self.changes = made, self.changes + 1
                self.partial += not self._path.read_bytes().endswith(b"\xff\xd9")

    def end(self) -> None:
        """No more."""
        self._ended.set()
        self.join()


def slow_disk() -> None:
    """From now on a frame takes 0.6 s to write."""
    append = RecordingWriter.append

    def slowly(self: RecordingWriter, image: RawImage) -> None:
        time.sleep(0.6)
        append(self, image)

    RecordingWriter.append = slowly


def steady_and_slow(folder: str, seconds: str, *files: str) -> None:
    """Both runs against one camera."""
    steady, slow = Path(folder) / "steady", Path(folder) / "slow"
    with plugged_in(list(files)):
        watcher = Watcher(steady / "live.jpg")
        watcher.start()
        capture("--rate", "10", "-o", str(steady), "--seconds", seconds, "--method", "analytic")
        watcher.end()
        slow_disk()
        capture("--rate", "10", "-o", str(slow), "--frames", "6", "--method", "none", "--ring", "1")
    print(json.dumps({"changes": watcher.changes, "partial": watcher.partial}))


def unplugged(folder: str, *files: str) -> None:
    """One run against two cameras, one after the other."""
    taken = Path(folder) / "unplugged"
    done = threading.Event()

    def unplug() -> None:
        with plugged_in(list(files)):
            there.set()
            while not (taken / "frames.raw").exists():
                time.sleep(0.05)
            time.sleep(2)
        time.sleep(3)
        with plugged_in(list(files)):
            done.wait()

    there = threading.Event()
    thread = threading.Thread(target=unplug)
    thread.start()
    there.wait()
    try:
        capture("--rate", "5", "-o", str(taken), "--frames", "30", "--method", "none")
    finally:
        done.set()
        thread.join()


if __name__ == "__main__":
    {"steady-and-slow": steady_and_slow, "unplugged": unplugged}[sys.argv[1]](*sys.argv[2:])
