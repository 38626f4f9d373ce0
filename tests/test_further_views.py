"""Further frames of a moving camera count in the image terms, by their own cameras and masks."""

from dataclasses import replace

import pytest
import torch
from analytic import GROUND
from test_refine_camera import larger_room, view_from

from mover.core.types import Layout
from mover.energy.config import Adam, SceneConfig, SceneWeights, only
from mover.energy.fused.energy import energy_function, energy_of_rows
from mover.energy.objective import HumanCues
from mover.pipeline.further_views import larger_views, with_views
from mover.pipeline.presets import ROBUST
from mover.stages.camera.refine_camera import RefineInputs, moved_view, refine_camera
from mover.stages.config import RefineConfig
from mover.stages.objects.place_inputs import PlaceInputs, coarser_image
from mover.stages.objects.place_objects import place_objects
from mover.stages.objects.starts import alone

PLACES = (([0.8, 0.0, 0.1], -0.2), ([-0.7, 0.05, 0.0], 0.17))
ALL = SceneConfig(SceneWeights(bbox=1.0, silhouette=2.0, scale=0.3), "robust")
SEEN = SceneConfig(only(bbox=1.0, silhouette=2.0), "robust")


def seen_twice(factor: float = 1.0) -> tuple[Layout, RefineInputs]:
    objects, true, start = larger_room(factor)
    views = tuple(view_from(p, turn, objects, true, start.camera) for p, turn in PLACES)
    return true, replace(start, views=views)


def test_the_energy_is_the_reference_images_and_the_mean_of_what_each_view_would_say_as_one():
    true, start = seen_twice()
    objects, camera, image, nobody = start.objects, start.camera, start.image, HumanCues()
    layout = alone(replace(true, yaw=true.yaw + 0.1, log_scale=true.log_scale + 0.05))
    whole = energy_function(objects, camera, with_views(image, start.views), nobody, ALL)(layout)
    one = energy_function(objects, camera, image, nobody, ALL)(layout)
    assert torch.equal(
        energy_function(objects, camera, with_views(image, ()), nobody, ALL)(layout).per_item,
        one.per_item,
    )
    wanted = one.per_item.clone()
    for view in start.views:
        R = view.R_reference_camera.mT @ camera.R_cam_world
        place = camera.R_cam_world.mT @ view.t_reference_camera
        there = replace(layout, t_world_object=layout.t_world_object - place)
        seen = replace(camera, R_cam_world=R)
        alike = with_views(image, (view,)).further[0].image
        wanted += energy_function(objects, seen, alike, nobody, SEEN)(there).per_item / 2
    assert torch.allclose(whole.per_item, wanted, atol=1e-6)
    assert torch.allclose(sum(whole.parts.values()), whole.per_item, atol=1e-5)
    assert set(whole.parts) == set(one.parts)


def test_rows_of_objects_are_those_of_all_and_what_a_view_does_not_show_counts_once():
    true, start = seen_twice()
    objects, camera, n = start.objects, start.camera, len(start.objects.ids)
    first, second = start.views
    blind = torch.arange(n) == 1
    keep = second.image.keep & ~blind[:, None, None]
    second = replace(second, image=replace(second.image, keep=keep))
    image = with_views(start.image, (first, second))
    starts = alone(replace(true, yaw=true.yaw + 0.2))
    energies = energy_of_rows(objects, camera, image, HumanCues(), ALL)
    rows = torch.tensor([2, 0])
    some = Layout(*(getattr(starts, k)[0, rows] for k in ("t_world_object", "yaw", "log_scale")))
    whole = energies(None)(starts).per_item
    assert torch.allclose(energies(rows)(some).per_item, whole[0, rows], atol=1e-6)
    alone_ = with_views(start.image, (first,))
    by_one = energy_function(objects, camera, alone_, HumanCues(), ALL)(starts).per_item
    assert float(whole[0, 1]) == pytest.approx(float(by_one[0, 1]), abs=1e-6)


def test_windows_of_fewer_pixels_are_so_in_all_views():
    _, start = seen_twice()
    small = coarser_image(with_views(start.image, start.views), 2)
    assert [v.image.masks.shape[-1] for v in small.further] == [small.masks.shape[-1]] * 2
    far = larger_views(start.views, 2.0)
    assert torch.equal(far[0].t_reference_camera, 2 * start.views[0].t_reference_camera)


@pytest.mark.slow
def test_parallax_brings_back_what_the_reference_image_sees_as_well_farther_away():
    true, start = seen_twice(1.06)
    method = replace(ROBUST.layout, yaws=1, short=Adam(0))

    def placed(image):
        inputs = PlaceInputs(
            start.objects, start.camera, 1.03 * GROUND, image, HumanCues(), alone(start.layout),
            start.layout.yaw,
        )  # fmt: skip
        found = place_objects(inputs, method).layout
        return (found.t_world_object - true.t_world_object)[:, [0, 2]].norm(dim=-1).mean()

    assert placed(with_views(start.image, start.views)) < 0.75 * placed(start.image)


@pytest.mark.slow
def test_views_whose_cameras_are_given_too_low_are_put_right_and_do_not_bend_the_room():
    _, start = seen_twice()
    low = torch.tensor([0.0, 0, 0, 0, 0.015, 0])
    given = replace(start, views=tuple(moved_view(view, low) for view in start.views))
    free, rigid = (refine_camera(given, RefineConfig(rounds=1, path=w)) for w in (0.3, 1e7))
    assert abs(free.ground - GROUND) < 0.5 * abs(rigid.ground - GROUND)
    for view, true in zip(free.views, start.views, strict=True):
        assert (view.t_reference_camera - true.t_reference_camera).norm() < 0.4 * 0.015
