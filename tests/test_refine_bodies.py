"""Refinement of the bodies with the room: terms, and what happens to bodies in simple rooms."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from analytic import FACES, box_verts
from figures import ARMS_DOWN, SEATED, STRIDE, people, pose

from mover.bodies.corrected import Correction, corrected, in_world, moved, no_correction, puppet_of
from mover.bodies.parts import members, parts_of
from mover.core.errors import InputError
from mover.core.records import rows_of
from mover.core.types import Camera, Mesh, Room, Scene, SceneObject, Segment
from mover.energy.body_contact import (
    Matches,
    Skin,
    Surface,
    gather_matches,
    touch_term,
    without_kept,
)
from mover.energy.body_terms import (
    ANGLE,
    Bounds,
    Sighting,
    bounds_of_skin,
    depth_share,
    deviation_term,
    gather_neighbours,
    image_term,
    lock_term,
    order_term,
    range_term,
    sink_term,
    smooth_term,
    stand_term,
    steady_term,
    under_term,
)
from mover.energy.config import Adam
from mover.geometry.mesh import vertex_normals
from mover.geometry.volume import Volume
from mover.io.people.bodies import bodies_from
from mover.io.people.found import Known
from mover.stages.camera.align_camera import AlignInputs, align_camera
from mover.stages.camera.find_foot_contacts import FootContactInputs, find_foot_contacts
from mover.stages.config import RefineBodiesConfig
from mover.stages.people.body_evidence import surroundings_of
from mover.stages.people.refine_bodies import ABLATION, SMOOTHED, refine_bodies

SAM = Path(__file__).parents[2] / "shared" / "data" / "sam3d_body"
K = torch.tensor([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]])
CAMERA = Camera(K, torch.diag(torch.tensor([1.0, -1.0, -1.0])), 640, 480)
GROUND = -1.4
LINE = gather_neighbours(torch.arange(4), torch.zeros(4, dtype=torch.long), 5.0)
UP, ONE = torch.tensor([[0.0, 1.0, 0.0]]), torch.zeros(1)
WALL = Surface(torch.zeros(1, 3), UP, ONE.long(), ONE)


def still_people(turns, count=1, at=(0.0, -3.0), lift=0.0, fps=5.0):
    """People in one posture, with joints, their feet on the floor but for `lift`."""
    bodies = people(pose(turns, count), fps, GROUND + lift)
    puppet = puppet_of(bodies, torch.arange(bodies.verts.shape[1]))
    move = bodies.verts[0, 0] - puppet.skin[0, 0] + torch.tensor([at[0], 0.0, at[1]])
    placed = replace(bodies.pose, transl=bodies.pose.transl + move)
    return corrected(replace(bodies, pose=placed), no_correction(puppet))


def room_with(bodies, *boxes):
    """A room with boxes: size and place of the bottom's centre."""
    proxies = tuple(Mesh(box_verts(size).float(), FACES) for size, _ in boxes)
    pieces = [
        SceneObject(f"box_{k}", "stool", mesh, "", None, "ground", torch.tensor(place),
                    torch.tensor(0.0), torch.ones(3))
        for k, (mesh, (_, place)) in enumerate(zip(proxies, boxes, strict=True))
    ]  # fmt: skip
    scene = Scene(CAMERA, GROUND, tuple(pieces))
    return Room(scene, scene, scene, bodies, None, proxies, (), None, {}, ())


def lowest(bodies):
    return bodies.verts[..., 1].amin(1) - GROUND


def seat_gap(bodies, height):
    """How far the lowest skin of seat and thighs is above a level [m]."""
    part = members(parts_of(bodies), "seat", "left_thigh", "right_thigh")
    return bodies.verts[:, part, 1].amin(1) - GROUND - height


def analytic_volume():
    """Half space y < 0 filled."""
    y = (torch.arange(20, dtype=torch.float64) - 9.5) * 0.05
    values = y[None, :, None].expand(20, 20, 20).clone()
    return Volume(values, torch.full((3,), -9.5 * 0.05, dtype=torch.float64), 0.05)


def random_points(seed, *shape):
    return torch.from_numpy(np.random.default_rng(seed).uniform(-0.3, 0.3, shape))


