"""Masks that are too wide or too narrow all round: what they cost, and where objects end."""

from dataclasses import fields, replace

import pytest
import torch
from analytic import GROUND, make_inputs, several, walls_at
from test_fused import agree, rest_of, room

from mover.core.types import Layout
from mover.energy.config import Adam, SceneConfig, SceneWeights
from mover.energy.fused.energy import energy_function
from mover.energy.image_terms import (
    BORDER_WEIGHT,
    SEEN,
    bbox_term,
    borders_of,
    fit_borders,
    silhouette_term,
)
from mover.energy.objective import HumanCues, best_borders, of_objects, scene_energy, some_objects
from mover.geometry.camera import to_camera
from mover.geometry.placement import place
from mover.geometry.raster import Crops, Topology, look
from mover.pipeline.presets import ROBUST
from mover.stages.camera.refine_camera import fixed_borders
from mover.stages.config import ImageConfig
from mover.stages.objects.find_image_cues import ImageInputs, find_image_cues
from mover.stages.objects.place_inputs import PlaceInputs, coarser_image
from mover.stages.objects.place_objects import place_objects

SHIFTS = (-1.5, -1.0, -0.5, 0.0, 0.5, 1.0, 1.5)
WEIGHTS = SceneWeights(1.0, 1.0, 0.3, 0.0, 0.0, 0.0)
ROBUSTLY = SceneConfig(WEIGHTS, "robust")


def rectangle(grow: int, size: int = 64) -> torch.Tensor:
    """A mask from 20 to 50 and 15 to 40, grown."""
    mask = torch.zeros(1, size, size)
    mask[:, 15 - grow : 40 + grow, 20 - grow : 50 + grow] = 1
    return mask


def box_of(grow: int) -> torch.Tensor:
    return torch.tensor([[20.0 - grow, 15 - grow, 50 + grow, 40 + grow]])


def loosened(inputs, shifts=SHIFTS):
    """The inputs with masks whose borders are free."""
    image = inputs.image
    zoom = image.views.K[:, 0, 0] / inputs.camera.K[0, 0]
    return replace(inputs, image=replace(image, borders=borders_of(image.masks, zoom, shifts)))


class TestMasks:
    @pytest.mark.parametrize("zoom", [0.5, 1.0, 2.0])
    @pytest.mark.parametrize("shift", SHIFTS)
    def test_a_straight_outline_moves_by_the_shift_in_pixels_of_the_image(self, zoom, shift):
        column = torch.arange(32.0) + 0.5
        half = (column < 16).float().expand(1, 32, 32)
        found = borders_of(half, torch.tensor([zoom]), (shift,)).masks[0]
        exact = (16 + shift * zoom - column + 0.5).clamp(0, 1).expand(1, 32, 32)
        torch.testing.assert_close(found, exact, rtol=0, atol=1e-6)

    def test_far_out_corners_are_round(self):
        found = borders_of(rectangle(0), torch.ones(1), (6.0,)).masks[0, 0]
        y, x = (torch.arange(64.0) + 0.5 for _ in range(2))
        out_y = (15.5 - y).clamp_min(0) + (y - 39.5).clamp_min(0)
        out_x = (20.5 - x).clamp_min(0) + (x - 49.5).clamp_min(0)
        away = torch.hypot(out_y[:, None], out_x[None])
        assert (found[away < 6] == 1).all()
        assert (found[away > 7] == 0).all()

    def test_more_shift_is_nowhere_less_mask_and_no_shift_is_the_mask_itself(self):
        masks = torch.nn.functional.avg_pool2d(make_inputs(size=64).image.masks, 3, 1, 1)
        found = borders_of(masks, torch.tensor([0.6, 1.1, 2.0]), SHIFTS)
        assert torch.equal(found.masks[3], masks)
        others = found.masks[[0, 1, 2, 4, 5, 6]]
        assert (others.diff(dim=0) >= 0).all()

    def test_an_object_without_a_mask_has_none_under_any_shift(self):
        found = borders_of(torch.zeros(2, 8, 8), torch.ones(2), SHIFTS)
        assert not found.masks.any()
        assert borders_of(torch.zeros(0, 8, 8), torch.ones(0), SHIFTS).masks.shape == (7, 0, 8, 8)


