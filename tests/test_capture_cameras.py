"""Real camera libraries without a camera: Aravis's fake GigE camera over loopback, and pylon's emulator.

Both send our own mosaics, and what arrives is held against them bit for bit. POLSEP_SECONDS=60 lengthens the run on the
fake camera, which is 2 s otherwise.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import sysconfig
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import imagecodecs
import numpy as np
import pytest
from test_capture import INFO, index_of, record_of, run
from test_cli import png

import polsep
from polsep.capture import aravis, pylon
from polsep.capture.pylon import PylonSource, list_pylon
from polsep.capture.session import CapturePlan
from polsep.capture.sources import CameraError, CameraSettings
from polsep.io.raw.frames import read_frames
from polsep.io.raw.genicam import pack_frame, unpack_frame
from polsep.io.raw.recording import RECORD, read_images
from polsep.io.results.previews import live_sheet
from polsep.io.store.image_codecs import encode_jpeg
from polsep.pipeline import separate_capture

TESTS = Path(__file__).parent
STILL_LIFE = Path(polsep.__file__).parent / "data" / "still_life.png"
#: Where Debian keeps PyGObject, which an environment of the same Python can use too.
DEBIAN = Path("/usr/lib/python3/dist-packages/gi")


@pytest.fixture
def alone(tmp_path: Path) -> list[str]:
    """The beginning of a command that runs Python with Aravis in a network of its own, with loopback alone."""
    paths = [str(TESTS), str(TESTS.parent)]
    if (DEBIAN / f"_gi{sysconfig.get_config_var('EXT_SUFFIX')}").exists():
        (tmp_path / "paths").mkdir()
        (tmp_path / "paths" / "gi").symlink_to(DEBIAN)
        paths.append(str(tmp_path / "paths"))
    environment = f"PYTHONPATH={os.pathsep.join([*paths, os.environ.get('PYTHONPATH', '')])}"
    setup = 'ip link set lo up && exec "$@"'
    unshare = ["unshare", "-n"] if os.geteuid() == 0 else ["unshare", "-r", "-n"]
    command = [*unshare, "sh", "-c", setup, "sh", "env", environment, sys.executable]
    if not all(shutil.which(name) for name in ("unshare", "ip")):
        pytest.skip("no unshare or ip: the fake camera needs a network of its own")
    if subprocess.run([*command, "-c", ""], capture_output=True, check=False).returncode:
        pytest.skip("no right to make a network of its own (unshare -n)")
    aravis = "import gi; gi.require_version('Aravis', '0.8'); from gi.repository import Aravis"
    if subprocess.run([*command, "-c", aravis], capture_output=True, check=False).returncode:
        pytest.skip("no Aravis: apt install gir1.2-aravis-0.8 python3-gi")
    return command


def lost_between(ids: list[int]) -> int:
    """Ids that are missing from a list of 16 bits that skips 0."""
    return sum((b - a) % 65535 - 1 for a, b in pairwise(ids))


def our_frames(folder: Path) -> tuple[list[bytes], list[Path]]:
    """Two mosaics of ours as a camera sends them, and files that hold them."""
    still_life = imagecodecs.png_decode(STILL_LIFE.read_bytes())
    payloads = [pack_frame(np.roll(still_life, (4 * k, 8 * k), (0, 1)), "BayerRG12p") for k in range(2)]
    files = [folder / f"{k}.bytes" for k in range(2)]
    for file, payload in zip(files, payloads, strict=True):
        file.write_bytes(payload)
    return payloads, files


def test_a_gige_camera_from_end_to_end(tmp_path: Path, alone: list[str]) -> None:
    payloads, files = our_frames(tmp_path)
    seconds = os.environ.get("POLSEP_SECONDS", "2")
    command = [*alone, TESTS / "fake_run.py", "steady-and-slow", tmp_path, seconds, *files]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120 + float(seconds), check=False)
    assert done.returncode == 0, done.stderr
    steady, slow = (record_of(tmp_path / name) for name in ("steady", "slow"))
    for name, record in (("steady", steady), ("slow", slow)):
        count, index = record["counters"], index_of(tmp_path / name)
        ids = [line["frame_id"] for line in index]
        assert record["finished"] and record["pixel_format"] == "BayerRG12p" and count["interruptions"] == 0
        assert count["received"] == count["recorded"] + count["dropped"] and count["recorded"] == len(ids)
        # every id between the first and the last is a frame on disk, dropped or lost: none is missing in silence
        in_between = count["dropped"] + sum(line["lost_before"] for line in index)
        assert lost_between(ids) <= in_between and count["lost"] >= sum(line["lost_before"] for line in index)
        images = read_images(tmp_path / name / RECORD)
        assert all(image.payload == payloads[image.frame_id % 2] for image in images)
    assert steady["counters"]["received"] >= float(seconds) and steady["counters"]["dropped"] == 0
    assert lost_between([line["frame_id"] for line in index_of(tmp_path / "steady")]) <= steady["counters"]["lost"]
    assert slow["counters"]["dropped"] > 0
    watched = json.loads(done.stdout.splitlines()[-1])
    assert watched["changes"] >= max(1, int(float(seconds) / 5)) and watched["partial"] == 0
    pictures = []
    for _, frame in zip(range(2), read_frames(tmp_path / "steady" / RECORD), strict=False):
        pictures.append(encode_jpeg(live_sheet(separate_capture(frame.data, "analytic"))))
    assert (tmp_path / "steady" / "live.jpg").read_bytes() in pictures
    print(json.dumps({"steady": steady["counters"], "slow": slow["counters"], **watched}))
    for name in ("steady", "slow"):
        (tmp_path / name / "frames.raw").unlink()  # 7.5 MB a frame


@pytest.mark.skipif("POLSEP_SECONDS" not in os.environ, reason="half a minute: set POLSEP_SECONDS to run it")
def test_a_gige_camera_that_is_unplugged(tmp_path: Path, alone: list[str]) -> None:
    payloads, files = our_frames(tmp_path)
    command = [*alone, TESTS / "fake_run.py", "unplugged", tmp_path, *files]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    record, index = record_of(tmp_path / "unplugged"), index_of(tmp_path / "unplugged")
    count = record["counters"]
    assert (count["received"], count["recorded"], count["interruptions"]) == (30, 30, 1)
    again = [line["index"] for line in index if line["away_s"] > 0]
    assert len(again) == 1 and 0 < again[0] < 30 and index[again[0]]["away_s"] == count["away_s"] > 3
    assert record["interruptions"] == [{"received_before": again[0], "seconds": count["away_s"]}]
    images = read_images(tmp_path / "unplugged" / RECORD)
    assert all(image.payload == payloads[image.frame_id % 2] for image in images)
    assert done.stderr.count("camera lost: ") == done.stderr.count("camera back after ") == 1
    print(done.stderr, json.dumps(count))
    (tmp_path / "unplugged" / "frames.raw").unlink()


@pytest.mark.parametrize("library", [aravis, pylon])
def test_a_read_ends_when_a_trigger_is_due(monkeypatch: pytest.MonkeyPatch, library: Any) -> None:
    """Of both libraries: the read triggers, and waits no longer than until the next trigger."""
    monkeypatch.setattr(library, "_apply", lambda *given: None)
    monkeypatch.setattr(library, "_describe", lambda *given: INFO)
    settings, device = CameraSettings(frame_rate_hz=50, trigger="Software"), MagicMock()
    camera: Any
    if library is aravis:
        read, unit = device.create_stream().timeout_pop_buffer, 1e-6
        read.return_value = None
        camera = aravis._AravisCamera(MagicMock(), OSError, device, settings)
    else:
        read, unit = device.RetrieveResult, 1e-3
        read().__enter__().IsValid.return_value = device.IsCameraDeviceRemoved.return_value = False
        read.reset_mock()
        camera = pylon._PylonCamera(MagicMock(), SimpleNamespace(GenericException=OSError), device, settings)
    camera.start()
    assert camera.read(0.2) is None
    assert device.software_trigger.call_count + device.ExecuteSoftwareTrigger.call_count == 1
    assert read.call_count == 1 and 0 <= read.call_args.args[0] * unit <= 1 / 50


@pytest.fixture
def emulator(monkeypatch: pytest.MonkeyPatch) -> None:
    """One emulated camera of pylon's."""
    monkeypatch.setenv("PYLON_CAMEMU", "1")
    pytest.importorskip("pypylon", reason="no pypylon: pip install 'polsep[camera]'")


