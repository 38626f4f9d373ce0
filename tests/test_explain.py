"""Explanations: doubts against closed forms, evidence against the frames that gave it."""

import json
import math
import re
import sys
from dataclasses import fields, replace
from html import escape
from pathlib import Path

import pytest
import torch
from analytic import make_inputs, moved
from little_room import camera, room, walkers

from mover.app.report.page import draw_uncertainty, explanations_list
from mover.app.viewer.layers import place_ellipses
from mover.core.explanation import Alternative, Bound, Facts, Pull, TouchingBody
from mover.core.observe import Energy
from mover.core.records import load, save
from mover.energy.config import SceneWeights
from mover.energy.terms.depth import DepthRange
from mover.evaluate.calibration import (
    FORMAT,
    GROWING,
    KINDS,
    VERSION,
    Calibration,
    forms_of,
)
from mover.evaluate.explanation import (
    TERMS,
    calibrated,
    explain,
    log_rows,
    scene_fields,
    sentences_of,
    verdict_of,
    ways_of,
)
from mover.geometry.camera import pitch_roll, tilted, to_camera
from mover.geometry.crops import crop_views, sample_nearest
from mover.geometry.placement import hit_floor
from mover.geometry.raster import Depths, layers
from mover.geometry.volume import grid_around, signed_distance
from mover.geometry.volume_warp import union_bodies
from mover.io.capture.scene_file import read_scene, write_scene
from mover.pipeline.presets import ROBUST
from mover.stages.config import ExplainConfig
from mover.stages.explain.evidence import bounds_of_objects, passing_by, side_of, touching_of
from mover.stages.explain.placements import Explained, ExplainInputs, explain_placements, others_of
from mover.stages.explain.spread import (
    FLAT,
    UNKNOWN,
    bend_at,
    by_tilt,
    by_whole,
    heat_of,
    measured,
    moves_without,
    unvector,
    vector,
)
from mover.stages.masks import small_camera, small_views
from mover.stages.objects.place_inputs import Placed
from mover.stages.objects.starts import alone

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))

from calibrate_learn import SCALES, held, learn_factor, learn_share, offs, surprise, width

SIGMA = torch.tensor(UNKNOWN, dtype=torch.float64)
ALL = torch.ones(2, 7, dtype=torch.bool)


def quadratic(seed=0, objects=2):
    """Two bowls over each object whose curvatures and middles are known."""
    g = torch.Generator().manual_seed(seed)
    root = torch.randn(2, objects, 7, 7, generator=g, dtype=torch.float64)
    curve = root @ root.mT + torch.eye(7, dtype=torch.float64)
    middle = 0.1 * torch.randn(2, objects, 7, generator=g, dtype=torch.float64)

    def energy(layout):
        off = vector(layout)[..., None, :, :] - middle
        price = 0.5 * torch.einsum("...toi,toij,...toj->...to", off, curve, off)
        return Energy({"one": price[..., 0, :], "two": price[..., 1, :]})

    both = curve.sum(0)
    pull = (curve @ middle.unsqueeze(-1)).sum(0)
    lowest = torch.linalg.solve(both, pull)[..., 0]
    return energy, curve, middle, unvector(lowest)


def close(a, b, rtol=1e-6, atol=1e-9):
    torch.testing.assert_close(a, b, rtol=rtol, atol=atol)


