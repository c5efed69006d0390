"""Files of other programs are read with the values that they hold, or refused by name."""

import struct

import numpy as np
import pytest
import tifffile

import stokescope as ss

COUNTS = np.random.default_rng(3).integers(0, 65536, (48, 64)).astype(np.uint16)
BAYER = [(33421, "H", 2, (2, 2), True), (33422, "B", 4, bytes([0, 1, 1, 2]), True)]
DNG = [(50706, "B", 4, bytes([1, 4, 0, 0]), True)]


@pytest.mark.parametrize("layout", [{}, {"tile": (16, 16)}, {"bigtiff": True}, {"byteorder": ">"}, {"rowsperstrip": 5}], ids=str)
@pytest.mark.parametrize("values", [COUNTS, COUNTS.astype(np.uint8), COUNTS / np.float32(65535), COUNTS / 65535.0], ids=lambda v: v.dtype.name)
def test_a_tiff_image_is_that_of_tifffile(tmp_path, values, layout):
    tifffile.imwrite(tmp_path / "a.tif", values, photometric="minisblack", **layout)
    found = ss.read(tmp_path / "a.tif")
    assert np.array_equal(found, values.astype(found.dtype)) and found.dtype == (np.float32 if values.dtype == np.float64 else values.dtype)


@pytest.mark.parametrize(
    "values, options, message",
    [
        (COUNTS, {"photometric": "cfa", "extratags": BAYER}, "as of Bayer data.*write the colour planes of Bayer data as NPY"),
        (COUNTS, {"photometric": "cfa", "extratags": BAYER + DNG}, "DNG files, allowed: .*rawpy reads DNG files"),
        (COUNTS, {"photometric": "minisblack", "subfiletype": 1}, "first page is a reduced image.*as the first of a DNG file is"),
        (COUNTS / np.float32(65535), {"photometric": "miniswhite"}, "white is zero, allowed: black is zero, for floating-point values"),
        (COUNTS.astype(np.int32), {"photometric": "minisblack"}, "colour type is .*, allowed: gray or RGB of 8 or 16 bit"),
    ],
    ids=["Bayer", "DNG", "preview", "white is zero", "32-bit integers"],
)
def test_what_would_be_half_read_is_refused(tmp_path, values, options, message):
    tifffile.imwrite(tmp_path / "a.tif", values, **options)
    with pytest.raises(ss.Error, match=message):
        ss.read(tmp_path / "a.tif")


def test_all_pages_are_read(tmp_path):
    tifffile.imwrite(tmp_path / "a.tif", np.stack([COUNTS, COUNTS // 2]), photometric="minisblack")
    assert np.array_equal(ss.read(tmp_path / "a.tif"), [COUNTS, COUNTS // 2])


def test_reversed_bits_are_refused(tmp_path):
    # tifffile does not write this tag: a private one gets its number
    tifffile.imwrite(tmp_path / "a.tif", COUNTS, extratags=[(65000, "H", 1, 2, True)])
    data, tag = (tmp_path / "a.tif").read_bytes(), struct.pack("<HHI", 65000, 3, 1)
    assert data.count(tag) == 1
    (tmp_path / "a.tif").write_bytes(data.replace(tag, struct.pack("<HHI", 266, 3, 1)))
    with pytest.raises(ss.Error, match="fill order is 2 .reversed bits., allowed: 1; save the file again"):
        ss.read(tmp_path / "a.tif")


def test_a_jpeg_is_refused(tmp_path):
    pytest.importorskip("PIL.Image").fromarray(COUNTS.astype(np.uint8)).save(tmp_path / "a.jpg")
    with pytest.raises(ss.Error, match="file type is JPEG, allowed: NPY, PNG or TIFF; save a guide as PNG, and record raw frames without loss"):
        ss.read(tmp_path / "a.jpg")
