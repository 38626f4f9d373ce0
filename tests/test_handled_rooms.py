"""Known rooms whose furniture is pushed, rolled on, or put elsewhere: what is held stays held."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch

from mover.core.types import SceneObject
from mover.evaluate.contact import close_meshes, furniture_of, nearness
from mover.geometry.camera import to_world
from mover.geometry.placement import changes, mover_at, placed_at
from mover.geometry.rle import decode
from mover.geometry.rotations import rot_y
from mover_bench.rooms.known import KnownRoom
from mover_bench.studies.job import Seed, make_truth
from mover_bench.studies.sets import SETS

NEAR = 0.02  # [m] of a palm on an edge that is narrower than the hand


@cache
def little(kind: str) -> KnownRoom:
    config = replace(SETS["mini"].room, moved=kind, least_frames=1, most_frames=0, least_touches=0)
    return make_truth(Seed(100), config)


def moved_piece(room: KnownRoom) -> SceneObject:
    (piece,) = (piece for piece in room.truth.objects if piece.segments)
    return piece


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["pushed", "rolled"])
def test_who_moves_a_piece_touches_it_in_each_frame_with_the_same_skin(kind: str):
    room = little(kind)
    piece, camera = moved_piece(room), room.truth.camera
    begin, end = changes(piece)
    frames = list(range(begin, end))
    assert len(frames) >= 3
    assert {mover_at(piece, frame) for frame in frames} == {0}
    rows = [int((room.bodies.frame == frame).nonzero()[0]) for frame in frames]
    verts = to_world(room.bodies.verts[rows].double(), camera.R_cam_world.double())
    solid = furniture_of([piece], close_meshes([piece]))
    near = nearness(verts.float(), room.bodies.frame[rows], solid, 0.05)
    touching = near.surface < NEAR
    assert touching.any(1).all()
    assert (near.signed.amin(1) > -0.03).all()
    places = [placed_at(piece, frame) for frame in frames]
    local = torch.stack([
        (points - place.t_world_object) @ rot_y(place.yaw)
        for points, place in zip(verts.float(), places, strict=True)
    ])  # fmt: skip
    always = touching.all(0)
    assert always.any()
    assert (local[:, always] - local[:1, always]).norm(dim=-1).max() < 0.02


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["pushed", "rolled"])
def test_a_piece_that_is_moved_goes_smoothly_and_is_drawn_where_it_is(kind: str):
    room = little(kind)
    piece = moved_piece(room)
    begin, end = changes(piece)
    place = torch.stack([placed_at(piece, f).t_world_object for f in range(begin - 1, end + 1)])
    assert place.diff(dim=0).norm(dim=-1).max() < 0.3  # [m] in a fifth of a second
    assert float((place[-1] - place[0]).norm()) > 0.3
    furniture = room.capture.furniture
    assert furniture is not None
    assert not any(given.segments for given in room.capture.scene.objects)
    for frame in (0, end + end % 2):
        mine = (furniture.frame == frame) & (furniture.person == piece.annotation)
        mask = decode(furniture.masks, int(mine.nonzero()[0])).nonzero().double().mean(0)
        there = placed_at(piece, frame)
        middle = there.t_world_object + torch.tensor([0, piece.mesh.verts[:, 1].max() / 2, 0])
        K, R = room.truth.camera.K, room.truth.camera.R_cam_world
        seen = K @ (R @ middle)
        assert np.hypot(*(seen[:2] / seen[2]).flip(0).sub(mask).tolist()) < 25  # [px] of 320


@pytest.mark.slow
def test_where_nothing_is_moved_both_visitors_find_the_same_room():
    room = little("stays")
    assert not any(piece.segments for piece in room.truth.objects)
    assert room.bodies.person.unique().tolist() == [0, 1]
