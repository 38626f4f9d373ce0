"""Depth of people from their masks: known bodies, drawn, moved away, and brought back."""

import dataclasses
import math

import pytest
import torch
from figures import ARMS_DOWN, AT_TABLE, SEATED, STRIDE, people, pose

from mover.bodies.corrected import larger
from mover.bodies.parts import parts_of
from mover.bodies.skeleton import JOINTS
from mover.bodies.skinning import open_body
from mover.core.types import Bodies, Camera, Masks, People
from mover.geometry.camera import project, tilted
from mover.geometry.raster import Crops, layers
from mover.geometry.rle import encode
from mover.stages.config import DepthConfig
from mover.stages.cover import Cover
from mover.stages.masks import Extents
from mover.stages.people.find_depth import (
    BENT,
    COMMON,
    FULL,
    NEAR,
    SYSTEMATIC,
    DepthFactors,
    DepthInputs,
    Peak,
    apply_depth,
    find_depth,
    peak_of,
    pelvis,
)

SIZE = (360, 640)
K = torch.tensor([[520.0, 0, 320], [0, 520, 180], [0, 0, 1]])
CAMERA = Camera(K, tilted(torch.tensor(math.radians(-8)), torch.tensor(0.0)), SIZE[1], SIZE[0])
QUICK = DepthConfig(factors=13, width=160)


def film(spots, person=0):
    """Bodies in several poses at several places, in camera axes."""
    turns = (ARMS_DOWN, SEATED, STRIDE, AT_TABLE)
    verts = torch.cat([people(pose(turns[i % 4]), floor=-1.3).verts for i in range(len(spots))])
    verts = verts + torch.tensor([[x, 0.0, z] for x, z in spots])[:, None]
    rows, verts = torch.arange(len(spots)), verts @ CAMERA.R_cam_world.mT
    person = torch.full_like(rows, person)
    return Bodies(verts, open_body().faces, None, (), rows, person, 5.0, "camera", None)


def spots(n=8, seed=0):
    free = torch.rand(n, 2, generator=torch.Generator().manual_seed(seed))
    return [(float(a) * 1.6 - 0.8, -3.2 - 1.5 * float(b)) for a, b in free]


def masks_of(bodies, hidden=None, grow=0):
    views = Crops(K.expand(len(bodies.verts), 3, 3), *SIZE)
    drawn = layers(bodies.verts, bodies.faces, views).front.isfinite()
    if grow:
        grown = torch.nn.functional.max_pool2d(grow * drawn.float(), 3, 1, 1)
        drawn = grown > 0 if grow > 0 else grown < 0
    if hidden is not None:
        drawn = drawn & ~hidden
    masks = Masks(*SIZE, tuple(encode(m) for m in drawn))
    return People(masks, bodies.frame, bodies.person, {})


def moved(bodies, factor):
    return dataclasses.replace(bodies, verts=bodies.verts + (factor - 1) * pelvis(bodies)[:, None])


def inputs_of(bodies, seen, objects=()):
    keep = torch.ones(len(bodies.frame), dtype=torch.bool)
    objects = Masks(*SIZE, tuple(encode(m) for m in objects))
    return DepthInputs(bodies, parts_of(bodies), keep, seen, Cover(objects), CAMERA)


def found_factor(true, bias, **masks):
    """Of bodies that are nearer or farther than their masks show."""
    found = find_depth(inputs_of(moved(true, bias), masks_of(true, **masks)), QUICK)
    return float(found.factor[0])


def table():
    """An object that hides the legs of most people."""
    mask = torch.zeros(SIZE, dtype=torch.bool)
    mask[250:, 200:380] = True
    return mask


@pytest.mark.parametrize("bias", [1.03, 0.975])
def test_a_wrong_depth_is_found_though_objects_hide_legs(bias):
    true = film(spots())
    seen = masks_of(true, hidden=table())
    found = find_depth(inputs_of(moved(true, bias), seen, [table()]), QUICK)
    assert found.warnings == ()
    assert float(found.factor[0]) == pytest.approx(1 / bias, abs=0.004)
    back = apply_depth(moved(true, bias), found)
    assert (pelvis(back) - pelvis(true)).norm(dim=-1).max() < 0.02


