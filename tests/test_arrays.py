from typing import Any

import numpy as np
import pytest
import tiny_capture as tiny
import torch
from test_folder import close

from mover.core.errors import InputError
from mover.core.types import Capture
from mover.io.capture.arrays import ObjectArrays, PeopleArrays, capture_from_arrays
from mover.io.capture.folder import read_capture

STEP = {"vertices": tiny.STEP, "faces": tiny.STEP_FACES}


def chair(**changes: object) -> ObjectArrays:
    place = {"translation": (-0.9, -1.4, -3.0), "yaw": 0.4, "scale": (0.5, 0.9, 0.6)}
    given: dict[str, Any] = {**STEP, **place, "mask": tiny.object_mask(0), "score": 0.75, **changes}
    return ObjectArrays("chair_0", "chair", **given)


def lamp(**changes: object) -> ObjectArrays:
    given: dict[str, Any] = {
        "vertices": tiny.STEP / 2 + [0.1, 0.2, 0.3], "faces": torch.from_numpy(tiny.STEP_FACES),
        "translation": np.array([0.8, -0.5, -3.2]), "yaw": np.float32(-2.9),
        "scale": [1.0, 1.1, 1.2], "support": "chair_0", "mask": tiny.object_mask(1),
        "box": (40.5, 10, 59.75, 30), **changes,
    }  # fmt: skip
    return ObjectArrays("Lampe_ä.2", "Stehlampe", **given)


def make(**changes: object) -> Capture:
    masks = np.stack([tiny.person_mask(i) for i in range(3)])
    people = PeopleArrays(masks, [0, 0, 3], [0, 7, 0], {"0": 1.78}, tiny.person_mask(2)[None])
    given: dict[str, Any] = {
        "camera": tiny.camera(height=1.45), "objects": [chair(), lamp()], "people": people,
        "bodies": {**tiny.bodies(), "fps": 5.0, "probability": tiny.touch()},
        "image": tiny.picture(), **changes,
    }  # fmt: skip
    return capture_from_arrays(given.pop("camera"), given.pop("objects"), **given)


def test_arrays_give_the_same_capture_as_the_folder(folder):
    # What arrays cannot say the same way: where the ground is, and numbers of annotations.
    tiny.change(folder / "scene.json", "ground", ...)
    for i in range(2):
        tiny.change(folder / "scene.json", f"objects.{i}.annotation", i)
        tiny.change(folder / "objects.json", f"annotations.{i}.id", i)
    close(read_capture(folder), make())


@pytest.mark.parametrize(("change", "words"), [
    ({"objects": [chair(mask=tiny.object_mask(0)[1:])]}, r"annotations\[0\].segmentation.*size"),
    ({"objects": [chair(mask=tiny.object_mask(0) * 1.0)]}, r"objects\[0\].mask.*booleans"),
    ({"objects": [chair(mask=tiny.object_mask(0) & False)]}, "an empty mask"),
    ({"objects": [chair(vertices=tiny.STEP * np.nan)]}, r"objects\[0\].vertices' has nan"),
    ({"objects": [chair(faces=tiny.STEP_FACES + 1)]}, r"objects\[0\].faces.*vertices 1 to 5"),
    ({"objects": [chair(faces=tiny.STEP_FACES[:0])]}, "an empty mesh"),
    ({"objects": [chair(yaw=np.inf)]}, r"objects\[0\].yaw' has inf"),
    ({"objects": [chair(), chair()]}, "used twice"),
    ({"image": tiny.picture()[:4]}, "'image' has shape"),
    ({"image": tiny.picture() * 1.0}, "bytes, or numbers from 0 to 1"),
    ({"camera": tiny.camera(fl_x=0.0)}, "camera.fl_x' has 0.0"),
    ({"people": PeopleArrays(np.zeros((1, 48, 64)), [0], [0])}, "people.masks.*booleans"),
    ({"people": PeopleArrays(np.zeros((1, 48, 64), bool), [0, 1], [0])}, "people.frame"),
    ({"bodies": {**tiny.bodies(), "faces": tiny.BODY_FACES + 9}}, "bodies.faces"),
])  # fmt: skip
def test_the_checks_are_those_of_the_folder(change, words):
    with pytest.raises(InputError, match=words) as caught:
        make(**change)
    assert str(caught.value).startswith("arrays: field")
    assert "expected" in str(caught.value)
