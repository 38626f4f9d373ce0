"""People who walk on a bed, behind it and before it: only the first make the floor doubtful."""

from dataclasses import replace

import pytest
import torch
from little_room import GROUND, box, camera, piece, walkers
from torch import Tensor

from mover.app.pictures.eye import video_eye
from mover.app.pictures.paint import PERSON, draw, furniture, joined
from mover.app.pictures.paint import people as surfaces_of
from mover.core.types import Bodies, Detection, Masks, People, Scene
from mover.energy.human_terms import FootContacts
from mover.geometry.camera import to_camera
from mover.geometry.rle import encode, tight_box
from mover.stages.camera.doubt_floor import doubt_floor

HIGH, COUNT = 0.5, 10  # [m], frames


def scene(category: str) -> Scene:
    bed = piece("bed_0", box(2.6, HIGH, 2.0), (0.0, -4.0), 0.0, GROUND)
    return Scene(camera(), GROUND, (replace(bed, category=category),))


def standing(z: float, floor: float) -> Bodies:
    """Somebody who walks half a metre to and fro."""
    bodies = walkers(COUNT, ground=floor)
    middle = bodies.verts.mean((0, 1))
    moved = 0.3 * (bodies.verts.mean(1, keepdim=True) - middle)
    still = bodies.verts - bodies.verts.mean(1, keepdim=True) + moved
    place = torch.stack([torch.tensor(0.0), middle[1], torch.tensor(z)])
    return replace(bodies, verts=still + place, fps=15.0)


def masks_of(owners: list[Tensor], owner: int) -> Masks:
    masks = [drawn == owner for drawn in owners]
    return Masks(*masks[0].shape, tuple(encode(mask) for mask in masks))


def told(category: str, z: float, floor: float) -> tuple[str, ...]:
    room, bodies = scene(category), standing(z, floor)
    eye = video_eye(room.camera, room.camera.width)
    empty = draw(furniture(room), eye).owner
    shown = [
        draw(joined([furniture(room), surfaces_of(bodies, [row])]), eye).owner
        for row in range(COUNT)
    ]
    bed = Detection(7, category, tight_box(empty == 0), masks_of([empty], 0), 1.0)
    people = People(masks_of(shown, PERSON), bodies.frame, bodies.person, {})
    low = bodies.verts[..., 1].argmin(1)
    soles = to_camera(bodies.verts[torch.arange(COUNT), low], room.camera.R_cam_world)
    feet = FootContacts(soles, bodies.person, bodies.frame, ())
    return doubt_floor(feet, (bed,), people, room.camera)


@pytest.mark.parametrize("category", ["bed", "couch"])
def test_feet_that_are_seen_on_a_bed_or_a_sofa_are_told(category: str):
    (warning,) = told(category, -4.0, GROUND + HIGH)
    assert f"feet are seen on a {category} (annotation 7) in 10 of the 10 frames" in warning
    assert "'height' of camera.json" in warning


@pytest.mark.parametrize("z", [-2.4, -5.6])
def test_who_walks_before_or_behind_a_bed_is_on_the_floor(z: float):
    assert told("bed", z, GROUND) == ()


def test_on_a_table_nobody_stands():
    assert told("table", -4.0, GROUND + HIGH) == ()