def test_each_person_has_a_factor_of_its_own_and_true_bodies_stay():
    one, two = film(spots(seed=1), 3), film(spots(seed=2), 5)
    both = dataclasses.replace(
        one,
        verts=torch.cat([moved(one, 1.04).verts, two.verts]),
        frame=torch.cat([one.frame, two.frame + 100]),
        person=torch.cat([one.person, two.person]),
    )
    true = dataclasses.replace(both, verts=torch.cat([one.verts, two.verts]))
    found = find_depth(inputs_of(both, masks_of(true)), QUICK)
    assert found.person.tolist() == [3, 5]
    assert torch.allclose(found.factor, torch.tensor([1 / 1.04, 1.0]), atol=0.004)
    assert (found.spread < 0.01).all()


@pytest.mark.parametrize("grow", [-1, 0, 1])
def test_masks_that_are_too_wide_or_too_narrow_do_not_move_people(grow):
    assert found_factor(film(spots()), 1.02, grow=grow) == pytest.approx(1 / 1.02, abs=0.005)


@pytest.mark.parametrize("bias", [1.03, 0.975])
def test_people_whom_the_image_cuts_off_are_found_by_the_rest_of_them(bias):
    true = film([(x, -1.75) for x in (-0.3, 0.0, 0.3, -0.2, 0.1, 0.2)])
    assert found_factor(true, bias) == pytest.approx(1 / bias, abs=0.006)


def test_few_or_cut_off_or_hidden_people_stay_where_they_are():
    true = film(spots(2))
    few = find_depth(inputs_of(moved(true, 1.03), masks_of(true)), QUICK)
    near = film([(0.0, -0.6)] * 6)
    cut = find_depth(inputs_of(near, masks_of(near)), QUICK)
    wall = torch.ones(SIZE, dtype=torch.bool)
    wall[:130] = False
    many = film(spots())
    hidden = find_depth(inputs_of(many, masks_of(many, hidden=wall), [wall]), QUICK)
    seen = masks_of(many)
    other = dataclasses.replace(seen, person=seen.person + 1)
    without = find_depth(inputs_of(many, other), QUICK)
    for found in (few, cut, hidden, without):
        assert found.factor.tolist() == [1.0]
        assert found.spread.isinf().all()
        assert "are seen well enough" in found.warnings[0]
    assert "0 of at least 3 bodies" in without.warnings[0]


def test_frames_that_are_seen_stand_in_for_those_that_are_not():
    true = film(spots(48))
    seen = masks_of(true)
    nothing = encode(torch.zeros(SIZE, dtype=torch.bool))
    shown = {1, 6, 14, 22, 29, 35, 42, 46}
    counts = tuple(c if k in shown else nothing for k, c in enumerate(seen.masks.counts))
    seen = dataclasses.replace(seen, masks=dataclasses.replace(seen.masks, counts=counts))
    few = dataclasses.replace(QUICK, most=8)  # of 48 evenly spread ones none is shown
    found = find_depth(inputs_of(moved(true, 1.03), seen), few)
    assert found.warnings == ()
    assert float(found.factor[0]) == pytest.approx(1 / 1.03, abs=0.004)


def test_a_known_height_scales_the_person_about_the_camera():
    true = film(spots())
    standing = true.verts[0] @ CAMERA.R_cam_world
    height = float(standing[:, 1].max() - standing[:, 1].min())
    seen = dataclasses.replace(masks_of(true), heights={"0": height})
    small = dataclasses.replace(true, verts=true.verts * 0.94)
    back = apply_depth(small, find_depth(inputs_of(small, seen), QUICK))
    assert (back.verts - true.verts).norm(dim=-1).max() < 0.04
    wrong = dataclasses.replace(seen, heights={"0": 0.6})
    found = find_depth(inputs_of(small, wrong), QUICK)
    assert found.size.tolist() == [1.0]
    assert "height not used" in found.warnings[0]