class TestCurvature:
    def test_a_bowl_has_its_own_curvature_slope_and_value(self):
        energy, curve, middle, lowest = quadratic()
        bend = bend_at(energy, lowest)
        assert bend.terms == ("one", "two")
        close(bend.curve, curve)
        off = vector(lowest) - middle
        close(bend.slope, (curve @ off.unsqueeze(-1))[..., 0])
        close(bend.value, torch.stack(list(energy(lowest).parts.values())))
        assert bend.slope.sum(0).abs().max() < 1e-9

    def test_the_covariance_is_the_inverse_of_what_is_known(self):
        energy, curve, _, lowest = quadratic()
        heat = torch.tensor([0.5, 2.0], dtype=torch.float64)
        known = curve.sum(0) / heat[:, None, None] + torch.diag(SIGMA**-2)
        expected = torch.linalg.inv(known)
        found = measured(energy, lowest, curve.sum(0), heat, ALL)
        close(found, (1 + FLAT) * expected)

    def test_an_unknown_of_which_nothing_is_told_keeps_its_whole_spread(self):
        def energy(layout):
            return Energy({"one": 1e4 * layout.t_world_object[..., 0].square()})

        lowest = unvector(torch.zeros(2, 7, dtype=torch.float64))
        curve = bend_at(energy, lowest).curve.sum(0)
        heat = torch.ones(2, dtype=torch.float64)
        found = measured(energy, lowest, curve, heat, ALL).diagonal(dim1=1, dim2=2).sqrt()
        close(found[:, 1:], SIGMA[1:].expand(2, -1) * math.sqrt(1 + FLAT))
        assert float(found[:, 0].max()) < 0.01

    def test_what_is_not_free_has_no_doubt(self):
        energy, curve, _, lowest = quadratic()
        free = ALL.clone()
        free[:, 1] = False
        heat = torch.ones(2, dtype=torch.float64)
        found = measured(energy, lowest, curve.sum(0), heat, free)
        assert bool((found[:, 1] == 0).all() and (found[:, :, 1] == 0).all())
        rest = [0, 2, 3, 4, 5, 6]
        known = curve.sum(0)[:, rest][:, :, rest] + torch.diag(SIGMA[rest] ** -2)
        close(found[:, rest][:, :, rest], (1 + FLAT) * torch.linalg.inv(known))

    def test_a_wall_on_one_side_is_seen_though_its_curvature_at_the_result_is_zero(self):
        def energy(layout):
            z = layout.t_world_object[..., 2]
            return Energy({"far": 1e4 * (z - 0.1).relu().square()})

        lowest = unvector(torch.zeros(1, 7, dtype=torch.float64))
        heat, free = torch.ones(1, dtype=torch.float64), ALL[:1]
        curve = bend_at(energy, lowest).curve.sum(0)
        assert float(curve.abs().max()) == 0
        found = float(measured(energy, lowest, curve, heat, free)[0, 2, 2])
        open_side, wall = UNKNOWN[2] ** 2, 0.1**2
        assert abs(found - ((open_side + wall) / 2 + FLAT * open_side)) < 0.05 * open_side

    def test_without_one_of_two_bowls_an_object_goes_to_the_middle_of_the_other(self):
        energy, _, middle, lowest = quadratic()
        bend, heat = bend_at(energy, lowest), torch.tensor(1e-6, dtype=torch.float64)
        moves = moves_without(bend.slope[:, 0], bend.curve[:, 0], heat, ALL[0])
        close(moves, middle.flip(0)[:, 0] - vector(lowest)[0], rtol=1e-3, atol=1e-5)

    def test_the_doubt_of_the_camera_moves_objects_along_their_rays(self):
        base = torch.tensor([[0.4, -1.4, -3.0], [-1.0, -1.4, -4.5]], dtype=torch.float64)
        rows = torch.cat([base, torch.zeros(2, 4, dtype=torch.float64)], -1)
        matrix = tilted(*torch.tensor([-0.2, 0.03], dtype=torch.float64))
        here = replace(camera(), R_cam_world=matrix)
        tilt = torch.diag(torch.tensor([1e-4, 2e-4, 4e-4], dtype=torch.float64))
        found = by_tilt(unvector(rows), here, -1.4, tilt)
        pitch, roll = pitch_roll(matrix)
        rays, expected = to_camera(base, matrix), torch.zeros(2, 3, 3, dtype=torch.float64)
        for k, variance in enumerate(tilt.diagonal()):
            step = 1e-5 * torch.eye(3, dtype=torch.float64)[k]
            ends = [
                hit_floor(rays, tilted(pitch + s * step[0], roll + s * step[1]), -1.4 + s * step[2])
                for s in (1, -1)
            ]
            slope = (ends[0] - ends[1]) / 2e-5
            expected += variance * slope[:, :, None] * slope[:, None, :]
        close(found[:, :3, :3], expected, rtol=1e-5)

    def test_the_doubt_of_scale_and_lens_moves_the_whole_room(self):
        base = torch.tensor([[0.4, -1.4, -3.0], [-1.0, -1.4, -4.5]], dtype=torch.float64)
        rows = torch.cat([base, torch.zeros(2, 4, dtype=torch.float64)], -1)
        here = replace(camera(), R_cam_world=tilted(*torch.tensor([0.0, 0.0]).double()))
        larger = by_whole(unvector(rows), here, 0.02, 0.0)
        grown = torch.cat([base, torch.zeros(2, 1), torch.ones(2, 3)], -1)
        close(larger, 0.02**2 * grown[:, :, None] * grown[:, None, :], rtol=1e-6)
        longer = by_whole(unvector(rows), here, 0.0, 0.03)
        away = torch.zeros(2, 7, dtype=torch.float64)
        away[:, 2] = base[:, 2]  # a level camera looks along -z: the picture stays, depths grow
        close(longer, 0.03**2 * away[:, :, None] * away[:, None, :], rtol=1e-6)
        both = by_whole(unvector(rows), here, 0.02, 0.03)
        close(both, larger + longer, rtol=1e-6)


