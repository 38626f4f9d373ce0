"""Lens, scale, statures and standard sizes: what is odd or uncertain is said, with its cure."""

import math
from dataclasses import replace

import little_room
import pytest
import torch

from mover.bodies.parts import parts_of
from mover.bodies.skinning import open_body, zero_pose
from mover.core.records import rows_of
from mover.core.types import Bodies
from mover.geometry.camera import tilted
from mover.pipeline.estimates import (
    lens_and_scale,
    odd_sizes,
    odd_statures,
    poor_fits,
    tilt_of_camera,
)

CAMERA = little_room.camera()  # 400 px, 640 px wide: 77 degrees


@pytest.mark.parametrize(("lens", "size", "said", "cures"), [
    (0.01, 0.02, ("400 px, 77° across, ± 1.0 %", "± 2.0 %"), (False, False)),
    (0.064, 0.06, ("± 6.4 %", "± 6.0 %"), (True, True)),
    (None, 0.0, ("not stated", "size of the people or"), (False, False)),
    (0.03, None, ("± 3.0 %", "no people"), (True, False)),
])  # fmt: skip
def test_lens_and_scale_have_their_spreads_and_a_cure_where_they_are_loose(lens, size, said, cures):
    found = lens_and_scale(CAMERA, lens, size)
    for line, text, cure, way in zip(
        found, said, cures, ("measured one", "mover fit --height"), strict=True
    ):
        assert text in line
        assert (way in line) == cure


def standing(scale: float) -> Bodies:
    """Two open bodies beside each other, the second one of another size, upright in the world."""
    model = open_body()
    verts, joints = model.posed(zero_pose(1, model))
    both = torch.tensor([1.0, scale])[:, None, None]
    person = torch.arange(2)
    return Bodies(
        (verts * both).float(), model.faces, (joints * both).float(), model.joint_names,
        torch.zeros(2, dtype=torch.long), person, 5.0, "world", None,
    )  # fmt: skip


def test_only_a_stature_beyond_the_population_is_named():
    usual = standing(1.0)
    none = rows_of(usual, torch.zeros(2, dtype=torch.bool))
    assert odd_statures(none, parts_of(usual)) == ()
    height = float(usual.verts[0, :, 1].max() - usual.verts[0, :, 1].min())
    for tall, count in ((1.90, 0), (1.96, 1), (1.45, 0), (1.40, 1)):
        bodies = standing(tall / height)
        found = odd_statures(bodies, parts_of(bodies))
        assert len(found) == count, tall
        assert all(f"person 1 is {tall:.2f} m tall" in one and "--height" in one for one in found)


@pytest.mark.parametrize(("category", "size", "said"), [
    ("bed", (1.6, 0.5, 2.1), ""),
    ("bed", (2.0, 0.5, 3.2), "3.20 m deep"),
    ("dining table", (1.2, 0.42, 0.8), ""),  # COCO calls coffee tables so, too
    ("desk", (1.2, 0.42, 0.7), "0.42 m high"),
    ("dining table", (1.2, 3.0, 0.8), "35.0 standard deviations from the usual 0.74 m"),
    ("statue", (9.0, 9.0, 9.0), ""),
])  # fmt: skip
def test_only_a_size_beyond_the_standard_of_its_class_is_named(category, size, said):
    mesh = little_room.box(*size)
    item = replace(little_room.piece("it", mesh, (0.0, -3.0), 0.4, -1.5), category=category)
    found = odd_sizes((item,))
    assert len(found) == bool(said)
    assert all(said in one for one in found)


def test_a_fit_that_misses_by_more_than_a_fortieth_of_the_height_is_named():
    bodies = standing(1.0)
    away = torch.tensor([0.0, 0.0, 4.0])
    bodies = replace(bodies, verts=bodies.verts + away, joints=bodies.joints + away, space="camera")
    high = 400 * 1.68 / 4  # [px] of an adult 4 m away
    (found,) = poor_fits(bodies, high * torch.tensor([0.02, 0.04]), CAMERA)
    assert found.startswith("person 1: the fit misses the keypoints by 4.")


def test_a_tilt_that_feet_leave_open_is_named_with_what_would_narrow_it():
    tilted_camera = replace(CAMERA, R_cam_world=tilted(torch.tensor(-0.2), torch.tensor(0.01)))
    vague, sure = (tilt_of_camera(tilted_camera, math.radians(s)) for s in (1.9, 0.3))
    assert sure == "camera: pitch -11.5°, roll 0.6°, ± 0.3° before the furniture"
    assert vague.startswith("camera: pitch -11.5°, roll 0.6°, ± 1.9° before the furniture; ")
    assert "--tilt" in vague