def test_a_height_is_compared_with_the_shape_of_who_never_stands():
    model, seated = open_body(), pose({"left_hip": (-80, 0, 0), "right_hip": (-80, 0, 0)}, 4)
    seated = dataclasses.replace(seated, transl=torch.tensor([[0.1, 0.2, 3.0]]).repeat(4, 1))
    verts, joints = model.posed(seated)
    bodies = dataclasses.replace(
        film(spots(4)), verts=verts, joints=joints, joint_names=model.joint_names, pose=seated
    )
    tall = float(model.verts[:, 1].max() - model.verts[:, 1].min())
    for height, size in ((tall, 1.0), (1.05 * tall, 1.05)):
        seen = dataclasses.replace(masks_of(bodies), heights={"0": height})
        found = find_depth(inputs_of(bodies, seen), QUICK)
        assert float(found.size[0]) == pytest.approx(size, abs=1e-5)
        assert any("is scaled to" in text for text in found.warnings) == (size != 1)


def test_pose_and_mesh_move_together():
    model, base = open_body(), pose(STRIDE, 4)
    base = dataclasses.replace(base, transl=torch.tensor([[0.1, 0.2, 3.0]]).repeat(4, 1))
    verts, joints = model.posed(base)
    bodies = dataclasses.replace(
        film(spots(4)), verts=verts, joints=joints, joint_names=model.joint_names, pose=base,
        person=torch.tensor([2, 2, 7, 8]),
    )  # fmt: skip
    one = torch.ones(2)
    person, factor = torch.tensor([2, 7]), torch.tensor([1.05, 0.97])
    result = apply_depth(bodies, DepthFactors(person, factor, 0.01 * one, one, ()))
    again = model.posed(result.pose)
    assert torch.allclose(again[0], result.verts, atol=1e-5)
    assert torch.allclose(again[1], result.joints, atol=1e-5)
    expected = joints[:, 0] * torch.tensor([1.05, 1.05, 0.97, 1.0])[:, None]
    assert torch.allclose(result.joints[:, 0], expected, atol=1e-5)


def test_people_who_are_larger_look_the_same_and_keep_their_parameters():
    """Heights and places grow; meshes, and parameters that no model poses, are scaled."""
    walker = dataclasses.replace(
        pose(STRIDE, 2), transl=torch.tensor([[0.3, -0.2, 4.0], [-0.4, 0.1, 3.0]])
    )
    verts, joints = open_body().posed(walker)
    seen = dataclasses.replace(people(walker), verts=verts, joints=joints, joint_names=JOINTS)
    K = torch.tensor([[700.0, 0, 480], [0, 700, 270], [0, 0, 1]])
    for factor in (0.94, 1.05):
        found = larger(seen, torch.tensor([factor, 1.0]))
        assert torch.allclose(found.joints[0, 0], factor * joints[0, 0], atol=1e-5)
        tall = [float(b.verts[0, :, 1].amax() - b.verts[0, :, 1].amin()) for b in (seen, found)]
        assert tall[1] / tall[0] == pytest.approx(factor, abs=0.004)
        off = (project(found.joints[0], K) - project(joints[0], K)).norm(dim=-1)
        assert float(off[:22].max()) < 4.0  # px, at 3 m: who is taller has longer legs
        again = open_body().posed(found.pose)
        assert torch.allclose(again[0], found.verts, atol=1e-5)
        assert torch.allclose(again[1], found.joints, atol=1e-5)
        assert torch.allclose(found.verts[1], seen.verts[1], atol=1e-5)
        for bare in (
            dataclasses.replace(seen, pose=None),
            dataclasses.replace(seen, pose=dataclasses.replace(walker, model="mine")),
        ):
            mesh = larger(bare, torch.tensor([factor, 1.0]))
            assert mesh.pose is None
            assert torch.equal(mesh.verts[0], factor * seen.verts[0])
            assert torch.equal(mesh.verts[1], seen.verts[1])