class TestOthers:
    def test_alternatives_differ_and_rank_by_their_energy_and_turn(self):
        rows = torch.zeros(4, 1, 7)
        rows[:, 0, 3] = torch.tensor([0.0, 0.05, 2.0, 0.0])
        rows[3, 0, 0] = 0.6
        value = torch.tensor([[0.1], [0.1], [0.13], [0.16]])
        placed = Placed(unvector(rows[0]), unvector(rows), value, torch.zeros(0))

        def energy(layout):
            return Energy({"one": torch.where(layout.yaw.abs() > 3, 9.0, 0.1)})

        (found,) = others_of(placed, torch.zeros(1), 0.0, energy)
        heat = float(heat_of(value[0])[0])
        assert [round(a.rise * heat, 4) for a in found] == [0.03, 0.06]
        assert [float(a.place[3]) for a in found] == [2.0, 0.0]

    def test_what_looks_alike_from_behind_may_stand_turned_round(self):
        rows = torch.zeros(1, 1, 7)
        placed = Placed(unvector(rows[0]), unvector(rows), torch.tensor([[0.1]]), torch.zeros(0))

        def energy(layout):
            return Energy({"one": torch.full_like(layout.yaw, 0.1)})

        (found,) = others_of(placed, torch.zeros(1), 0.0, energy)
        assert len(found) == 1
        assert found[0].rise == pytest.approx(0)
        assert abs(float(found[0].place[3])) == pytest.approx(math.pi, abs=1e-6)


def seen_at(distance, size=64):
    """A flat thing that fills its window, so far away."""
    flat = torch.full((1, size, size), distance)
    return Depths(flat, flat, torch.ones_like(flat, dtype=torch.bool))


def maps_in_window(bodies, here, box):
    """Entry and exit of each body in one window, drawn in the image as gathering does."""
    views, window = small_views(here), crop_views(here.K, box, 0.3, 64)
    verts = to_camera(bodies.verts, here.R_cam_world)
    many = replace(views, K=views.K.expand(len(verts), 3, 3))
    drawn = layers(verts, bodies.faces, many)
    K, inf = small_camera(here).K, float("inf")
    front = torch.cat([sample_nearest(m, window, K, inf) for m in drawn.front])
    exit_ = torch.where(drawn.front.isfinite(), drawn.exit, -inf)
    return front, torch.cat([sample_nearest(m, window, K, -inf) for m in exit_]), window