MATCHES = Matches(
    torch.tensor([0, 2]), torch.tensor([1, 0]), torch.zeros(2, 3, dtype=torch.float64),
    torch.tensor([[0.0, 1, 0], [1, 0, 0]], dtype=torch.float64),
    torch.ones(2, dtype=torch.float64), torch.full((2,), 0.02, dtype=torch.float64),
    torch.tensor([0, 1]), torch.full((2,), 0.01, dtype=torch.float64),
)  # fmt: skip
AWAY = torch.tensor([0.0, 0.0, 3.0], dtype=torch.float64)
TERMS = {
    "angles": lambda x: 0.5 * deviation_term(x.flatten(1), ANGLE),
    "range": lambda x: range_term(x[:, 0, 0], LINE.track),
    "image": lambda x: image_term(x + AWAY, 0 * x.detach() + AWAY),
    "smooth": lambda x: smooth_term(x, LINE),
    "steady": lambda x: steady_term(x.flatten(1), x[:, 0, 0], LINE),
    "lock": lambda x: lock_term(x[:, :2], torch.ones(4, 2, dtype=x.dtype), LINE),
    "sink": lambda x: sink_term(x, analytic_volume()),
    "under": lambda x: under_term(x, 0.0),
    "stand": lambda x: stand_term(x[:, :2], 0 * x[:, :2, 0].detach() + 1, 0.0),
    "touch": lambda x: touch_term(x, MATCHES, 0.1),
    "order": lambda x: order_term(x[..., 2], Bounds(0 * x[..., 0].detach() + 0.05,
                                                    0 * x[..., 0].detach() + torch.inf)),
}  # fmt: skip
AT_REST = {"order": 0.2}


@pytest.mark.parametrize("name", TERMS)
class TestEveryTerm:
    def test_is_never_negative(self, name):
        for seed in range(5):
            assert (TERMS[name](random_points(seed, 4, 3, 3)) >= 0).all()

    def test_is_zero_where_nothing_is_wrong(self, name):
        still = torch.full((4, 3, 3), AT_REST.get(name, 0.0), dtype=torch.float64)
        if name in ("sink", "under"):
            still[..., 1] = 0.01
        torch.testing.assert_close(TERMS[name](still), torch.zeros(4, dtype=torch.float64))

    def test_gradient_equals_finite_differences(self, name):
        x = random_points(7, 4, 3, 3).requires_grad_()
        assert torch.autograd.gradcheck(TERMS[name], (x,), eps=1e-6, atol=1e-5)


def test_constant_motion_is_smooth_at_any_times():
    frame = torch.tensor([0, 1, 4, 5])
    near = gather_neighbours(frame, torch.zeros(4, dtype=torch.long), 10.0)
    points = frame[:, None, None] * torch.tensor([0.1, 0.0, 0.05]).double()
    assert float(smooth_term(points, near).sum()) < 1e-12
    bent = points + torch.tensor([0.0, 0.1, 0.0, 0.0]).double()[:, None, None]
    assert float(smooth_term(bent, near)[1]) > 0.5


def test_tracks_gaps_and_unordered_images_have_no_neighbours():
    frame, person = torch.tensor([0, 0, 1, 1, 20]), torch.tensor([0, 1, 0, 1, 0])
    near = gather_neighbours(frame, person, 5.0)
    assert {tuple(p) for p in near.pairs.tolist()} == {(0, 2), (1, 3)}
    assert len(gather_neighbours(frame, person, None).pairs) == 0


def test_one_lasting_depth_error_of_a_person_costs_once():
    many = torch.full((50,), 0.03, dtype=torch.float64)
    assert float(range_term(many, torch.zeros(50, dtype=torch.long)).sum()) == pytest.approx(0.5)
    assert float(range_term(many, torch.arange(50)).sum()) == pytest.approx(25)