class TestOverlapAndHeight:
    """The one factor of what overlaps and what heights say."""

    LOST = Peak(1.0, math.inf, FULL, ("0 of at least 3 bodies are seen well enough",))

    def observed(self, monkeypatch, peak, heights):
        module = "mover.stages.people.find_depth."
        monkeypatch.setattr(module + "_curves", lambda *_: torch.zeros(0, QUICK.factors))
        monkeypatch.setattr(module + "peak_of", lambda *_: peak)
        monkeypatch.setattr(module + "compare_extents", lambda *_: heights)
        true = film(spots(1))
        blank = Masks(*SIZE, (encode(torch.zeros(SIZE, dtype=torch.bool)),))
        found = find_depth(inputs_of(true, People(blank, true.frame, true.person, {})), QUICK)
        return float(found.factor[0]), float(found.spread[0]), found.warnings

    def test_each_counts_by_its_certainty(self, monkeypatch):
        found = self.observed(monkeypatch, Peak(1.02, 0.004, 0.1), Extents(0.99, 0.02, 9))
        near, far = (s**2 + COMMON**2 for s in (0.004, math.hypot(0.02, SYSTEMATIC)))
        assert found[0] == pytest.approx((1.02 * far + 0.99 * near) / (near + far))
        assert found[1:] == (pytest.approx((near * far / (near + far)) ** 0.5), ())

    @pytest.mark.parametrize("misfit", [0.0, BENT, 0.25, 0.4, FULL])
    def test_heights_of_people_who_do_not_fit_their_masks_count_as_too_low(
        self, monkeypatch, misfit
    ):
        lost = dataclasses.replace(self.LOST, misfit=misfit)
        found = self.observed(monkeypatch, lost, Extents(0.97, 0.004, QUICK.least))
        spread = math.hypot(0.004, SYSTEMATIC, COMMON)
        factor = pytest.approx(0.97 + NEAR * max(0, misfit - BENT))
        assert found == (factor, pytest.approx(spread), ())

    @pytest.mark.parametrize("heights", [
        None,
        Extents(0.97, 0.001, QUICK.least - 1),
        Extents(1 + 1.01 * QUICK.span, 0.001, 9),
        Extents(1 - 1.01 * QUICK.span, 0.001, 9),
        Extents(0.97, QUICK.spread, 9),
    ], ids=("none", "few", "far", "near", "uncertain"))  # fmt: skip
    def test_heights_that_say_too_little_change_nothing(self, monkeypatch, heights):
        factor, spread, warnings = self.observed(monkeypatch, Peak(1.02, 0.004, 0.1), heights)
        assert (factor, spread) == (pytest.approx(1.02), pytest.approx(math.hypot(0.004, COMMON)))
        assert warnings == ()
        factor, spread, warnings = self.observed(monkeypatch, self.LOST, heights)
        assert (factor, spread) == (1.0, math.inf)
        assert warnings == ("depth of person 0: " + self.LOST.warnings[0],)


class TestBias:
    """Errors of the pose make smaller, farther bodies overlap better."""

    def peak(self, best, at=0.02):
        """Of ten equal parabolas whose highest value is `best` at the factor 1 + `at`."""
        grid = torch.linspace(-QUICK.span, QUICK.span, QUICK.factors).double()
        curve = best - 20 * (grid - at).square()
        return peak_of(curve.expand(10, -1), QUICK)

    @pytest.mark.parametrize(
        ("best", "bias"), [(0.97, 0.0), (0.85, 0.004), (0.7, 0.01), (0.5, 0.01)]
    )
    def test_the_factor_is_smaller_by_what_the_misfit_explains_up_to_a_percent(self, best, bias):
        grid = torch.linspace(-QUICK.span, QUICK.span, QUICK.factors)
        at = float(grid[8])
        found = self.peak(best, at)
        assert found.misfit == pytest.approx(1 - best, abs=1e-6)
        assert found.factor == pytest.approx(1 + at - bias, abs=1e-6)
        assert found.warnings == ()