class TestBounds:
    @pytest.mark.parametrize("side", ["near", "far"])
    def test_a_bound_names_the_frame_and_person_that_gave_it(self, side):
        bodies, here = walkers(8, people=2), camera()
        box = torch.tensor([[200.0, 100, 440, 300]])
        front, leave, window = maps_in_window(bodies, here, box)
        inf = torch.full_like(front[:1], float("inf"))
        near = leave.amax(0, keepdim=True) if side == "near" else -inf
        far = front.amin(0, keepdim=True) if side == "far" else inf
        depth = DepthRange(near, far, torch.ones(1))
        masks = torch.ones(1, 64, 64)
        found = bounds_of_objects(seen_at(4.0), masks, depth, window, (bodies, here))
        ((bound,),) = found
        assert bound.side == side
        row = (bodies.frame == bound.frame) & (bodies.person == bound.person)
        own = (leave if side == "near" else front)[row][0]
        kept = (near if side == "near" else far)[0]
        at_pixel = (own - bound.depth).abs() < 1e-6
        assert bool((at_pixel & ((kept - bound.depth).abs() < 1e-6)).any())
        room_left = 4.0 - bound.depth if side == "near" else bound.depth - 4.0
        assert bound.slack == pytest.approx(room_left, abs=1e-5)

    def test_an_object_held_by_one_frame_names_it(self):
        bodies, here = walkers(6, people=2), camera()
        box = torch.tensor([[0.0, 0, 640, 360]])
        for row in (2, 9):
            only = replace(
                bodies, verts=bodies.verts[row : row + 1], frame=bodies.frame[row : row + 1],
                person=bodies.person[row : row + 1],
            )  # fmt: skip
            front, _, window = maps_in_window(only, here, box)
            low = torch.full_like(front, -float("inf"))
            depth = DepthRange(low, front, torch.ones(1))
            seen = seen_at(float(front.min()) + 0.2)
            masks = torch.ones(1, 64, 64)
            ((bound,),) = bounds_of_objects(seen, masks, depth, window, (bodies, here))
            assert (bound.frame, bound.person) == (int(only.frame[0]), int(only.person[0]))
            assert bound.slack < 0

    def test_a_bound_that_no_body_gives_names_nobody(self):
        bodies, here = walkers(3), camera()
        window = crop_views(here.K, torch.tensor([[200.0, 100, 440, 300]]), 0.3, 64)
        far = torch.full((1, 64, 64), 9.0)
        low = torch.full_like(far, -float("inf"))
        depth = DepthRange(low, far, torch.ones(1))
        who = (bodies, here)
        ((bound,),) = bounds_of_objects(seen_at(8.0), torch.ones(1, 64, 64), depth, window, who)
        assert (bound.frame, bound.person) == (-1, -1)


class TestSpace:
    @pytest.mark.parametrize("turned", [False, True])
    def test_the_nearest_body_is_that_of_the_exact_distances(self, turned):
        inputs = make_inputs()
        bodies = walkers(5)
        if turned:
            bodies = replace(bodies, faces=bodies.faces.flip(-1))
        target = inputs.starts.t_world_object[0, 1] + torch.tensor([0.0, 0.5, 0.0])
        shift = target - bodies.verts[2].mean(0)
        bodies = replace(bodies, verts=bodies.verts + shift)
        flat = bodies.verts.flatten(0, 1)
        grid = grid_around(flat.amin(0), flat.amax(0), 96, 0.2)
        volume = union_bodies(bodies.verts, bodies.faces, grid)
        layout = unvector(vector(inputs.starts)[0])
        found = passing_by(inputs.objects, layout, volume, bodies)[1]
        from mover.geometry.placement import place

        samples = place(inputs.objects.samples, layout)[1]
        exact = torch.stack([signed_distance(samples, v, bodies.faces) for v in bodies.verts])
        best = int(exact.amin(1).argmin())
        assert found.distance == pytest.approx(float(exact.min()), abs=volume.cell)
        assert (found.frame, found.person) == (int(bodies.frame[best]), 0)
        assert found.side == "top"

    def test_sides_are_those_of_the_object(self):
        size = torch.tensor([1.0, 0.8, 0.5])
        points = {"left": (-0.5, 0.4, 0.1), "top": (0.1, 0.8, 0.0), "front": (0.1, 0.3, 0.25)}
        for name, point in points.items():
            assert side_of(torch.tensor(point), size) == name


class TestTouch:
    def test_times_are_told_apart_and_gaps_are_distances(self):
        inputs = make_inputs()
        layout = unvector(vector(inputs.starts)[0])
        touches = inputs.humans.touches
        lifted = replace(touches, points=touches.points + torch.tensor([0.0, 0.03, 0.0]))
        bodies = walkers(40)  # every third frame
        rows = torch.tensor([2, 3, 4, 30, 31])
        pairs = torch.stack([rows, torch.zeros_like(rows), torch.zeros_like(rows)], -1)
        found = touching_of(inputs.objects, layout, lifted, pairs, bodies)
        (one,) = found[0]
        assert (one.part, one.hand, one.person, one.bodies) == ("seat", False, 0, 5)
        assert one.frames == ((6, 12), (90, 93))
        assert one.gap == pytest.approx(0.03, abs=1e-5)
        assert found[1] == ()


