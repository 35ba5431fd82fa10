"""Layers in 8 bits: their ranges hold what the layers see, and rounding to them changes little."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from test_joint_engine import BLACK, COLOR, LIGHT, MONO, ROUNDED, WHITE, random_frame, random_net

from polsep.networks.joint_weights import JointWeights
from polsep.networks.openvino_engine import OpenVinoEngine, usual_precision
from polsep.networks.ranges import ROUNDED as LAYERS
from polsep.networks.ranges import measure_ranges
from polsep.sensor.camera import Layout, Mosaic
from polsep.separation.images import FrameImages
from polsep.shipped import shipped_joint


def frame(layout: Layout) -> Mosaic:
    mosaic = random_frame(64, 96, layout, most=3000)
    return replace(mosaic, data=mosaic.data.numpy())


def run(network: JointWeights, mosaic: Mosaic, precision: str, full: bool = False) -> FrameImages:
    engine = OpenVinoEngine(network, (64, 96), full, precision)
    return engine.run(mosaic.data, (BLACK, WHITE), LIGHT[: mosaic.layout.channels])


def rms(network: JointWeights, other: JointWeights, precisions: tuple[str, str], layout: Layout, full: bool) -> float:
    """Root mean square difference of the images of two networks."""
    one, two = (run(net, frame(layout), p, full) for net, p in zip((network, other), precisions, strict=True))
    return float(np.sqrt(np.mean([(one.diffuse - two.diffuse) ** 2, (one.specular - two.specular) ** 2])))


@pytest.mark.parametrize("layout", [COLOR, MONO], ids=["color", "mono"])
def test_ranges_hold_inputs_and_zero(layout: Layout) -> None:
    """Of every layer that is rounded, and of no other; symmetric by steps of bytes where values are negative."""
    ranges = measure_ranges(random_net(layout).weights(), [frame(layout)])
    names = {
        name for name in random_net(layout).weights().arrays if name.startswith(LAYERS) and name.endswith("weight")
    }
    assert set(ranges) == {name.removesuffix(".weight") for name in names}
    for name, (low, high) in ranges.items():
        assert low == 0 or low == pytest.approx(-high * 128 / 127)
        assert (low == 0) == name.endswith((".second", "doubt.0", "downs.0", "downs.1", "ups.0", "ups.1")), name


def test_several_frames_have_the_widest_range() -> None:
    dark, bright = (replace(frame(COLOR), light_color=(1.0, 1.0, gain)) for gain in (0.2, 3.0))
    both, *alone = (
        measure_ranges(random_net(COLOR).weights(), frames) for frames in ([dark, bright], [dark], [bright])
    )
    for name, (low, high) in both.items():
        assert high == pytest.approx(max(one[name][1] for one in alone))
        assert low == pytest.approx(min(one[name][0] for one in alone))


@pytest.mark.parametrize("layout", [COLOR, MONO], ids=["color", "mono"])
@pytest.mark.parametrize("full", [False, True])
@pytest.mark.parametrize("precision", ["i8", "i8-bf16"])
def test_rounding_to_bytes_changes_corrections_little(layout: Layout, full: bool, precision: str) -> None:
    plain = random_net(layout).weights()
    network = replace(plain, ranges=measure_ranges(plain, [frame(layout)]))
    assert 0 < rms(plain, network, ("f32", precision), layout, full) < ROUNDED


@pytest.mark.parametrize("harm", [lambda low, high: (low / 20, high / 20), lambda low, high: (50 * low, 50 * high)])
def test_wrong_ranges_show(harm: Callable[[float, float], tuple[float, float]]) -> None:
    """Ranges that cut values off, and those whose steps are coarse."""
    plain = random_net(COLOR).weights()
    ranges = {name: harm(*bounds) for name, bounds in measure_ranges(plain, [frame(COLOR)]).items()}
    good = replace(plain, ranges=measure_ranges(plain, [frame(COLOR)]))
    worse = rms(plain, replace(plain, ranges=ranges), ("f32", "i8"), COLOR, False)
    assert worse > 3 * rms(plain, good, ("f32", "i8"), COLOR, False)


@pytest.mark.parametrize("precision", ["f32", "i8"])
def test_inactive_blocks_are_left_out(precision: str) -> None:
    """A block whose first layer never exceeds zero adds the second layer's bias and nothing else."""
    arrays = dict(random_net(COLOR).weights().arrays)
    arrays["net.encoders.1.0.first.bias"] = np.full_like(arrays["net.encoders.1.0.first.bias"], -1e3)
    inactive = replace(random_net(COLOR).weights(), arrays=arrays)
    ranges = measure_ranges(inactive, [frame(COLOR)])
    assert [name for name, bounds in ranges.items() if bounds == (0, 0)] == ["net.encoders.1.0.second"]
    others = {name: bounds for name, bounds in ranges.items() if bounds != (0, 0)}
    given, left = replace(inactive, ranges=ranges), replace(inactive, ranges=others)
    assert rms(given, left, (precision,) * 2, COLOR, False) < 1e-6


def test_frames_are_needed() -> None:
    with pytest.raises(ValueError, match="expected at least one frame to measure ranges on, found none"):
        measure_ranges(random_net(COLOR).weights(), [])


@pytest.mark.parametrize("name", ["joint-large", "joint", "joint-fast"])
def test_shipped_networks_have_ranges(name: str) -> None:
    for layout in (COLOR, MONO):
        assert all(network.ranges for network in shipped_joint(name, layout))


@pytest.mark.parametrize(
    ("hint", "flags", "amd", "precision"),
    [
        ("bf16", {"amx_bf16", "avx512_vnni"}, False, "bf16"),
        ("bf16", {"avx512_bf16", "avx512_vnni"}, False, "i8"),
        ("bf16", {"avx512_bf16", "avx512_vnni"}, True, "i8-bf16"),
        ("f32", {"avx_vnni"}, True, "i8"),
        ("f32", {"avx2"}, True, "f32"),
        ("f16", set(), False, "f16"),
    ],
)
def test_precision_that_suits_the_processor(
    hint: str, flags: set[str], amd: bool, precision: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Core:
        def get_property(self, *_: str) -> Core:
            return self

        def get_type_name(self) -> str:
            return hint

    monkeypatch.setattr("polsep.networks.openvino_engine.core", Core)
    monkeypatch.setattr("polsep.networks.openvino_engine.cpu_flags", lambda: frozenset(flags))
    monkeypatch.setattr("polsep.networks.openvino_engine.is_amd", lambda: amd)
    assert usual_precision() == precision