def test_the_size_in_the_image_says_nothing_about_the_depth():
    """Along the ray of the pelvis a body goes free; across it, and bent, it pays."""
    start = AWAY + random_points(3, 4, 5, 3)
    ray = start[:, :1] * torch.tensor([0.03, -0.02, 0.01, 0.05]).double()[:, None, None]
    zero = torch.zeros(4, dtype=torch.float64)
    torch.testing.assert_close(image_term(start + ray, start), zero, atol=1e-8, rtol=0)
    assert (image_term(start + ray + torch.tensor([0.03, 0, 0]), start) > 0.5).all()
    bent = torch.cat([start[:, :1], start[:, 1:] + torch.tensor([0, 0.03, 0])], 1)
    assert (image_term(bent + ray, start) > 0.5).all()


def test_points_behind_the_camera_have_finite_costs():
    behind = torch.tensor([[[0.1, 0.2, -1.0]]], requires_grad=True)
    start = torch.tensor([[[0.1, 0.2, 3.0]]])
    (image_term(behind, start).sum() + depth_share(behind[:, 0], start[:, 0]).sum()).backward()
    assert behind.grad.isfinite().all()


def skin_of(points, normals, group, bent=0.0):
    """Skin of one person about a pelvis at the origin, which touches."""
    bodies, count = points.shape[:2]
    return Skin(
        points, torch.nn.functional.normalize(normals, dim=-1), torch.ones(bodies, count),
        torch.tensor(group), torch.zeros(bodies).long(), torch.zeros(bodies, 3),
        torch.zeros(bodies).bool(), bent,
    )  # fmt: skip


def test_a_thigh_lies_on_the_seat_and_not_on_its_front():
    """One of its points is nearest to the front, and looks there too; the thigh looks down."""
    points = torch.tensor([[[-0.3, 0.01, 0.0], [-0.2, 0.01, 0.0], [0.03, -0.02, 0.0]]])
    normals = torch.tensor([[[0.0, -1, 0], [0.0, -1, 0], [-1.0, -0.9, 0]]])
    seat = Surface(
        torch.tensor([[-0.3, 0.0, 0.0], [-0.2, 0.0, 0.0], [0.0, -0.02, 0.0]]),
        torch.tensor([[0.0, 1, 0], [0.0, 1, 0], [1.0, 0, 0]]), torch.zeros(3).long(), ONE,
    )  # fmt: skip
    found = gather_matches(skin_of(points, normals, [0, 0, 0]), seat)
    assert found.point.tolist() == [0, 1]
    alone = gather_matches(skin_of(points, normals, [0, 0, 1]), seat)
    assert alone.point.tolist() == [0, 1, 2]


def test_far_skin_is_trusted_less_while_the_pose_may_be_wrong():
    points = torch.tensor([[[0.4, 0.0, 0.0], [0.0, 0.0, 0.0]]])
    normals = torch.tensor([[[0.0, -1, 0], [0.0, -1, 0]]])
    floor = replace(WALL, points=points[0], normals=-normals[0], piece=torch.zeros(2).long())
    usual = gather_matches(skin_of(points, normals, [0, 1], 0.09), floor).usual
    torch.testing.assert_close(usual, torch.tensor([(0.02**2 + 0.036**2) ** 0.5, 0.02]))


def test_an_error_that_lasts_says_no_more_in_a_hundred_frames_than_in_one():
    """The shared error is that of the normal equations; a lone error costs as without it."""
    off, trust = torch.tensor([0.03, 0.05, 0.01]).double(), torch.tensor([4e3, 1e3, 2e3]).double()
    rest, cost = without_kept(off, trust, torch.tensor([0, 0, 1]), 0.02)
    left = torch.tensor([[5e3 + 2500.0, 0], [0, 2e3 + 2500.0]]).double()
    shared = torch.linalg.solve(left, torch.tensor([4e3 * 0.03 + 1e3 * 0.05, 2e3 * 0.01]).double())
    torch.testing.assert_close(rest, off - shared[[0, 0, 1]])
    torch.testing.assert_close(float(cost.sum()), float((0.5 * (shared / 0.02) ** 2).sum()))
    many = without_kept(off[:1].expand(100), trust[:1].expand(100), torch.zeros(100).long(), 0.02)
    total = (0.5 * trust[0] * many[0].square() + many[1]).sum()
    assert float(total) < 0.5 * (0.03 / 0.02) ** 2


