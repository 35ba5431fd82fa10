"""Laws of headerless pixel formats: known bytes, round trips of every format, and refusals."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from polsep.io.raw.genicam import PIXEL_FORMATS, find_pixel_format, pack_frame, unpack_frame
from polsep.io.store.errors import InputError

LUCID = "PolarizedAngles_0d_45d_90d_135d_"


@pytest.mark.parametrize(
    ("name", "data", "codes"),
    [
        # p0 = 0xABC, p1 = 0x123: b0 = 0xBC, b1 = 0x3 << 4 | 0xA, b2 = 0x12
        ("BayerRGPolarized12p", [0xBC, 0x3A, 0x12], [[0xABC, 0x123]]),
        # the same codes: the high bytes 0xAB and 0x12 outside, the low nibbles 0x3 and 0xC between
        ("BayerRG12Packed", [0xAB, 0x3C, 0x12], [[0xABC, 0x123]]),
        # high bytes 0x81 and 0x7E, low pairs 0b11 and 0b10
        ("Mono10Packed", [0x81, 0x23, 0x7E], [[0b10_0000_0111, 0b01_1111_1010]]),
        # one little-endian number: the sum of p_k << 10 k, in five bytes
        ("BayerGB10p", [0x01, 0x08, 0x38, 0xD0, 0xFF], [[0x001, 0x202], [0x103, 0x3FF]]),
        ("Mono10", [0x34, 0x02], [[0x234]]),  # words are little-endian
    ],
)
def test_bytes_by_hand(name: str, data: list[int], codes: list[list[int]]) -> None:
    height, width = len(codes), len(codes[0])
    np.testing.assert_array_equal(unpack_frame(bytes(data), width, height, name), codes)
    assert pack_frame(np.array(codes), name) == bytes(data)


def test_lucid_angles_lie_side_by_side_in_each_pixel() -> None:
    planes = unpack_frame(bytes([0, 45, 90, 135, 1, 46, 91, 136]), 2, 1, LUCID + "BayerRG8")
    np.testing.assert_array_equal(planes, [[[0, 1]], [[45, 46]], [[90, 91]], [[135, 136]]])


@settings(max_examples=12, deadline=None)
@given(width=st.integers(1, 9), height=st.integers(1, 6), seed=st.integers(0, 2**16))
@pytest.mark.parametrize("name", PIXEL_FORMATS)
def test_round_trip(name: str, width: int, height: int, seed: int) -> None:
    fmt = PIXEL_FORMATS[name]
    shape = (height, width) if fmt.planes == 1 else (4, height, width)
    codes = np.random.default_rng(seed).integers(0, 2**fmt.bits, shape)
    buffer = pack_frame(codes, name)
    assert len(buffer) == fmt.frame_bytes(width, height)
    back = unpack_frame(buffer, width, height, name)
    assert back.dtype == (np.uint8 if fmt.bits == 8 else np.uint16)
    assert back.flags.writeable and back.flags.c_contiguous
    np.testing.assert_array_equal(back, codes)
    assert pack_frame(back, name) == buffer


@pytest.mark.parametrize("name", ["Mono10p", "Mono12p", "Mono12Packed", "Mono10Packed"])
def test_frames_longer_than_one_block_agree_with_a_bit_stream(name: str) -> None:
    fmt = PIXEL_FORMATS[name]
    codes = np.random.default_rng(1).integers(0, 2**fmt.bits, (260, 510))
    buffer = pack_frame(codes, name)
    np.testing.assert_array_equal(unpack_frame(buffer, 510, 260, name), codes)
    if fmt.packing == "lsb":
        bits = np.unpackbits(np.frombuffer(buffer, np.uint8), bitorder="little").reshape(-1, fmt.bits)
        np.testing.assert_array_equal(bits @ (1 << np.arange(fmt.bits)), codes.reshape(-1))


def test_odd_pixel_counts_take_whole_bytes() -> None:
    sizes = {"Mono12p": 5, "Mono10p": 4, "Mono12Packed": 5, "Mono10Packed": 5}
    for name, expected in sizes.items():
        assert PIXEL_FORMATS[name].frame_bytes(3, 1) == expected


def test_names_say_colour_and_depth() -> None:
    assert find_pixel_format("BayerRGPolarized12p").bayer == "RGGB"
    assert find_pixel_format("BayerGR10p").bayer == "GRBG"
    assert find_pixel_format("BayerGB8").bayer == "GBRG"
    assert find_pixel_format("BayerBG16").bayer == "BGGR"
    assert find_pixel_format("Polarized12Packed").bayer is None
    assert find_pixel_format("Mono14").white_level == 16383
    assert find_pixel_format(LUCID + "BayerRG12p").planes == 4


def test_unknown_names_list_close_ones() -> None:
    with pytest.raises(InputError, match=r"BayerRG12p.*found 'bayerrg12P'"):
        find_pixel_format("bayerrg12P")
    with pytest.raises(InputError, match="expected a known pixel format"):
        find_pixel_format("YUV422")


@pytest.mark.parametrize("found", [0, 7, 8, 10])
def test_wrong_lengths_say_both_counts(found: int) -> None:
    with pytest.raises(InputError, match=rf"^expected 9 bytes for 3x2 Mono12p, found {found}$"):
        unpack_frame(bytes(found), 3, 2, "Mono12p")


@pytest.mark.parametrize("size", [(0, 4), (4, 0), (-2, -2)])
def test_sizes_must_be_positive(size: tuple[int, int]) -> None:
    with pytest.raises(InputError, match="expected a positive width and height"):
        unpack_frame(b"", *size, "Mono8")


def test_pack_refuses_what_it_cannot_hold() -> None:
    with pytest.raises(InputError, match=r"expected codes in 0 .. 4095 for Mono12p, found 0 .. 4096"):
        pack_frame(np.array([[0, 4096]]), "Mono12p")
    with pytest.raises(InputError, match="expected codes in 0"):
        pack_frame(np.array([[-1, 1]]), "Mono8")
    with pytest.raises(InputError, match="expected integer codes"):
        pack_frame(np.zeros((2, 2)), "Mono8")
    with pytest.raises(InputError, match=r"expected codes \[4, H, W\]"):
        pack_frame(np.zeros((3, 2, 2), np.uint8), LUCID + "Mono8")
    with pytest.raises(InputError, match=r"expected codes \[H, W\]"):
        pack_frame(np.zeros((4, 2, 2), np.uint8), "Mono8")