def replay(folder: Path, pixel_format: str, **more: str) -> PylonSource:
    """The emulator, sending the picture files of a folder of 64x48 pixels."""
    features = {
        "Width": "64",
        "Height": "48",
        "TestImageSelector": "Off",
        "ImageFilename": str(folder),
        "ImageFileMode": "On",
        **more,
    }
    settings = CameraSettings(5000, 3, 20, None, pixel_format, tuple(features.items()))
    return PylonSource(list_pylon()[0][0], settings)


@pytest.mark.usefixtures("emulator")
@pytest.mark.parametrize(("pixel_format", "bits"), [("BayerRG8", 8), ("BayerRG12", 12), ("Mono16", 16)])
def test_the_emulator_replays_our_frames(tmp_path: Path, pixel_format: str, bits: int) -> None:
    random = np.random.default_rng(bits)
    expected = [random.integers(0, 2**bits, (48, 64)).astype(np.uint8 if bits == 8 else np.uint16) for _ in range(3)]
    (tmp_path / "files").mkdir()
    for k, codes in enumerate(expected):
        png(tmp_path / "files" / f"{k}.png", codes << 4 if bits == 12 else codes)
    source = replay(tmp_path / "files", pixel_format)
    status, _ = run(source, CapturePlan(tmp_path / "take", None), frames=7)
    assert (status.counters.received, status.counters.lost, status.counters.recorded) == (7, 0, 7)
    for k, image in enumerate(read_images(tmp_path / "take" / RECORD)):
        np.testing.assert_array_equal(unpack_frame(image.payload, 64, 48, pixel_format), expected[k % 3])
    settings = record_of(tmp_path / "take")["settings"]
    assert settings["exposure_us"] == 5000 and settings["gain_db"] == pytest.approx(3, abs=1e-3)