def test_only_surfaces_that_face_the_skin_are_touched():
    points = torch.tensor([[[0.0, 0.1, 0.0], [0.0, -0.1, 0.0]]])
    skin = skin_of(points, torch.tensor([[[0.0, -1, 0], [0.0, 1, 0]]]), [0, 1])
    found = gather_matches(skin, WALL)
    assert found.point.tolist() == [0]
    sunk = replace(skin, points=-points)
    assert gather_matches(sunk, WALL).point.tolist() == [0]
    unsure = replace(skin, chance=torch.full((1, 2), 0.5))
    assert len(gather_matches(unsure, WALL).body) == 0


SEAT, BACK = 0, 1
HEIGHTS = torch.tensor([0.0, 0.01, 0.03, 0.035])  # over the mattress: a back arches
GROUP = torch.tensor([SEAT, SEAT, BACK, BACK])


def on_a_mattress(lying: list[bool], lift: float = 0.0) -> tuple[Skin, Surface]:
    """Bodies whose seats rest on a level surface under hollow backs."""
    count, places = len(lying), torch.tensor([-0.1, 0.0, 0.3, 0.4])
    one = torch.stack([places, HEIGHTS + lift, torch.zeros(4)], -1)
    down = torch.tensor([0.0, -1.0, 0.0]).expand(count, 4, 3)
    skin = Skin(
        one.expand(count, 4, 3), down, torch.ones(count, 4), GROUP, torch.arange(count),
        torch.zeros(count, 3), torch.tensor(lying), 0.0,
    )  # fmt: skip
    top = torch.stack([places, torch.zeros(4), torch.zeros(4)], -1)
    return skin, Surface(top, -down[0], torch.zeros(4).long(), torch.zeros(1))


def test_the_hollow_back_of_a_lying_person_is_not_drawn_down_while_the_seat_rests() -> None:
    skin, mattress = on_a_mattress([True, False])
    found = gather_matches(skin, mattress)
    asked = torch.zeros(2, 4).index_put((found.body, found.point), found.weight)
    torch.testing.assert_close(asked, torch.tensor([[1.0, 1, 0, 0], [1.0, 1, 1, 1]]))
    slope = torch.autograd.functional.jacobian(
        lambda x: touch_term(x, found, 0.1).sum(), skin.points
    )
    assert (slope[0, GROUP == BACK] == 0).all()
    assert (slope[1, GROUP == BACK, 1] > 0).all()


def test_a_mattress_bears_a_lying_person_by_what_rests_on_it_wherever_the_body_starts() -> None:
    for lift in (-0.05, 0.05):
        skin, mattress = on_a_mattress([True], lift)
        found = gather_matches(skin, mattress)
        shifts = torch.linspace(-0.08, 0.08, 161)
        up = torch.tensor([0.0, 1.0, 0.0])
        cost = torch.stack([touch_term(skin.points + s * up, found, 0.1).sum() for s in shifts])
        lowest = (skin.points[0, :, 1] + shifts[cost.argmin()]).min()
        assert abs(float(lowest)) < 0.007  # between both points of the seat


def test_visible_skin_is_before_and_hidden_skin_behind_the_furniture():
    front = torch.full((2, 30), 3.0)
    yes, no = torch.ones(2, 30, dtype=torch.bool), torch.zeros(2, 30, dtype=torch.bool)
    sure = torch.zeros(2, 30)
    shown = bounds_of_skin(Sighting(front, yes, no, yes, sure))
    hidden = bounds_of_skin(Sighting(front, no, yes, yes, sure))
    near, far = torch.full((2, 30), 2.5), torch.full((2, 30), 3.5)
    assert (order_term(near, shown) == 0).all()
    assert (order_term(far, shown) > 1).all()
    assert (order_term(far, hidden) == 0).all()
    assert (order_term(near, hidden) > 1).all()
    assert (order_term(far, bounds_of_skin(Sighting(front, yes, yes, no, sure))) == 0).all()


