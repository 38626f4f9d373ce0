from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from analytic import FACES, box_verts
from figures import ARMS_DOWN, ARMS_UP, SEATED, STRIDE, people, pose, turned

from mover.bodies.parts import PARTS, members, parts_of
from mover.bodies.skeleton import BODY
from mover.bodies.skinning import open_body, zero_pose
from mover.core.types import Bodies
from mover.geometry.mesh import vertex_normals

SHARED = Path(__file__).parents[2] / "shared" / "data"
ASSETS = Path(__file__).parents[1] / "src" / "mover" / "bodies" / "assets"
POSTURES = {"tpose": {}, "stand": ARMS_DOWN, "seated": SEATED, "walk": STRIDE, "up": ARMS_UP}


def unknown(base, seed=0):
    """The same people with joints by name and shuffled vertices: no model has this topology."""
    bodies, model = people(base), open_body()
    order = torch.randperm(bodies.verts.shape[1], generator=torch.Generator().manual_seed(seed))
    verts, joints = model.posed(base)
    hidden = replace(
        bodies, verts=bodies.verts[:, order], faces=torch.argsort(order)[bodies.faces], pose=None,
        joints=(joints + (bodies.verts - verts)[:, :1])[:, :22], joint_names=BODY,
    )  # fmt: skip
    true = parts_of(bodies)
    return hidden, replace(true, part_of=true.part_of[order])


def upright(detail):
    """The open body in its T-pose, its pelvis at the origin."""
    model = open_body(detail)
    verts = model.posed(zero_pose(1, model))[0]
    return replace(people(zero_pose(1, model)), verts=verts, faces=model.faces)


def overlap(a, b) -> float:
    return float((a & b).sum() / (a | b).sum())


def centres(bodies, parts):
    return {p: bodies.verts[0, members(parts, p)].mean(0) for p in PARTS}


@pytest.mark.parametrize("detail", ["small", "full"])
def test_every_part_is_there_and_left_mirrors_right(detail):
    bodies = upright(detail)
    parts = parts_of(bodies)
    middle = centres(bodies, parts)
    for name in PARTS:
        assert members(parts, name).sum() > 20
        if name.startswith("left"):
            mirror = middle[name.replace("left", "right")] * torch.tensor([-1.0, 1, 1])
            torch.testing.assert_close(middle[name], mirror, atol=0.02, rtol=0)
            assert middle[name][0] > 0.05


def test_parts_face_where_they_should():
    model = open_body()
    verts, _ = model.posed(zero_pose(1, model))
    bodies = people(zero_pose(1, model))
    parts, normals = parts_of(bodies), vertex_normals(verts, model.faces)[0]
    facing = {p: normals[members(parts, p)].mean(0) for p in PARTS}
    for name in ("left_sole", "right_palm", "left_forearm"):
        assert facing[name][1] < -0.6
    for name in ("seat", "back", "right_thigh"):
        assert facing[name][2] < -0.5
    height = {p: c[1] for p, c in centres(bodies, parts).items()}
    assert height["left_sole"] < 0.02
    assert height["left_thigh"] < height["seat"] < height["back"] < height["left_palm"]


@pytest.mark.parametrize("name", ["open_body.npz", "open_body_small.npz"])
def test_seat_from_skinning_weights_is_where_the_artists_put_the_buttocks(name):
    with np.load(ASSETS / name) as data:
        true = torch.from_numpy(data["buttocks"])
    seat = members(parts_of(upright("small" if "small" in name else "full")), "seat")
    assert (seat & true).sum() / seat.sum() > 0.8
    assert overlap(seat, true) > 0.55


def test_seat_is_what_a_sitter_sits_on():
    bodies = people(pose(SEATED))
    model = open_body()
    upper = [model.joint_names.index(n) for n in ("pelvis", "left_hip", "right_hip")]
    trunk = torch.isin(model.weights.argmax(1), torch.tensor(upper))
    height = torch.where(trunk, bodies.verts[0, :, 1], torch.inf)
    lowest = height.topk(40, largest=False).indices
    carried = members(parts_of(bodies), "seat", "left_thigh", "right_thigh")
    assert carried[lowest].float().mean() > 0.9


@pytest.mark.parametrize("name", POSTURES)
def test_parts_of_an_unknown_mesh_are_those_of_the_body_it_is(name):
    base = turned(pose(POSTURES[name]), 0.4, -2.0, 0.3)
    base = replace(base, betas=torch.tensor([[0.8, -0.5, 1.0, 0.3]]))
    bodies, true = unknown(base)
    found = parts_of(bodies)
    least = {"sole": 0.7, "seat": 0.6, "back": 0.7, "thigh": 0.5, "palm": 0.6, "forearm": 0.5}
    for part in PARTS:
        score = overlap(members(found, part), members(true, part))
        assert score > least[part.split("_")[-1]], (part, score)


def test_of_a_statue_on_a_block_only_the_lowest_faces_are_soles(caplog):
    corners = box_verts((1.0, 0.1, 1.0)).float()
    block = replace(people(pose({})), verts=corners[None], faces=FACES, pose=None)
    found = parts_of(block)
    assert "unknown topology and no joints" in caplog.text
    assert found.rings.numel() == 0
    assert (found.part_of[corners[:, 1] > 0] == -1).all()


@pytest.mark.skipif(not SHARED.exists(), reason="the shared data are not here")
def test_dancer_in_a_photograph_stands_on_the_soles_that_are_found():
    with np.load(SHARED / "photo_bench" / "bodies.npz") as data:
        verts, faces = torch.from_numpy(data["vertices"]), torch.from_numpy(data["faces"]).long()
    zero = torch.zeros(1, dtype=torch.long)
    bodies = Bodies(verts, faces, None, (), zero, zero, None, "camera", None)
    parts = parts_of(bodies, torch.tensor([0.0, -1.0, 0.0]))
    height = -verts[0, :, 1]
    assert parts.rings.numel() > 0  # by the lists of this topology
    for side in ("left", "right"):
        sole = members(parts, f"{side}_sole")
        assert 250 < sole.sum() < 600
        ground = height[sole].min() - height.min()
        assert ground < 0.15  # one foot is off the ground, heel first
    assert height[members(parts, "seat")].mean() < height[members(parts, "back")].mean()


@pytest.mark.skipif(not SHARED.exists(), reason="the shared data are not here")
@pytest.mark.parametrize("row", range(8))
def test_left_and_right_of_real_poses_are_not_confused(row):
    angles = torch.from_numpy(np.load(SHARED / "sam3d_body" / "example_smplx_poses.npy")[row])
    base = replace(pose({}), body_pose=angles[None, 3:66], global_orient=angles[None, :3])
    bodies, true = unknown(base)
    found = parts_of(bodies)
    for part in ("left_sole", "right_sole", "seat", "back"):
        assert overlap(members(found, part), members(true, part)) > 0.45, part
