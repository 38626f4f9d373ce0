"""Every term of Eq. 1: non-negative, zero at the truth, right gradient, starts independent; and the
preset `paper` against naive loops over its printed formulas."""

import itertools
from dataclasses import fields, replace

import numpy as np
import pytest
import torch
from analytic import GROUND, SIZES, make_inputs, moved, walls_at
from hypothesis import given, settings
from hypothesis import strategies as st

from mover.core.types import Layout
from mover.energy.config import SceneWeights
from mover.geometry.camera import to_camera
from mover.geometry.placement import place, rest_on_support
from mover.geometry.raster import Topology, look
from mover.stages.config import PlaceConfig
from mover.stages.objects.place_inputs import with_walls
from mover.stages.objects.place_objects import energy_of

TERMS = [f.name for f in fields(SceneWeights)]
ONLY = {t: SceneWeights(**{n: float(n == t) for n in TERMS}) for t in TERMS}
FORMS = ("paper", "robust")


def energy(inputs, layout, term, form="paper"):
    walls = walls_at(inputs.objects, inputs.starts[0])
    return energy_of(with_walls(inputs, walls), PlaceConfig(ONLY[term], form))(layout)


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("term", TERMS)
class TestEveryTerm:
    def test_is_zero_at_the_truth(self, term, form):
        inputs = make_inputs(torch.float64)
        assert float(energy(inputs, inputs.starts, term, form).total.abs()) < 1e-9

    @given(seed=st.integers(0, 2**20))
    @settings(max_examples=5, deadline=None)
    def test_is_never_negative(self, term, form, seed):
        inputs = make_inputs(size=32)
        layout = moved(inputs.starts, seed, 0.3)
        assert (energy(inputs, layout, term, form).per_item >= -1e-6).all()

    def test_gradient_equals_finite_differences(self, term, form):
        """Silhouettes of exact contours are piecewise smooth: they have their own test."""
        if term == "silhouette":
            pytest.skip("see test_raster.py")
        inputs = make_inputs(torch.float64, size=24)
        at = moved(inputs.starts, 4, 0.05)
        free = [getattr(at, f.name).requires_grad_() for f in fields(Layout)]

        def total(*tensors):
            return energy(inputs, Layout(*tensors), term, form).total

        torch.autograd.gradcheck(total, free, eps=1e-7, atol=2e-4, rtol=2e-3)


class TestPaperAsPrinted:
    """Naive loops over the supplement's and Sec. 3.1's formulas."""

    inputs = make_inputs(torch.float64, size=64)

    def at(self, seed=3):
        layout = moved(self.inputs.starts, seed, 0.15)
        objects = self.inputs.objects
        return rest_on_support(layout, objects.supports, objects.size[:, 1], GROUND)

    def value(self, term, layout):
        return energy(self.inputs, layout, term).per_item[0].numpy()

    def placed(self, points, layout, i):
        c, s = np.cos(float(layout.yaw[0, i])), np.sin(float(layout.yaw[0, i]))
        turn = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
        points = points * np.exp(layout.log_scale[0, i].numpy())
        return points @ turn.T + layout.t_world_object[0, i].numpy()

    def test_bbox(self):
        layout, camera = self.at(), self.inputs.camera
        for i, found in enumerate(self.value("bbox", layout)):
            unit = np.array(list(itertools.product((-0.5, 0.5), (0.0, 1.0), (-0.5, 0.5))))
            cam = self.placed(unit * SIZES[i], layout, i) @ camera.R_cam_world.numpy().T
            u = 500 * cam[:, 0] / cam[:, 2] + 320
            v = 500 * cam[:, 1] / cam[:, 2] + 180
            box = self.inputs.image.boxes[i].numpy()
            want = abs(u.min() - box[0]) + abs(v.min() - box[1])
            want += abs((u.max() - u.min()) - (box[2] - box[0]))
            assert found == pytest.approx(want, rel=1e-9)

    def test_scale(self):
        layout = self.at()
        for i, found in enumerate(self.value("scale", layout)):
            s = np.exp(layout.log_scale[0, i].numpy())
            assert found == pytest.approx(np.sqrt(((s - 1) ** 2).sum()), abs=2e-6)

    def drawn(self, layout):
        objects = self.inputs.objects
        verts = to_camera(place(objects.verts, layout), self.inputs.camera.R_cam_world)
        return look(verts, Topology(objects.faces, objects.edges), self.inputs.image.views)

    def test_silhouette(self):
        layout = self.at()
        drawn = self.drawn(layout)[0][0].numpy()
        mask, keep = self.inputs.image.masks.numpy(), self.inputs.image.keep.numpy()
        for i, found in enumerate(self.value("silhouette", layout)):
            want = sum(
                (drawn[i, y, x] - mask[i, y, x]) ** 2 * keep[i, y, x]
                for y in range(64) for x in range(64)
            )  # fmt: skip
            assert found == pytest.approx(want, rel=1e-9)

    def test_depth(self):
        layout = self.at()
        seen = self.drawn(layout)[1]
        near, far = self.inputs.humans.depth.near, self.inputs.humans.depth.far
        for i, found in enumerate(self.value("depth", layout)):
            want = 0.0
            for y in range(64):
                for x in range(64):
                    if not seen.covered[0, i, y, x] or self.inputs.image.masks[i, y, x] <= 0.5:
                        continue
                    if near[i, y, x] > far[i, y, x]:
                        continue  # no range
                    d = float(seen.nearest[0, i, y, x])
                    want += max(d - float(far[i, y, x]), 0) + max(float(near[i, y, x]) - d, 0)
            assert found == pytest.approx(want * float(self.inputs.humans.depth.area[i]), rel=1e-9)

    def test_collision(self):
        layout = replace(self.at(), log_scale=self.at().log_scale + 0.45)  # tall: into the bodies
        volume = self.inputs.humans.space.volume
        total = 0.0
        for i, found in enumerate(self.value("collision", layout)):
            want, points = 0.0, self.placed(self.inputs.objects.samples[i].numpy(), layout, i)
            for p in points:
                at = (p - volume.origin.numpy()) / volume.cell
                low = np.floor(at).astype(int)
                value = 0.0
                for k in range(8):
                    step = np.array([k & 1, (k >> 1) & 1, k >> 2])
                    share = np.prod(np.where(step, at - low, 1 - (at - low)))
                    value += share * float(volume.values[tuple(low + step)])
                want += 1000 / len(points) * min(value, 0.0) ** 2
            assert found == pytest.approx(want, rel=1e-9)
            total += want
        assert total > 0


@pytest.mark.parametrize(("form", "share"), [("paper", 1.0), ("robust", 0.1)])
def test_collision_spares_used_seats_in_the_robust_form_alone(form, share):
    inputs = make_inputs(torch.float64)
    seats = torch.tensor([True, False, False])
    inputs = replace(inputs, objects=replace(inputs.objects, is_seat=seats))
    weights = replace(ONLY["collision"], contact=1.0)
    high = torch.tensor([[0, 1.8, 0], [0, 1.8, 0], [0, 0.6, 0]])
    tall = replace(inputs.starts, log_scale=inputs.starts.log_scale + high)
    costs = [
        energy_of(replace(inputs, humans=humans), PlaceConfig(weights, form))(tall)
        for humans in (inputs.humans, replace(inputs.humans, touches=None))
    ]
    used, plain = (cost.parts["collision"][0] for cost in costs)
    assert (plain > 0).all()
    torch.testing.assert_close(used, plain * torch.tensor([share, 1.0, 1.0]).double())
