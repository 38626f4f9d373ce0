"""Soles at rest: still and on the floor, with nothing else moved more than it must."""

import math
from dataclasses import replace

import pytest
import torch
from figures import ARMS_DOWN, SEATED, STRIDE
from furnished import bodies_of, moving_pose
from test_refine_bodies import GROUND, still_people

from mover.bodies.corrected import corrected, no_correction, puppet_of
from mover.bodies.parts import members, parts_of
from mover.core.types import Bodies
from mover.stages.people.plant_feet import plant_feet

COUNT = 12


def shaken(truth: Bodies, place: float, angle: float, seed: int = 0) -> Bodies:
    """Bodies off their place, and their angles off, again in each frame [m], [rad]."""
    rng = torch.Generator().manual_seed(seed)
    by = no_correction(puppet_of(truth, torch.arange(3)))
    size = by.angles.shape
    return corrected(truth, replace(
        by, shift=place * torch.randn(len(truth.frame), 3, generator=rng),
        angles=angle * torch.randn(size, generator=rng),
    ))  # fmt: skip


def planted(bodies: Bodies) -> Bodies:
    return plant_feet(bodies, parts_of(bodies), GROUND)


def soles_of(bodies: Bodies) -> torch.Tensor:
    """Middle of each sole at the height of its lowest point (bodies, 2, 3) [m]."""
    found = []
    for name in ("left_sole", "right_sole"):
        x, y, z = bodies.verts[:, members(parts_of(bodies), name)].unbind(-1)
        found.append(torch.stack([x.mean(1), y.amin(1), z.mean(1)], -1))
    return torch.stack(found, 1)


def skate(bodies: Bodies) -> float:
    """Mean speed of the slower sole, the nearer to the floor the more it counts (HuMoR) [m/s]."""
    soles = soles_of(bodies)
    height = ((soles[1:] + soles[:-1])[..., 1] / 2 - GROUND).clamp_min(0)
    share = 2 - 2 ** (height / 0.1).clamp(0, 1)
    speed = bodies.fps * (soles[1:] - soles[:-1])[..., [0, 2]].norm(dim=-1)
    slower = speed.argmin(1, keepdim=True)
    share, speed = share.gather(1, slower), speed.gather(1, slower)
    return float((share * speed).sum() / share.sum())


def miss(bodies: Bodies, truth: Bodies) -> float:
    return float((bodies.joints - truth.joints).norm(dim=-1).mean())


@pytest.mark.parametrize("posture", [ARMS_DOWN, SEATED])
def test_feet_of_shaken_people_stand_still_on_the_floor_and_joints_are_no_worse(posture):
    truth = still_people(posture, COUNT)
    given = shaken(truth, 0.02, 0.04)
    found = planted(given)
    assert skate(found) < 0.25 * skate(given)
    assert miss(found, truth) < miss(given, truth)
    low = found.verts[..., 1].amin(1) - GROUND
    before = given.verts[..., 1].amin(1) - GROUND
    assert float(low.abs().mean()) < 0.5 * float(before.abs().mean())


def test_legs_bend_where_only_angles_are_off():
    truth = still_people(ARMS_DOWN, COUNT)
    given = shaken(truth, 0.0, 0.05)
    found = planted(given)
    assert skate(found) < 0.25 * skate(given)
    hips = truth.joint_names.index("pelvis")
    assert float((found.joints - given.joints)[:, hips].norm(dim=-1).max()) < 0.05
    assert not torch.equal(found.pose.body_pose, given.pose.body_pose)
    names = ("left_wrist", "head", "spine2")
    upper = [truth.joint_names.index(name) - 1 for name in names]
    changed = (found.pose.body_pose - given.pose.body_pose).reshape(COUNT, -1, 3)
    assert float(changed[:, upper].abs().max()) == 0.0


def test_meshes_agree_with_the_parameters_that_are_given_back():
    found = planted(shaken(still_people(ARMS_DOWN, 5), 0.02, 0.04))
    again = corrected(found, no_correction(puppet_of(found, torch.arange(3))))
    assert torch.allclose(again.verts, found.verts, atol=1e-5)


def test_bare_meshes_are_shifted_as_a_whole():
    given = replace(shaken(still_people(ARMS_DOWN, COUNT), 0.02, 0.0), pose=None)
    found = planted(given)
    moved = found.verts - given.verts
    assert float((moved - moved[:, :1]).abs().max()) < 1e-5
    assert skate(found) < 0.4 * skate(given)


@pytest.mark.parametrize(
    ("lift", "least", "most"),
    [(0.0, -0.006, 0.006), (-0.05, -0.01, 0.01), (0.05, -0.01, 0.02), (0.4, 0.39, 0.41)],
)
def test_feet_near_the_floor_come_to_it_and_one_on_a_stool_is_not_drawn_down(lift, least, most):
    given = still_people(ARMS_DOWN, 6, lift=lift)
    found = planted(given)
    low = soles_of(found)[..., 1].amin(1) - GROUND
    assert least < float(low.min())
    assert float(low.clamp_min(0).mean() if lift == 0.05 else low.max()) < most
    if lift == 0:
        assert float((found.verts - given.verts).norm(dim=-1).max()) < 0.006
    if lift == 0.4:
        assert float((found.verts - given.verts)[..., 1].abs().max()) < 0.01


def test_a_person_carried_along_has_no_foot_at_rest():
    still = still_people(STRIDE, COUNT)
    by = no_correction(puppet_of(still, torch.arange(3)))
    way = 0.3 * torch.arange(COUNT).float()[:, None] * torch.tensor([1.0, 0, 0])
    given = corrected(still, replace(by, shift=way))
    assert float((planted(given).verts - given.verts).norm(dim=-1).max()) < 0.02


def test_unordered_images_come_back_as_they_are():
    given = replace(still_people(ARMS_DOWN, 4), fps=None)
    assert planted(given) is given


def test_two_people_do_not_hold_each_other():
    one, other = (
        shaken(still_people(ARMS_DOWN, 6, at=at), 0.02, 0.03, s)
        for s, at in enumerate([(-1.0, -3.0), (1.0, -4.0)])
    )
    both = replace(
        one, verts=torch.cat([one.verts, other.verts]),
        joints=torch.cat([one.joints, other.joints]),
        frame=torch.cat([one.frame, other.frame]),
        person=torch.cat([one.person, other.person + 1]),
        pose=replace(one.pose, **{
            name: torch.cat([getattr(one.pose, name), getattr(other.pose, name)])
            for name in ("betas", "global_orient", "body_pose", "transl")
        }, extra={k: torch.cat([v, other.pose.extra[k]]) for k, v in one.pose.extra.items()}),
    )  # fmt: skip
    alone = planted(one).verts
    assert torch.allclose(planted(both).verts[:6], alone, atol=2e-4)


def test_swinging_people_keep_their_swing():
    """A body that swings all its joints has no still sole: nothing holds it."""
    given = bodies_of(moving_pose(20))
    low = float(given.verts[..., 1].amin())
    found = plant_feet(given, parts_of(given), low)
    assert float((found.verts - given.verts).norm(dim=-1).mean()) < 0.05
    assert math.isfinite(float(found.verts.sum()))
    assert members(parts_of(given), "left_sole").any()