def facts(**kwargs):
    place = torch.tensor([0.0, -1.4, -3.0, 0.2, 0, 0, 0], dtype=torch.float64)
    plain = Facts(
        "shelf_0",
        0.1,
        place,
        torch.diag(SIGMA**2),
        torch.zeros(7, 7, dtype=torch.float64),
        torch.zeros(7, 7, dtype=torch.float64),
        (),
        (),
        (),
        None,
        (),
        0.93,
        (),
        "ground",
        False,
    )
    return replace(plain, **kwargs)


def pull(term, tells):
    zero = torch.zeros(7, dtype=torch.float64)
    return Pull(term, 0.1, 0.5, zero, zero, tells)


class TestWords:
    def test_every_term_has_a_name(self):
        assert set(TERMS) == {f.name for f in fields(SceneWeights)}

    def test_a_far_bound_and_a_touch_are_sentences(self):
        bound = Bound("far", 2.312, 0.05, 412, 1, 30)
        touch = TouchingBody("seat", False, 0, ((120, 180), (300, 310)), 60, 0.012)
        said = sentences_of(facts(bounds=(bound,), touches=(touch,)), ())
        assert said[0].startswith("not farther than 2.31 m: frame 412, person 1 was hidden by it")
        assert "its seat touches person 0's seat in frames 120-180 and 1 more times" in said[1]
        assert "gap 1.2 cm" in said[1]
        assert "its silhouette: IoU .93" in said
        assert "stands on the floor" in said

    def test_an_object_that_only_its_size_holds_is_very_uncertain(self):
        alone_ = facts(pulls=(pull("scale", 0.6), pull("silhouette", 0.05)))
        said = verdict_of(alone_, alone_.covariance)
        assert said.startswith("distance very uncertain (±82 cm")
        assert said.endswith("nothing but its size tells it")
        seen = facts(pulls=(pull("scale", 0.2), pull("silhouette", 0.7)))
        assert "told by its silhouette (70 %) and its size (20 %)" in verdict_of(
            seen, 1e-4 * seen.covariance
        )

    def test_of_an_object_for_which_nothing_speaks_it_is_said_that_it_stayed(self):
        for word in ("given", "distance"):
            stayed = facts(pulls=(pull("scale", 0.5), pull(word, 0.4), pull("bbox", 0.05)))
            said = verdict_of(stayed, stayed.covariance)
            assert said.endswith("nothing that is seen tells it, it stays about where it was given")
        seen = facts(pulls=(pull("given", 0.4), pull("contact", 0.3)))
        said = verdict_of(seen, seen.covariance)
        assert said.endswith("told by how it was given (40 %) and touch (30 %)")

    def test_calibration_scales_spreads_by_kind_and_the_camera_by_itself(self):
        factors = {
            "distance": 2.0,
            "sideways": 0.5,
            "height": 3.0,
            "yaw": 4.0,
            "size": 1.0,
            "roll": 3.0,
        }
        place = torch.tensor([3.0, -1.4, -4.0, 0, 0, 0, 0], dtype=torch.float64)
        tilt = torch.zeros(7, 7, dtype=torch.float64)
        tilt[0, 0] = 0.01
        asked = facts(place=place, covariance=torch.eye(7, dtype=torch.float64), tilt=tilt)
        found = calibrated(asked, Calibration(factors))
        ray = torch.tensor([0.6, 0, -0.8, 0, 0, 0, 0], dtype=torch.float64)
        side = torch.tensor([0.8, 0, 0.6, 0, 0, 0, 0], dtype=torch.float64)
        rest = found - 9 * tilt
        close(ray @ rest @ ray, torch.tensor(4.0).double())
        close(side @ rest @ side, torch.tensor(0.25).double())
        close(rest.diagonal()[[1, 3, 4]], torch.tensor([9.0, 16, 1]).double())
        assert abs(float(ray @ rest @ side)) < 1e-12
        close(ways_of(place)[0], ray)
        close(ways_of(place)[2], side)

    def test_the_roll_counts_across_the_ray_alone(self):
        place = torch.tensor([0, -1.4, -8.0, 0, 0, 0, 0], dtype=torch.float64)
        one = torch.eye(7, dtype=torch.float64)
        asked = facts(place=place, energy=0.08, covariance=one, tilt=one)
        factors = dict.fromkeys(KINDS, 1.0) | {"height": 3.0, "roll": 0.5, "yaw": 2.0}
        found = calibrated(asked, Calibration(factors))
        expected = torch.tensor([1, 9, 1, 4, 1, 1, 1], dtype=torch.float64)
        expected += torch.tensor([0.25, 9, 9, 9, 9, 9, 9], dtype=torch.float64)  # x is across
        close(found, torch.diag(expected))
        plain = calibrated(asked, Calibration())
        close(plain, 2 * one)

    def test_doubts_grow_where_the_silhouette_does_not_fit(self):
        one = torch.eye(7, dtype=torch.float64)
        powers = dict.fromkeys(GROWING, 0.0) | {"yaw": 2.0, "distance": 1.0}
        known = Calibration(powers=powers)
        place = torch.tensor([0, -1.4, -8.0, 0, 0, 0, 0], dtype=torch.float64)
        for overlap, grown in ((None, 1.0), (1.0, 1.0), (0.6, 3.0)):
            asked = facts(place=place, covariance=one, overlap=overlap)
            expected = torch.tensor([1, 1, grown**2, grown**4, 1, 1, 1], dtype=torch.float64)
            close(calibrated(asked, known), torch.diag(expected))

    def test_a_likely_alternative_belongs_to_what_holds(self):
        there = facts().place.clone()
        there[3] += math.pi
        spread = replace(facts(), covariance=1e-4 * torch.eye(7, dtype=torch.float64))
        other = replace(spread, alternatives=(Alternative(0.5, there),))
        one, two = explain((spread, other), Calibration())
        turned = there.clone()
        turned[3] += 0.01 - 2 * math.pi
        yaw, across = torch.eye(7, dtype=torch.float64)[[3, 0]]
        assert not held(one, yaw, turned)
        assert held(two, yaw, turned)
        assert min(offs(two, yaw, turned)) == pytest.approx(0.01, abs=1e-6)
        assert width(two, yaw) == pytest.approx(2 * width(one, yaw))
        assert width(two, across) == pytest.approx(width(one, across))
        probability = math.exp(-0.5) / (1 + math.exp(-0.5))
        assert two.others[0].probability == pytest.approx(probability)


