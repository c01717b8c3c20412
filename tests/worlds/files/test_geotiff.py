"""GeoTIFFs are read as GDAL reads them: compression, bands, units, position, and missing heights."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rover_rl.worlds import World

for module in ("imagecodecs", "pyproj", "tifffile"):
    pytest.importorskip(module, reason="needs rover_rl[worlds]")

ROWS, COLUMNS = np.mgrid[0:33, 0:41]
HEIGHTS = 100.0 + np.rint(5 * np.sin(COLUMNS / 9) + 4 * np.cos(ROWS / 7))
SCALE = (33550, "d", 3, (2.0, 2.0, 0.0), True)
TIE = (33922, "d", 6, (0.0, 0.0, 0.0, -20.0, 30.0, 0.0), True)
NORTH_UP = (SCALE, TIE)


def keys(**numbers: int) -> tuple:
    """Returns the tag of GeoTIFF keys: ``_1024=1`` and so on."""
    flat = [number for name, value in numbers.items() for number in (int(name[1:]), 0, 1, value)]
    return (34735, "H", 4 + len(flat), (1, 1, 0, len(numbers), *flat), True)


def metadata(**items: object) -> tuple:
    text = "".join(
        f'<Item name="{role.upper()}" sample="{band}" role="{role}">{value}</Item>'
        for role, value in items.items()
        for band, value in ((1, 7), (0, value))
    )
    return (42112, "s", 0, f"<GDALMetadata>{text}</GDALMetadata>", True)


def no_data(text: str) -> tuple:
    return (42113, "s", 0, text, True)


def write(folder: Path, values: np.ndarray, *tags: tuple, **options: object) -> Path:
    import tifffile

    options = {"metadata": None, "photometric": "minisblack"} | options
    tifffile.imwrite(folder / "dem.tif", values, extratags=tags, **options)
    return folder / "dem.tif"


def measures(world: World) -> tuple[float, float, float, float]:
    """Returns the lowest and the highest point, and the sides of the ground, m."""
    heights, ((left, right), (bottom, top)) = world.terrain.heights, world.terrain.extent
    return float(heights.min()), float(heights.max()), right - left, top - bottom


def found(path: Path, **options: float) -> tuple[float, float, float, float]:
    return measures(World.from_file(path, **options))


USUAL = (91.0, 109.0, 80.0, 64.0)


@pytest.mark.parametrize(
    ("compression", "kind", "predictor", "tile"),
    [
        (None, "uint8", None, None),
        ("lzw", "int16", 2, (16, 32)),
        ("adobe_deflate", "float32", 3, None),
        ("zstd", "float64", 3, (16, 32)),
        ("packbits", "int32", None, (16, 32)),
    ],
)
def test_all_compressions_of_gdal_are_read(tmp_path, compression, kind, predictor, tile):
    options = {"compression": compression, "predictor": predictor, "tile": tile}
    assert found(write(tmp_path, HEIGHTS.astype(kind), *NORTH_UP, **options)) == USUAL


@pytest.mark.parametrize("planar", ["contig", "separate"])
def test_the_first_of_several_bands_counts(tmp_path, planar):
    bands = np.stack((HEIGHTS, 3 * HEIGHTS, 0 * HEIGHTS)).astype(np.int16)
    values = bands if planar == "separate" else np.moveaxis(bands, 0, -1)
    path = write(tmp_path, values, *NORTH_UP, planarconfig=planar, compression="lzw", predictor=2)
    world = World.from_file(path)
    assert measures(world) == USUAL
    assert "ground: the first of 3 bands" in world.notes


def test_masks_and_alpha_hide_values_and_overviews_do_not_count(tmp_path):
    import tifffile

    holes = np.where(COLUMNS < 4, -5000, HEIGHTS).astype(np.float32)
    shown = np.where(COLUMNS < 4, 0, 255).astype(np.uint8)
    with tifffile.TiffWriter(tmp_path / "cog.tif") as file:
        file.write(holes, extratags=NORTH_UP, metadata=None, tile=(16, 16))
        file.write(shown > 0, subfiletype=4, metadata=None)
        file.write(holes[::2, ::2], subfiletype=1, metadata=None, tile=(16, 16))
    assert found(tmp_path / "cog.tif") == USUAL
    colors = np.stack((np.where(COLUMNS < 4, 3, HEIGHTS), HEIGHTS, HEIGHTS, shown), -1).astype(np.uint8)
    assert found(write(tmp_path, colors, *NORTH_UP, photometric="rgb", extrasamples=["unassalpha"])) == USUAL


@pytest.mark.parametrize(
    ("text", "hole"),
    [
        ("-9999", -9999.0),
        ("-3.40282306073709653e+38", np.finfo(np.float32).min),
        ("-3.4028234663852886e+38", np.finfo(np.float32).min),
        (" nan", np.nan),
        ("-inf", -np.inf),
        ("none", np.nan),
    ],
)
def test_no_data_is_filled_from_its_neighbors(tmp_path, capfd, text, hole):
    values = np.where(COLUMNS < 4, hole, HEIGHTS).astype(np.float32)
    assert found(write(tmp_path, values, *NORTH_UP, no_data(text))) == USUAL
    assert "GDAL_NODATA" not in capfd.readouterr().err


FOOT, SURVEY_FOOT = 0.3048, 1200 / 3937


@pytest.mark.parametrize(
    ("tags", "length", "height"),
    [
        ([], 1.0, 1.0),
        ([keys(_1024=1, _3072=2926, _3076=9002, _4099=9002)], FOOT, FOOT),
        ([keys(_1024=1, _3072=2263)], SURVEY_FOOT, 1.0),
        ([keys(_1024=1, _3072=2263, _4096=6360)], SURVEY_FOOT, SURVEY_FOOT),
        ([keys(_3072=32618, _4096=8228)], 1.0, FOOT),
        ([keys(_1024=1, _3072=32632, _4096=5703, _4099=9002)], 1.0, 1.0),  # The height system counts.
        ([keys(_1024=1, _3072=32767, _3076=9096)], 0.9144, 1.0),
        ([metadata(unittype="ft")], 1.0, FOOT),
        ([metadata(unittype="US survey foot"), keys(_1024=1, _3076=9003)], SURVEY_FOOT, SURVEY_FOOT),
        ([metadata(unittype="metre"), keys(_1024=1, _3072=32632, _4099=9002)], 1.0, 1.0),
    ],
)
def test_units_of_length_and_height(tmp_path, tags, length, height):
    values = HEIGHTS.astype(np.float32)
    world = World.from_file(write(tmp_path, values, *NORTH_UP, *tags), cell=2.0 * length)
    expected = (91 * height, 109 * height, 80 * length, 64 * length)
    assert measures(world) == pytest.approx(expected, rel=1e-6)
    notes = world.notes
    assert any("lengths in the file are in units" in note for note in notes) == (length != 1)
    assert any("heights in the file are in units" in note for note in notes) == (height != 1)
    assert any("no unit of its heights" in note for note in notes) == (length != 1 and height == 1)


def test_scale_and_offset_of_the_band(tmp_path):
    values = (10 * (HEIGHTS - 100)).astype(np.int16)
    assert found(write(tmp_path, values, *NORTH_UP, metadata(offset=100, scale=0.1))) == pytest.approx(USUAL)
    feet = write(tmp_path, values, *NORTH_UP, metadata(offset=100, scale=0.1, unittype="ft"))
    assert found(feet)[:2] == pytest.approx((91 * FOOT, 109 * FOOT))


def test_unsigned_integers_of_a_geotiff_are_meters_and_those_of_a_picture_have_no_height(tmp_path):
    values = HEIGHTS.astype(np.uint16)
    assert found(write(tmp_path, values, *NORTH_UP)) == USUAL
    white = np.iinfo(np.uint16).max
    assert found(tmp_path / "dem.tif", height=10.0)[:2] == pytest.approx((910 / white, 1090 / white))
    with pytest.raises(ValueError, match=r"dem\.tif does not say how high it is; give height"):
        World.from_file(write(tmp_path, values), pixel=2.0)
    assert found(tmp_path / "dem.tif", pixel=2.0, height=white / 10)[:2] == pytest.approx((9.1, 10.9))


@pytest.mark.parametrize(
    ("geographic", "corner", "zone"),
    [
        (keys(_1024=2, _2048=4326, _2054=9102), (7.5, 46.5), 32632),
        (keys(_2048=4269), (-70.6, -33.4), 32719),
        (keys(_1024=1, _3072=4326), (179.9, 0.1), 32660),
    ],
)
def test_degrees_are_no_meters(tmp_path, geographic, corner, zone):
    spacing, tie = (33550, "d", 3, (1 / 3600, 1 / 3600, 0.0), True), (33922, "d", 6, (0, 0, 0, *corner, 0.0), True)
    path = write(tmp_path, HEIGHTS.astype(np.float32), spacing, tie, geographic)
    with pytest.raises(ValueError, match=rf"in degrees.* -t_srs EPSG:{zone} dem\.tif .*, or give pixel"):
        World.from_file(path)
    assert found(path, pixel=2.0) == USUAL


SOUTH, WEST = HEIGHTS[::-1], HEIGHTS[:, ::-1]


@pytest.mark.parametrize(
    ("values", "tags"),
    [
        (HEIGHTS, NORTH_UP),
        (HEIGHTS, [(33550, "d", 3, (2.0, -2.0, 0.0), True), TIE]),  # GDAL ignores this sign.
        (WEST, [(33550, "d", 3, (-2.0, 2.0, 0.0), True), (33922, "d", 6, (0.0, 0.0, 0.0, 62.0, 30.0, 0.0), True)]),
        (HEIGHTS, [SCALE, (33922, "d", 6, (5.0, 10.0, 0.0, -10.0, 10.0, 0.0), True)]),
        (HEIGHTS, [(34264, "d", 16, (2.0, 0, 0, -20.0, 0, -2.0, 0, 30.0, *6 * (0,), 0, 1), True)]),
        (SOUTH, [(34264, "d", 16, (2.0, 0, 0, -20.0, 0, 2.0, 0, -36.0, *6 * (0,), 0, 1), True)]),
        (HEIGHTS, [SCALE, (33922, "d", 6, (0, 0, 0, -19.0, 29.0, 0.0), True), keys(_1025=2)]),
    ],
)
def test_rows_and_columns_run_where_the_file_says(tmp_path, values, tags):
    world = World.from_file(write(tmp_path, values.astype(np.float32), *tags))
    assert world.terrain.extent == ((-19.0, 61.0), (-35.0, 29.0))
    np.testing.assert_array_equal(world.terrain.heights.numpy(), HEIGHTS[::-1])


def test_a_model_far_away_is_moved_to_the_origin(tmp_path):
    far = (33922, "d", 6, (0.0, 0.0, 0.0, 500_000.0, 5_500_000.0, 0.0), True)
    world = World.from_file(write(tmp_path, HEIGHTS.astype(np.float32), SCALE, far))
    assert world.terrain.extent == ((-40.0, 40.0), (-32.0, 32.0))
    assert any("500041" in note for note in world.notes)


def test_a_turned_grid_is_refused_and_helped_by_pixel(tmp_path):
    turned = (34264, "d", 16, (1.8, 0.6, 0, 0.0, 0.6, -1.8, 0, 0.0, *6 * (0,), 0, 1), True)
    path = write(tmp_path, HEIGHTS.astype(np.float32), turned)
    with pytest.raises(ValueError, match=r"is turned or sheared: turn it with gdalwarp .*, or give pixel"):
        World.from_file(path)
    assert found(path, pixel=2.0) == USUAL


def test_a_compression_that_nobody_reads_gets_advice(tmp_path):
    path = write(tmp_path, HEIGHTS.astype(np.float32), *NORTH_UP)
    data = path.read_bytes()
    # The value of tag 259, Compression, from none (1) to a number that no codec has.
    at = data.index(b"\x03\x01\x03\x00\x01\x00\x00\x00\x01\x00") + 8
    path.write_bytes(data[:at] + b"\x39\x30" + data[at + 2 :])
    with pytest.raises(ValueError, match=r"is a TIFF that cannot be read.*gdal_translate -co COMPRESS=DEFLATE"):
        World.from_file(path)
