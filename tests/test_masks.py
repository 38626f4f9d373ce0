import json
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from pycocotools import mask as coco
from tiny_capture import compressed, runs

from mover.core.errors import InputError
from mover.core.types import Masks
from mover.geometry.rle import area, decode, encode, resampled, run_lengths, tight_box
from mover.io.files.fields import At
from mover.io.masks.coco import from_coco

DATA = Path(__file__).parents[2] / "shared" / "data"
AT = At(None, "objects.json", "segmentation")
MASKS = arrays(np.bool_, st.tuples(st.integers(1, 9), st.integers(1, 13)))


def corners(box: np.ndarray) -> list[float]:
    return [box[0], box[1], box[0] + box[2], box[1] + box[3]]


def image_of(code: bytes, shape: list[int] | tuple[int, ...]) -> np.ndarray:
    return decode(Masks(shape[0], shape[1], (code,)), 0).numpy()


@given(MASKS)
def test_both_codes_and_the_encoder_give_the_mask_back(mask):
    counts, code = runs(mask), encode(torch.from_numpy(mask))
    written = (counts, compressed(counts), compressed(counts).encode())
    size = list(mask.shape)
    read = [from_coco(AT.holding({"size": size, "counts": one}), *size) for one in written]
    assert all((image_of(one, mask.shape) == mask).all() for one in (*read, code))
    assert area(Masks(*size, (code,)), 0) == mask.sum()


@given(st.lists(st.integers(0, 10**7), min_size=1, max_size=40))
def test_a_compressed_code_holds_its_runs(counts):
    assert run_lengths(compressed(counts).encode()).tolist() == counts