class TestTerm:
    @pytest.mark.parametrize("grow", [-1, 1])
    def test_a_mask_one_pixel_off_all_round_costs_only_its_shift(self, grow):
        seen = box_of(grow), torch.full((1, 4), SEEN), torch.ones(1, 64, 64).bool()
        drawn = rectangle(0), box_of(0).view(1, 2, 2)
        borders = borders_of(rectangle(grow), torch.ones(1), SHIFTS)
        found = fit_borders(*drawn, *seen, torch.ones(1), borders, (1.0, 1.0))
        assert borders.shifts[found.shift].tolist() == [-grow]
        assert float(found.bbox) == pytest.approx(0.0, abs=1e-7)
        assert float(found.silhouette) == pytest.approx(BORDER_WEIGHT, rel=1e-6)

    def test_each_start_and_object_takes_its_least_cost(self):
        inputs = loosened(make_inputs(size=64))
        layout = several(inputs.starts, 4)
        image = inputs.image
        found = scene_energy(layout, *rest_of(inputs), ROBUSTLY).parts
        number = best_borders(layout, inputs.objects, inputs.camera, image, WEIGHTS)
        each = []
        for shift, mask in zip(image.borders.shifts, image.borders.masks, strict=True):
            one = replace(image, masks=mask, borders=None)
            rest = inputs.objects, inputs.camera, one, HumanCues()
            cost = scene_energy(layout, *rest, ROBUSTLY).parts["silhouette"]
            each.append(cost + BORDER_WEIGHT * shift**2)
        silhouettes = torch.stack(each)
        picked = silhouettes.gather(0, number[None])[0]
        torch.testing.assert_close(found["silhouette"], picked, rtol=1e-5, atol=1e-6)
        assert len(number.unique()) > 1

    def test_the_fit_is_the_sum_of_the_two_terms_of_one_shift(self):
        inputs = make_inputs(size=48)
        keep, sides = inputs.image.keep, inputs.image.sides
        image, trust = inputs.image, torch.tensor([0.3, 1.0, 0.6])
        verts = torch.rand(2, 3, 8, 2, generator=torch.Generator().manual_seed(3)) * 300
        drawn = image.masks.roll(2, -1).repeat(2, 1, 1, 1)
        borders = borders_of(image.masks, torch.ones(3), SHIFTS)
        found = fit_borders(drawn, verts, image.boxes, sides, keep, trust, borders, (1.0, 2.0))
        for start in range(2):
            for i in range(3):
                costs = []
                for shift, mask in zip(SHIFTS, borders.masks, strict=True):
                    b = bbox_term(verts, image.boxes, sides, 1.0, "robust", shift)[start, i]
                    s = silhouette_term(drawn, mask, keep, "robust")[start, i]
                    costs.append((float(b), float(trust[i] * s + BORDER_WEIGHT * shift**2)))
                best = min(range(7), key=lambda k: costs[k][0] + 2 * costs[k][1])
                assert int(found.shift[start, i]) == best
                assert float(found.bbox[start, i]) == pytest.approx(costs[best][0], rel=1e-5)
                assert float(found.silhouette[start, i]) == pytest.approx(costs[best][1], rel=1e-5)


class TestKernel:
    @pytest.mark.parametrize(("size", "amount"), [(33, 0.15), (64, 0.02), (130, 0.15)])
    def test_values_and_gradients_are_those_of_the_terms(self, size, amount):
        pytest.importorskip("warp")
        inputs = loosened(room(size))
        fast = energy_function(*rest_of(inputs), ROBUSTLY)
        layout = several(inputs.starts, 5, amount)
        assert fast(layout).whole is not None
        for terms in ((), ("bbox", "silhouette")):
            agree(fast, lambda x: scene_energy(x, *rest_of(inputs), ROBUSTLY), layout, *terms)

    def test_a_room_without_silhouettes_has_no_free_borders(self):
        pytest.importorskip("warp")
        config = SceneConfig(replace(WEIGHTS, silhouette=0.0), "robust")
        inputs = room()
        layout = several(inputs.starts)
        free, bound = (
            energy_function(*rest_of(i), config)(layout).parts["bbox"]
            for i in (loosened(inputs), inputs)
        )
        assert torch.equal(free, bound)
        slow = scene_energy(layout, *rest_of(loosened(inputs)), config).parts["bbox"]
        torch.testing.assert_close(free, slow, rtol=1e-5, atol=1e-5)


class TestParts:
    def test_coarser_windows_hold_the_same_masks_under_each_shift(self):
        inputs = loosened(make_inputs(size=64))
        image = replace(inputs.image, walls=walls_at(inputs.objects, inputs.starts[0]))
        small = coarser_image(image, 4)
        same = small.borders.masks[SHIFTS.index(0.0)]
        torch.testing.assert_close(same, small.masks, rtol=0, atol=1e-6)
        torch.testing.assert_close(
            16 * small.borders.masks.sum((-2, -1)), image.borders.masks.sum((-2, -1))
        )
        assert torch.equal(small.borders.shifts, image.borders.shifts)
        with pytest.raises(ValueError, match="which 5 does not divide"):
            coarser_image(image, 5)
        assert small.walls is image.walls

    def test_rows_of_starts_and_objects_cost_what_the_whole_costs(self):
        inputs = loosened(make_inputs(size=48))
        layout = several(inputs.starts, 3, 0.05)
        rows = torch.tensor([7, 2, 3, 3])
        index = rows % 3
        few = Layout(*(getattr(layout, f.name).flatten(0, 1)[rows] for f in fields(Layout)))
        objects, image = some_objects(inputs.objects, rows), of_objects(inputs.image, index, 3)
        found = scene_energy(few, objects, inputs.camera, image, HumanCues(), ROBUSTLY)
        whole = scene_energy(layout, inputs.objects, inputs.camera, inputs.image, HumanCues(),
                             ROBUSTLY)  # fmt: skip
        torch.testing.assert_close(found.per_item, whole.per_item.flatten()[rows])