class TestCalibration:
    def test_factors_hold_as_many_new_errors_as_they_promise(self):
        g = torch.Generator().manual_seed(1)
        spread = torch.rand(400, generator=g) + 0.1
        errors = 0.3 * spread * torch.randn(400, generator=g)
        factor = learn_factor((errors.abs() / spread / 1.645)[:200].tolist(), 0.9)
        assert factor == pytest.approx(0.3, abs=0.06)
        share = (errors[200:].abs() <= 1.645 * factor * spread[200:]).float().mean()
        assert 0.84 <= float(share) <= 0.96

    def test_errors_are_likeliest_under_the_variances_that_they_were_drawn_with(self):
        g = torch.Generator().manual_seed(5)
        own, rest = (torch.rand(2, 4000, generator=g, dtype=torch.float64) + 0.05).square()
        spread = (0.3**2 * own + 0.2**2 * rest).sqrt()
        normal = torch.randn(4000, generator=g, dtype=torch.float64)
        chi = torch.randn(4000, 2, generator=g, dtype=torch.float64).square().mean(-1)
        errors = (spread * normal / chi.sqrt()).abs()
        shares = (0.0, 0.05, 0.1, 0.2, 0.4, 0.8)
        assert min(shares, key=lambda r: surprise(own, r**2 * rest, errors)) == 0.2
        powers = (0.5, 1.0, 2.0)
        assert min(powers, key=lambda p: surprise(own**p, 0.2**2 * rest, errors)) == 1.0

    def test_the_surprise_is_the_least_over_all_factors(self):
        own = torch.tensor([0.1, 0.4, 0.02], dtype=torch.float64)
        rest, errors = own.flip(0) / 50, torch.tensor([0.03, 0.2, 0.01], dtype=torch.float64)
        total = []
        for scale in SCALES:
            variances = [scale**2 * a + b for a, b in zip(own.tolist(), rest.tolist(), strict=True)]
            pairs = zip(variances, errors.tolist(), strict=True)
            total.append(
                sum(math.log(v) / 2 + 1.5 * math.log(1 + e * e / (2 * v)) for v, e in pairs)
            )
        assert surprise(own, rest, errors) == pytest.approx(min(total))

    @pytest.mark.parametrize(
        "wrong",
        [
            {"format": "another"},
            {"version": VERSION - 1},
            {"forms": {"robust": {"factors": {}, "powers": dict.fromkeys(GROWING, 1), "share": 1}}},
            {"forms": {"robust": {"factors": dict.fromkeys(KINDS, 1), "powers": {}, "share": 1}}},
        ],
    )
    def test_a_file_of_another_kind_is_refused(self, wrong):
        right = {"format": FORMAT, "version": VERSION, "forms": {}}
        assert forms_of(right) == {}
        with pytest.raises(ValueError, match=r"calibration\.json"):
            forms_of(right | wrong)

    def test_too_few_errors_teach_nothing(self):
        with pytest.raises(ValueError, match="too few"):
            learn_factor([0.1] * 5, 0.9)

    def test_the_weight_of_alternatives_is_how_often_they_are_true(self):
        cases = [([0.0], 1)] * 20 + [([0.0], 0)] * 80 + [([], 0)] * 50
        assert learn_share(cases) == pytest.approx(0.25, rel=0.1)