@pytest.mark.usefixtures("emulator")
@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"pixel_format": "BayerRG12p"}, "expected a camera that takes PixelFormat BayerRG12p"),
        ({"exposure_us": 2e7}, "expected a camera that takes ExposureTime 20000000, found"),
        ({"trigger": "Line99"}, "expected a camera that takes TriggerSource Line99"),
        ({"features": (("Wdith", "4"),)}, "expected a camera with the feature Wdith, found none"),
    ],
)
def test_the_emulator_refuses_in_one_line(tmp_path: Path, settings: dict[str, Any], words: str) -> None:
    source = PylonSource(list_pylon()[0][0], CameraSettings(**settings))
    with pytest.raises(CameraError, match=words) as caught:
        run(source, CapturePlan(tmp_path / "take", None))
    assert "\n" not in str(caught.value) and not (tmp_path / "take").exists()
    with pytest.raises(CameraError, match="expected a camera of this serial number, found none"):
        run(PylonSource("none", CameraSettings()), CapturePlan(tmp_path / "take", None))


@pytest.mark.usefixtures("emulator")
def test_frames_that_fail_are_counted(tmp_path: Path) -> None:
    png(tmp_path / "0.png", np.full((48, 64), 9, np.uint8))
    source = replay(tmp_path, "BayerRG8", ForceFailedBufferCount="3", ForceFailedBuffer="1")
    status, said = run(source, CapturePlan(tmp_path / "take", None), frames=5)
    assert status.counters.received == 5 and status.counters.lost >= 3  # the emulator skips ids when it is late
    lost_before = sum(line["lost_before"] for line in index_of(tmp_path / "take"))
    assert status.counters.lost == lost_before
    assert any("lost in transfer: a frame came incomplete" in line for line in said)