def test_a_corrected_body_is_its_puppet_moved():
    bodies = still_people(STRIDE, 2)
    draw = np.random.default_rng(3)
    by = Correction(*(torch.from_numpy(draw.normal(0, 0.1, (2, n))).float() for n in (3, 3, 63)))
    puppet = puppet_of(bodies, torch.arange(0, 5002, 10))
    found, now = corrected(bodies, by), moved(puppet, by)
    torch.testing.assert_close(found.verts[:, ::10], now.skin, atol=2e-5, rtol=0)
    torch.testing.assert_close(found.joints[:, :22], now.points, atol=2e-5, rtol=0)
    assert (found.verts - bodies.verts).norm(dim=-1).mean() > 0.05
    same = corrected(bodies, no_correction(puppet))
    torch.testing.assert_close(same.verts, bodies.verts, atol=2e-5, rtol=0)


QUICK = RefineBodiesConfig(method=Adam(25, 0.01, 0.003, beta2=0.98), rounds=4)


@pytest.mark.slow
def test_a_floating_sitter_sits():
    sitter = still_people(SEATED, 3)
    height = float(seat_gap(sitter, 0.0)[0]) - 0.06
    room = room_with(sitter, ((0.6, height, 0.6), (0.0, GROUND, -3.1)))
    found = refine_bodies(room, None, QUICK).bodies
    assert seat_gap(sitter, height).min() > 0.055
    assert seat_gap(found, height).abs().max() < 0.02
    off = replace(QUICK, weights=replace(QUICK.weights, touch=0.0))
    assert seat_gap(refine_bodies(room, None, off).bodies, height).min() > 0.04


@pytest.mark.slow
def test_a_sitter_sunk_in_the_seat_comes_out_of_it():
    sitter = still_people(SEATED, 3)
    height = float(seat_gap(sitter, 0.0)[0]) + 0.05
    room = room_with(sitter, ((0.6, height, 0.6), (0.0, GROUND, -3.1)))
    only = replace(QUICK, weights=ABLATION["+CamGP+SDF"])
    assert seat_gap(refine_bodies(room, None, only).bodies, height).min() > -0.035
    assert seat_gap(refine_bodies(room, None, QUICK).bodies, height).abs().max() < 0.02


@pytest.mark.slow
def test_bare_meshes_move_rigidly():
    bodies = replace(still_people(ARMS_DOWN, 2, lift=-0.05), pose=None)
    found = refine_bodies(room_with(bodies), None, replace(QUICK, rounds=2)).bodies
    some = torch.arange(0, 5002, 250)
    before, after = (torch.cdist(b.verts[:, some], b.verts[:, some]) for b in (bodies, found))
    torch.testing.assert_close(after, before, atol=1e-5, rtol=0)
    assert (found.verts - bodies.verts)[..., 1].mean() > 0.02
    assert lowest(found).min() > lowest(bodies).max() + 0.02


@pytest.mark.slow
@pytest.mark.skipif(not SAM.is_dir(), reason="the real SAM 3D Body files are not here")
def test_real_people_of_sam_3d_body_stand_on_the_floor_of_their_feet(tmp_path):
    """A photograph of four people who jump: a person far above the floor stays in the air."""
    for file in SAM.glob("img_*.npz"):
        (tmp_path / file.name).symlink_to(file)
    read = bodies_from("sam3dbody", tmp_path, Known(faces=SAM / "mhr_lod1_topology.ply"))
    width, height = (int(2 * float(read.K[k, 2])) for k in (0, 1))
    camera = Camera(read.K, CAMERA.R_cam_world, width, height)
    parts = parts_of(read.bodies, camera.R_cam_world[:, 1])
    keep = torch.ones(4, dtype=torch.bool)
    soles = find_foot_contacts(FootContactInputs(read.bodies, parts, keep, camera))
    level = align_camera(AlignInputs(soles, camera, None, None))
    scene = Scene(level.camera, level.ground, ())
    given = in_world(read.bodies, level.camera)
    found = refine_bodies(Room(scene, scene, scene, given, None, (), (), None, {}, ()), None, QUICK)
    before, after = (b.verts[..., 1].amin(1) - level.ground for b in (given, found.bodies))
    high = before > 0.3
    assert int(high.sum()) == 1
    assert (after[~high].abs() < 0.03).all()
    assert (after[high] > 0.3).all()
    some = torch.arange(0, 18439, 900)
    shape, kept = (torch.cdist(b.verts[:, some], b.verts[:, some]) for b in (given, found.bodies))
    torch.testing.assert_close(kept, shape, atol=1e-4, rtol=0)