class TestStage:
    def inputs(self, priced):
        layout = unvector(vector(priced.starts)[0])
        placed = Placed(layout, alone(layout), torch.zeros(1, 3), torch.zeros(0))
        pairs = torch.zeros(0, 3, dtype=torch.long)
        return ExplainInputs(priced, ROBUST.place, placed, walkers(4), pairs, None)

    def test_the_same_inputs_give_the_same_facts(self):
        asked = self.inputs(make_inputs())
        one, two = (explain(explain_placements(asked, ExplainConfig()).facts, Calibration())
                    for _ in range(2))  # fmt: skip
        assert log_rows(one) == log_rows(two)

    def test_facts_come_back_from_disk_as_they_were(self, tmp_path):
        asked = self.inputs(make_inputs())
        pairs = torch.tensor([[0, 0, 0], [3, 0, 0]])
        found = explain_placements(replace(asked, pairs=pairs), ExplainConfig())
        assert found.facts[0].touches
        save(found, tmp_path / "facts")
        back = load(Explained, tmp_path / "facts")
        one, two = (explain(f.facts, Calibration()) for f in (found, back))
        assert log_rows(one) == log_rows(two)
        assert scene_fields(one) == scene_fields(two)

    def test_what_neither_image_nor_people_see_is_less_certain(self):
        priced = make_inputs()
        blind = replace(
            priced.image, keep=torch.zeros_like(priced.image.keep),
            sides=torch.zeros_like(priced.image.sides), distance=None, given=None,
            measured=None,
        )  # fmt: skip
        nobody = replace(priced.humans, depth=None, space=None, touches=None)
        seen = explain_placements(self.inputs(priced), ExplainConfig()).facts
        unseen = explain_placements(
            self.inputs(replace(priced, image=blind, humans=nobody)), ExplainConfig()
        ).facts
        for a, b in zip(seen, unseen, strict=True):
            some = [float(f.covariance[2, 2]) ** 0.5 for f in (a, b)]
            assert some[0] < 0.15
            assert some[1] == pytest.approx(UNKNOWN[2] * math.sqrt(1 + FLAT), rel=1e-3)
            assert "nothing but its size" in verdict_of(b, b.covariance)

    def test_terms_share_the_energy_and_what_tells_the_distance(self):
        asked = self.inputs(make_inputs())
        off = moved(asked.placed.layout, 3, 0.03)
        asked = replace(asked, placed=replace(asked.placed, layout=off))
        for f in explain_placements(asked, ExplainConfig()).facts:
            assert sum(p.share for p in f.pulls) == pytest.approx(1, abs=1e-6)
            assert 0 <= sum(p.constrains for p in f.pulls) <= 1 + 1e-9
            assert f.overlap is not None
            assert 0.7 < f.overlap < 1

    def test_a_pinned_object_has_no_doubt(self):
        from mover.stages.objects.place_inputs import Pinned

        priced = make_inputs()
        layout = unvector(vector(priced.starts)[0])
        held_ = Pinned(torch.tensor([True, False, False]), layout)
        found = explain_placements(self.inputs(replace(priced, pinned=held_)), ExplainConfig())
        assert float(found.facts[0].covariance.abs().max()) == 0
        assert float(found.facts[1].covariance[0, 0]) > 0
        assert verdict_of(found.facts[0], found.facts[0].covariance) == "pinned by the user"

    def test_nobody_asks_nobody_answers(self):
        asked = self.inputs(make_inputs())
        assert explain_placements(asked, ExplainConfig(use=False)).facts == ()


