"""Heights of known bodies against those of their masks."""

import dataclasses

import pytest
import torch
from figures import STRIDE, people, pose, turned
from scipy.ndimage import distance_transform_edt
from test_find_depth import CAMERA, SIZE, masks_of, moved

from mover.core.types import Masks
from mover.geometry.rle import decode, encode
from mover.stages.cover import Cover, covered
from mover.stages.masks import compare_extents, mask_table, pixels_of

NO_PEOPLE = Masks(*SIZE, ())
UPRIGHT = {"left_shoulder": (0.0, 0.0, -1.45), "right_shoulder": (0.0, 0.0, 1.45)}
WALKING = STRIDE | UPRIGHT
L_SHAPE = {**UPRIGHT, "left_hip": (-1.5, 0.0, 0.0), "right_hip": (-1.5, 0.0, 0.0)}
SIDEWAYS = (0.0, 1.57, 0.0)


def bodies_of(poses, shift=0.0, far=3.4):
    """One body a frame, standing side by side along the room, in camera axes."""
    all_of = [people(p, floor=-1.3) for p in poses]
    place = torch.linspace(-0.7, 0.7, len(poses))
    verts = torch.cat([b.verts for b in all_of])
    at = torch.stack([place, 0 * place, -far - shift * place.abs()], -1)
    verts = (verts + at[:, None]) @ CAMERA.R_cam_world.mT
    rows = torch.arange(len(poses))
    return dataclasses.replace(
        all_of[0], verts=verts, frame=rows, person=0 * rows, space="camera", pose=None
    )


def upright(count=6):
    return bodies_of([pose(WALKING if k % 2 else UPRIGHT) for k in range(count)], shift=1.0)


def wider(seen, pixels):
    """The masks so many pixels wider, or narrower, all round."""
    masks = (decode(seen.masks, k).numpy() for k in range(len(seen.masks.counts)))
    grown = (
        distance_transform_edt(~m) <= pixels if pixels > 0 else distance_transform_edt(m) > -pixels
        for m in masks
    )
    coded = tuple(encode(torch.from_numpy(m)) for m in grown)
    return dataclasses.replace(seen, masks=Masks(*SIZE, coded))


def compared(bodies, seen, objects=NO_PEOPLE):
    rows, table = torch.arange(len(bodies.frame)), mask_table(seen, bodies)
    return compare_extents(bodies, rows, CAMERA, table, covered(Cover(objects)))


@pytest.mark.parametrize("pixels", [-2, 0, 1])
@pytest.mark.parametrize("bias", [1.02, 0.98])
def test_bodies_at_a_wrong_depth_are_found_whatever_the_width_of_the_masks(bias, pixels):
    true = upright()
    seen = masks_of(true)
    found = compared(moved(true, bias), wider(seen, pixels) if pixels else seen)
    assert found.frames == 6
    assert found.factor == pytest.approx(1 / bias, abs=0.005)
    assert found.spread < 0.005


def test_people_whom_objects_or_others_hide_are_left_out():
    true = upright()
    table = torch.zeros(SIZE, dtype=torch.bool)
    table[230:] = True
    objects = Masks(*SIZE, (encode(table),))
    seen = masks_of(true, hidden=table)
    assert compared(true, seen, objects) is None
    two = dataclasses.replace(
        seen, masks=Masks(*SIZE, seen.masks.counts + (encode(table),) * 6),
        frame=seen.frame.repeat(2), person=torch.cat([seen.person, seen.person + 1]),
    )  # fmt: skip
    assert compared(true, two) is None


def test_an_object_behind_a_person_hides_no_one():
    true = upright()
    wall = torch.ones(SIZE, dtype=torch.bool)
    found = compared(true, masks_of(true), Masks(*SIZE, (encode(wall),)))
    assert found.factor == pytest.approx(1.0, abs=1e-9)


def test_people_cut_off_by_the_image_or_without_a_mask_say_nothing():
    near = bodies_of([pose(UPRIGHT)] * 3, far=1.2)
    assert compared(near, masks_of(near)) is None
    true = upright()
    other = dataclasses.replace(masks_of(true), person=torch.ones(6, dtype=torch.long))
    assert compared(true, other) is None


def test_people_behind_the_camera_or_too_small_say_nothing():
    true = upright()
    behind = dataclasses.replace(true, verts=true.verts * torch.tensor([1.0, 1.0, -1.0]))
    assert compared(behind, masks_of(true)) is None
    far = bodies_of([pose(UPRIGHT)] * 3, far=12.0)
    assert compared(far, masks_of(far)) is None


def test_bent_people_are_left_out_and_the_others_count():
    bent = [turned(pose(L_SHAPE), *SIDEWAYS)] * 3
    only = bodies_of(bent)
    assert compared(only, masks_of(only)) is None
    both = bodies_of([pose(UPRIGHT)] * 3 + bent)
    wrong = moved(both, 1.02)
    seen = masks_of(both)
    found = compared(wrong, seen)
    assert found.frames == 3
    assert found.factor == pytest.approx(1 / 1.02, abs=0.005)


def test_some_wrong_masks_do_not_move_the_factor():
    true = upright(7)
    seen = masks_of(true)
    small = torch.zeros(SIZE, dtype=torch.bool)
    small[100:220, 300:330] = True
    counts = (encode(small),) * 2 + seen.masks.counts[2:]
    found = compared(true, dataclasses.replace(seen, masks=Masks(*SIZE, counts)))
    assert found.frames == 7
    assert found.factor == pytest.approx(1.0, abs=1e-9)


def test_the_pixels_of_no_masks_are_none_and_of_several_their_union():
    assert not pixels_of(NO_PEOPLE).any()
    a, b = torch.zeros(2, *SIZE, dtype=torch.bool)
    a[10:20], b[:, 30:40] = True, True
    assert torch.equal(pixels_of(Masks(*SIZE, (encode(a), encode(b)))), a | b)