@pytest.mark.slow
def test_people_who_touch_nothing_stay_where_they_are():
    bodies = still_people(ARMS_DOWN, 3, lift=0.4, at=(1.0, -4.0))
    room = room_with(bodies, ((0.5, 0.5, 0.5), (-1.0, GROUND, -3.0)))
    config = replace(QUICK, rounds=1, weights=replace(QUICK.weights, stand=0.0))
    found = refine_bodies(room, None, config).bodies
    torch.testing.assert_close(found.verts, bodies.verts, atol=1e-3, rtol=0)


@pytest.mark.slow
def test_chunks_do_not_show():
    bodies = still_people(ARMS_DOWN, 8, lift=-0.03)
    config = replace(QUICK, rounds=1, places=0, method=Adam(10))
    whole = refine_bodies(room_with(bodies), None, config)
    parts = refine_bodies(room_with(bodies), None, replace(config, rows=4, overlap=3))
    torch.testing.assert_close(parts.bodies.verts, whole.bodies.verts, atol=2e-3, rtol=0)
    again = refine_bodies(room_with(bodies), None, config)
    assert torch.equal(again.bodies.verts, whole.bodies.verts)


@pytest.mark.slow
def test_people_meet_moved_furniture_where_it_stands_while_they_are_there():
    """As two videos, one of each time, and none knows of the other time."""
    bodies = replace(still_people(SEATED, 4), frame=torch.tensor([9, 0, 8, 1]))
    height = float(seat_gap(bodies, 0.0)[0]) + 0.05
    room = room_with(bodies, ((0.6, height, 0.6), (2.0, GROUND, -3.1)))
    stool = room.scene.objects[0]
    here = replace(stool, t_world_object=torch.tensor([0.0, GROUND, -3.1]))
    stays = tuple(Segment(f, p.t_world_object, p.yaw) for f, p in ((0, stool), (5, here)))
    config = replace(QUICK, rounds=1, method=Adam(5), place=Adam(5))
    moved_stool = replace(stool, segments=stays)
    moving = replace(room, scene=replace(room.scene, objects=(moved_stool,)))
    found = refine_bodies(moving, None, config)
    for piece, rows in ((stool, [1, 3]), (here, [0, 2])):
        scene = replace(room.scene, objects=(piece,))
        alone = replace(room, scene=scene, bodies=rows_of(bodies, torch.tensor(rows)))
        expected = refine_bodies(alone, None, config)
        assert torch.equal(found.bodies.verts[rows], expected.bodies.verts)
        assert torch.equal(found.shift[rows], expected.shift)
    assert (found.bodies.verts - refine_bodies(room, None, config).bodies.verts).abs().max() > 1e-3


def test_rows_keep_their_order():
    bodies = still_people(ARMS_DOWN, 4)
    mixed = replace(bodies, frame=torch.tensor([3, 0, 2, 1]), person=torch.tensor([0, 1, 0, 1]))
    room = room_with(mixed)
    found = refine_bodies(room, None, replace(QUICK, rounds=1, weights=SMOOTHED)).bodies
    torch.testing.assert_close(found.verts, bodies.verts, atol=1e-3, rtol=0)
    assert torch.equal(found.frame, mixed.frame)


def test_a_room_without_people_or_floor_is_refused():
    with pytest.raises(InputError, match="no bodies"):
        refine_bodies(room_with(None), None, QUICK)
    room = room_with(still_people(ARMS_DOWN))
    floorless = replace(room, scene=replace(room.scene, ground=None))
    with pytest.raises(InputError, match="no floor"):
        refine_bodies(floorless, None, QUICK)


def test_furniture_is_drawn_where_it_stands():
    room = room_with(None, ((0.5, 1.0, 0.5), (0.0, GROUND, -3.0)))
    around = surroundings_of(room, None)
    seen = around.front.isfinite()
    assert float(around.front[seen].min()) == pytest.approx(2.75, abs=0.02)
    columns = seen.any(0).nonzero()[:, 0].float()
    assert float(columns.mean()) == pytest.approx(320, abs=2)
    mesh = room.proxies[0]
    assert (vertex_normals(mesh.verts, mesh.faces)[:, 1].abs() > 0).all()