def test_scene_files_carry_explanations_and_readers_pass_over_them(tmp_path):
    scene = room()
    scene = replace(scene, objects=tuple(replace(p, annotation=None) for p in scene.objects))
    names = [p.id for p in scene.objects]
    told = explain([facts(id=names[0])], Calibration())
    path = tmp_path / "scene.json"
    write_scene(scene, path, scene_fields(told))
    first = json.loads(path.read_text())["objects"][0]
    assert first["uncertainty"]["level"] == 0.9
    low, high = first["uncertainty"]["ranges"]["z"]
    assert (low + high) / 2 == pytest.approx(-3.0)
    assert first["uncertainty"]["ranges"]["size_x"][0] == pytest.approx(
        math.exp(-1.6449 * 0.15), 1e-3
    )
    assert "stands on the floor" in first["explanation"]["evidence"]
    assert [p.id for p in read_scene(path).objects] == names


class TestPictures:
    def doubtful(self):
        g = torch.Generator().manual_seed(2)
        root = 0.1 * torch.randn(7, 7, generator=g, dtype=torch.float64)
        told = facts(covariance=root @ root.mT, pulls=(pull("scale", 0.6), pull("bbox", 0.2)))
        return explain((told,), Calibration())

    def test_the_ellipse_of_the_viewer_holds_nine_tenths_of_the_places(self):
        (told,) = self.doubtful()
        ring = place_ellipses(log_rows([told]))["shelf_0"].double()
        assert float((ring[:, 1] - told.facts.place[1]).abs().max()) < 1e-6
        g = torch.Generator().manual_seed(3)
        flat = told.covariance[[0, 2]][:, [0, 2]]
        draw = torch.randn(4000, 2, generator=g, dtype=torch.float64)
        points = draw @ torch.linalg.cholesky(flat).mT + told.facts.place[[0, 2]]
        edge = ring[:, [0, 2]]
        to, along = points[:, None] - edge, edge.roll(-1, 0) - edge
        turn = along[:, 0] * to[..., 1] - along[:, 1] * to[..., 0]
        inside = (turn > 0).all(-1) | (turn < 0).all(-1)
        assert float(inside.double().mean()) == pytest.approx(0.9, abs=0.02)

    def test_the_plan_has_the_same_ellipse(self):
        (told,) = self.doubtful()
        found = re.search(
            r'cx="(.*?)" cy="(.*?)" rx="(.*?)" ry="(.*?)" transform="rotate\((.*?) ',
            draw_uncertainty([told]),
        )
        assert found is not None
        x, z, large, small, turn = (float(v) for v in found.groups())
        angle = torch.tensor(math.radians(turn), dtype=torch.float64)
        axes = torch.stack([torch.stack([angle.cos(), angle.sin()]),
                            torch.stack([-angle.sin(), angle.cos()])])  # fmt: skip
        expected = math.log(10) * 2 * told.covariance[[0, 2]][:, [0, 2]]
        square = torch.tensor([large, small], dtype=torch.float64).square()
        close(axes.mT @ (square[:, None] * axes), expected, rtol=0.01, atol=1e-3)
        close(torch.tensor([x, z]), told.facts.place[[0, 2]].float(), atol=1e-3)

    def test_the_report_tells_every_sentence(self):
        (told,) = self.doubtful()
        page = explanations_list([told])
        for sentence in (told.verdict, *told.sentences):
            assert escape(sentence) in page
        assert "not calibrated" in page
        assert explanations_list([]) == ""