class TestFixed:
    def test_masks_and_boxes_are_those_of_the_best_shift(self):
        inputs = loosened(make_inputs(size=64))
        one = inputs.starts[0]
        sizes = torch.tensor([-0.04, 0.0, 0.04])[:, None].expand(-1, 3)
        one = replace(one, log_scale=sizes.contiguous())
        image = inputs.image
        number = best_borders(one, inputs.objects, inputs.camera, image, WEIGHTS)
        found = fixed_borders(image, one, inputs.objects, inputs.camera, WEIGHTS)
        assert found.borders is None
        shifts = image.borders.shifts[number]
        assert shifts[0] < 0
        assert shifts[1] == 0
        assert shifts[2] > 0
        for i, k in enumerate(number.tolist()):
            assert torch.equal(found.masks[i], image.borders.masks[k, i])
            out = torch.tensor([-1.0, -1, 1, 1]) * SHIFTS[k]
            assert torch.equal(found.boxes[i], image.boxes[i] + out)
        for name in ("sides", "keep", "trust"):
            assert getattr(found, name) is getattr(image, name)

    def test_masks_without_freedom_stay_as_they_are(self):
        inputs = make_inputs(size=32)
        one = inputs.starts[0]
        image = inputs.image
        assert fixed_borders(image, one, inputs.objects, inputs.camera, WEIGHTS) is image


def seen_room(grow):
    """The cabinet of the analytic room under a mask too wide or narrow, its base hidden."""
    inputs = make_inputs()
    cabinet = some_objects(inputs.objects, torch.tensor([2]))
    true = Layout(*(getattr(inputs.starts, f.name)[0, 2:] for f in fields(Layout)))
    camera = inputs.camera
    verts = to_camera(place(cabinet.verts, true), camera.R_cam_world)
    views = Crops(camera.K[None], camera.height, camera.width)
    drawn, _ = look(verts, Topology(cabinet.faces, cabinet.edges), views, depth=False)
    mask = drawn[0] > 0.5
    grown = torch.nn.functional.max_pool2d(grow * mask.float()[None, None], 3, 1, 1)[0, 0]
    mask = grown > 0 if grow > 0 else grown < 0
    people, rows = torch.zeros_like(mask), torch.nonzero(mask.any(1))[:, 0]
    people[int(rows[0]) + len(rows) * 2 // 3 :] = True
    mask = mask & ~people
    ends = [torch.nonzero(mask.any(axis))[:, 0] for axis in (0, 1)]
    box = [float(e[0]) for e in ends] + [float(e[-1]) + 1 for e in ends]
    seen = ImageInputs(
        camera, torch.tensor([box]), torch.ones(1).bool(), mask[None], people,
        torch.zeros(1, 1).bool(),
    )  # fmt: skip
    room = replace(
        inputs, objects=cabinet, starts=true[None], humans=HumanCues(), reference=true.yaw,
        image=of_objects(inputs.image, torch.tensor([2]), 3),
    )  # fmt: skip
    return room, lambda config: find_image_cues(seen, config)


@pytest.mark.parametrize("grow", [-1, 1])
def test_an_object_whose_base_is_hidden_is_placed_nearer_to_the_truth_if_borders_are_free(grow):
    inputs, cues = seen_room(grow)
    config = replace(
        ROBUST.layout, weights=WEIGHTS, method=Adam(120, 0.03, 0.002, beta2=0.98, keep_best=True),
        yaws=1, short=Adam(0), num_hypotheses=1,
    )  # fmt: skip
    true = inputs.starts.t_world_object[0]

    def error(borders):
        image = cues(ImageConfig(128, "robust", borders=borders))
        room = PlaceInputs(
            inputs.objects, inputs.camera, GROUND, image, HumanCues(), inputs.starts,
            inputs.starts.yaw[0],
        )  # fmt: skip
        found = place_objects(room, config).layout
        return float((found.t_world_object - true).norm())

    free, bound = error(SHIFTS), error(())
    assert free < bound