@given(MASKS, st.integers(1, 20), st.integers(1, 20))
def test_a_resampled_code_is_that_of_the_pixels_that_are_picked(mask, height, width):
    rows, columns = (
        (np.arange(n) + 0.5) * m // n for m, n in zip(mask.shape, (height, width), strict=True)
    )
    rows, columns = rows.astype(np.int64), columns.astype(np.int64)
    picked = mask[rows][:, columns]
    split = [part for run in runs(mask) for part in (run // 2, 0, run - run // 2)]
    for code in (encode(torch.from_numpy(mask)), compressed(split).encode()):
        found = resampled(Masks(*mask.shape, (code,)), 0, rows, columns)
        assert found == (encode(torch.from_numpy(picked)) if picked.any() else None)


@given(st.binary(max_size=12) | st.text(max_size=12))
def test_a_code_of_noise_is_refused_or_fits_the_image(code):
    try:
        found = from_coco(AT.holding({"size": [3, 5], "counts": code}), 3, 5)
    except InputError as error:
        assert str(error).startswith(AT.place)  # noqa: PT017
    else:
        assert image_of(found, (3, 5)).shape == (3, 5)


def test_polygons_are_joined_and_clipped():
    outlines = [[-3, -2, 2, -2, 2, 3, -3, 3], [5, 0, 8, 0, 8, 6, 5, 6]]
    found = image_of(from_coco(AT.holding(outlines), 6, 7), (6, 7))
    expected = np.zeros((6, 7), dtype=bool)
    expected[:3, :2] = expected[:, 5:] = True
    assert (found == expected).all()


@pytest.mark.parametrize(("segmentation", "words"), [
    ([], "no polygon"),
    ([[0, 0, 1, 1]], "polygon 0 with 4 numbers"),
    ([[0, 0, 1, 1, 2, 2, 3]], "7 numbers, an odd count"),
    ([[0, 0, 1, float("nan"), 2, 2]], "far outside"),
    ([[0, 0, 1, 1e300, 2, 2]], "far outside"),
    ([[0, 0, 1, "a", 2, 2]], r"polygon 0 with text \('a'\), expected .* without quotes"),
    ([["0.5", "0", "1", "1", "2", "2"]], r"text \('0.5'\)"),
    ([3], "3"),
    ([[]], "no polygon"),
    ("abc", "compressed code"),
    ("{'size': [3, 5], 'counts': [14]}", "sum to 14"),
    ("[[[[", "compressed code"),
    ({"size": [3, 5], "counts": "b'ä'"}, "compressed code"),
    (7, "int"),
    ({"counts": [15]}, "has size None"),
    ({"size": [5, 3], "counts": [15]}, r"has size \[5, 3\], expected \[3, 5\]"),
    ({"size": [3, 5]}, "NoneType"),
    ({"size": [3, 5], "counts": [14]}, "sum to 14"),
    ({"size": [3, 5], "counts": [20, -5]}, "a negative run"),
    ({"size": [3, 5], "counts": [15.0]}, "whole numbers"),
    ({"size": [3, 5], "counts": [True] * 15}, "whole numbers"),
    ({"size": [3, 5], "counts": [10**30]}, "whole numbers"),
    ({"size": [3, 5], "counts": ""}, "cut off"),
    ({"size": [3, 5], "counts": "o"}, "cut off"),
    ({"size": [3, 5], "counts": "oooooooo0"}, "35 bits"),
    ({"size": [3, 5], "counts": "ä"}, "compressed code"),
    ({"size": [3, 5], "counts": " "}, "characters"),
    ({"size": [3, 5], "counts": "40"}, "sum to"),
])  # fmt: skip
def test_a_malformed_mask_is_named_with_its_place(segmentation, words):
    with pytest.raises(InputError, match=words) as caught:
        from_coco(AT.holding(segmentation), 3, 5)
    assert str(caught.value).startswith(AT.place)
    assert "expected" in str(caught.value)


WAYS = {
    "str() of bytes": lambda code: {"size": [6, 9], "counts": str(code.encode())},
    "str() of the whole": lambda code: str({"size": [6, 9], "counts": code}),
    "the code alone": lambda code: code,
    "bytes": lambda code: {"size": [6, 9], "counts": code.encode()},
    "one polygon": lambda _: [2, 1, 7, 1, 7, 4, 2, 4],
    "pairs": lambda _: [[2, 1], [7, 1], [7, 4], [2, 4]],
    "a polygon": lambda _: [[2, 1, 7, 1, 7, 4, 2, 4]],
    "an empty polygon beside": lambda _: [[], [2, 1, 7, 1, 7, 4, 2, 4]],
}  # cocoapi 493, 531, 70; cvat 4750, 814; rectlabel 219


@pytest.mark.parametrize("way", WAYS)
def test_a_mask_is_read_as_people_write_it(way):
    expected = np.zeros((6, 9), dtype=bool)
    expected[1:4, 2:7] = True
    found = image_of(from_coco(AT.holding(WAYS[way](compressed(runs(expected)))), 6, 9), (6, 9))
    assert (found == expected).all()
    assert tight_box(torch.from_numpy(found)).tolist() == [2, 1, 7, 4]


@pytest.mark.skipif(not DATA.is_dir(), reason="the shared data is not here")
class TestRealFiles:
    def test_results_of_cocos_own_tools_decode_as_pycocotools_does(self):
        file = DATA / "formats" / "coco_instances_val2014_fakesegm100_results.json"
        rows = json.loads(file.read_text())
        for row in rows[::40]:
            code = row["segmentation"]
            found = image_of(from_coco(AT.holding(code), *code["size"]), code["size"])
            assert found.sum() == coco.area(code)
            assert tight_box(torch.from_numpy(found)).tolist() == corners(coco.toBbox(code))
            assert run_lengths(code["counts"].encode()).tolist() == runs(found)

    def test_a_masklet_of_sa_v_decodes_to_masks_of_the_right_area(self):
        tree = json.loads((DATA / "formats/sav_000001_manual.json").read_text())
        codes = [code for frame in tree["masklet"][:3] for code in frame]
        assert codes
        for code in codes:
            found = image_of(from_coco(AT.holding(code), *code["size"]), code["size"])
            assert found.sum() == coco.area(code)
