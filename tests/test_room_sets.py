"""Open HSI Rooms: each set keeps its promises, and is found out when it changes."""

import itertools
import json
import math
from dataclasses import replace
from pathlib import Path

import little_room
import numpy as np
import pytest
import torch
from test_rooms import exact, shared_room, tiny_room

from mover.core.errors import InputError
from mover.core.types import SceneObject
from mover.evaluate.evaluation import evaluate_folder
from mover.geometry.camera import to_world
from mover.geometry.placement import place_object
from mover.io.formats import read
from mover_bench.rooms.config import NoiseConfig, RoomConfig
from mover_bench.rooms.known import KnownRoom
from mover_bench.rooms.noise import add_noise
from mover_bench.rooms.placed import BODY, free_of, way
from mover_bench.rooms.room import make_room
from mover_bench.studies import make
from mover_bench.studies.args import MakeArgs
from mover_bench.studies.job import DONE, Job, key_of, spoilt
from mover_bench.studies.make import (
    CAPTURE,
    MADE,
    capture_hash,
    differences,
    known_hashes,
    make_one,
    make_set,
    mask_pixels,
    row_of,
    told,
    truth_hash,
)
from mover_bench.studies.measures import (
    hidden_shares,
    is_flipped,
    stays_at,
    traits_of,
    truncated_shares,
)
from mover_bench.studies.run import parse_seeds
from mover_bench.studies.sets import SETS


@pytest.fixture(scope="module")
def tiny() -> KnownRoom:
    return shared_room()


def moved(room: KnownRoom, step: float) -> KnownRoom:
    """The same room with its first piece moved along x [m]."""
    first = room.truth.objects[0]
    place = first.t_world_object + torch.tensor([step, 0.0, 0.0])
    pieces = (replace(first, t_world_object=place), *room.truth.objects[1:])
    return replace(room, truth=replace(room.truth, objects=pieces))


class TestHashes:
    def test_small_room_is_what_it_was_before_there_were_sets(self, small_room: KnownRoom) -> None:
        assert truth_hash(small_room) == "450fb6235ed63a70"

    def test_last_bits_do_not_show_but_a_millimetre_does(self, tiny: KnownRoom) -> None:
        before = truth_hash(tiny)
        assert truth_hash(tiny_room()) == before
        assert truth_hash(moved(tiny, 1e-6)) == before
        assert truth_hash(moved(tiny, 1e-3)) != before

    def test_every_part_of_a_room_is_in_its_hash(self, tiny: KnownRoom) -> None:
        bodies, first = tiny.bodies, tiny.truth.objects[0]
        assert bodies.pose is not None
        turned = replace(bodies.pose, body_pose=bodies.pose.body_pose + 0.001)
        mesh = replace(first.mesh, faces=first.mesh.faces.flip(0))
        others = (
            replace(tiny, actions=("jump", *tiny.actions[1:])),
            replace(tiny, bodies=replace(bodies, pose=turned)),
            replace(tiny, bodies=replace(bodies, frame=bodies.frame + 1)),
            replace(tiny, truth=replace(tiny.truth, objects=tiny.truth.objects[1:])),
            replace(tiny, truth=replace(tiny.truth, objects=(replace(first, mesh=mesh),))),
            replace(tiny, truth=replace(tiny.truth, ground=-1.5)),
        )
        hashes = {truth_hash(room) for room in (tiny, *others)}
        assert len(hashes) == len(others) + 1

    def test_noise_is_in_the_hash_of_the_capture_and_not_in_that_of_the_truth(
        self, tiny: KnownRoom
    ) -> None:
        first, again, other = (add_noise(tiny, NoiseConfig(), seed) for seed in (0, 0, 1))
        assert capture_hash(first) == capture_hash(again) != capture_hash(other)
        fewer = replace(first, detections=first.detections[1:])
        assert capture_hash(fewer) != capture_hash(first)

    def test_masks_may_differ_by_a_thousandth_between_machines(self) -> None:
        row = {"truth": "a", "capture": "b", "pixels": [10_000, 0]}
        assert differences(row, {**row, "pixels": [10_009, 0]}) == []
        assert differences(row, {**row, "pixels": [10_020, 0]}) == ["pixels"]
        assert differences(row, {**row, "truth": "c", "capture": "d"}) == ["truth", "capture"]

    def test_pixels_are_those_of_all_masks(self, tiny: KnownRoom) -> None:
        from pycocotools import mask as coco

        people = tiny.capture.people
        assert people is not None
        size = [people.masks.height, people.masks.width]
        known = sum(int(coco.area({"size": size, "counts": c})) for c in people.masks.counts)
        assert mask_pixels(tiny.capture)[1] == known > 0


class TestTraits:
    def test_a_stay_ends_when_nobody_touches_for_more_than_a_second(self, tiny: KnownRoom) -> None:
        rows = len(tiny.bodies.frame)
        for frames, count in (([], 0), ([3], 1), ([3, 4, 8, 9], 1), ([3, 4, 12, 20], 3)):
            touched = torch.full_like(tiny.touched, -2)
            touched[frames, 5] = 1
            room = replace(tiny, touched=touched)
            assert stays_at(room, 1) == count, frames
            assert stays_at(room, 0) == 0
        touched = torch.full_like(tiny.touched, 1)
        people = torch.arange(rows) % 2
        both = replace(tiny, touched=touched, bodies=replace(tiny.bodies, person=people))
        assert stays_at(both, 1) == 2, "each person for themselves"

    def test_a_box_whose_middle_is_on_the_border_is_half_cut(self) -> None:
        scene = little_room.room()
        scene = replace(scene, camera=little_room.camera(0.0, 0.0))
        edge = 3.0 * scene.camera.width / 2 / float(scene.camera.K[0, 0])
        flat = little_room.box(0.4, 0.4, 0.01)
        shares = []
        for x in (0.0, edge, 2 * edge):
            piece = little_room.piece("picture_0", flat, (x, -3.0), 0.0, -0.2)
            shares.append(truncated_shares(replace(scene, objects=(piece,)))[0])
        assert shares == pytest.approx([0.0, 0.5, 1.0], abs=0.03)
        assert truncated_shares(replace(scene, objects=())) == ()

    @pytest.mark.parametrize(("degrees", "flipped"), [(0, 0), (59, 0), (61, 1), (180, 1), (301, 0)])
    def test_flipped_is_a_turn_of_more_than_60_degrees(self, degrees: int, flipped: int) -> None:
        piece = little_room.room().objects[0]
        guess = replace(piece, yaw=piece.yaw + math.radians(degrees))
        assert is_flipped(piece, guess) == bool(flipped)
        assert not is_flipped(piece, None)

    def test_traits_are_those_of_the_true_objects_even_if_a_guess_is_missing(
        self, tiny: KnownRoom
    ) -> None:
        traits = traits_of(tiny, replace(tiny.truth, objects=tiny.truth.objects[1:]))
        assert [t.id for t in traits] == [p.id for p in tiny.truth.objects]
        assert [t.touched for t in traits] == [True, True, False]
        assert [t.stays > 0 for t in traits] == [True, True, False]
        assert [t.hidden for t in traits] == list(hidden_shares(tiny.truth))


class Ended:
    """A job that was done at once."""

    def poll(self) -> int:
        return 0

    def terminate(self) -> None:
        raise AssertionError("it has ended")


class Bench:
    """Writes the row of a little room that was not made anew, and remembers of which."""

    def __init__(self, room: KnownRoom) -> None:
        self.room, self.done = room, list[int]()

    def __call__(self, job: Job) -> Ended:
        self.done.append(job.seed)
        if job.seed != 13:
            trial = spoilt(self.room, job.seed, SETS[job.rooms])
            row = {"key": key_of(job), **row_of(self.room, trial.capture, trial.traits)}
            job.folder.mkdir(parents=True, exist_ok=True)
            (job.folder / DONE).write_text(json.dumps(row))
        return Ended()


@pytest.fixture
def hashes(tiny: KnownRoom, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A package that knows rooms 0 and 1 of `mini`, as they are made of the little room."""
    args = MakeArgs("mini", tmp_path / "first", "0,1")
    made = make_set(args, launch=Bench(tiny))
    monkeypatch.setattr(make, "HASHES", tmp_path / "known")
    (tmp_path / "known").mkdir()
    path = tmp_path / "known" / "mini.json"
    path.write_bytes((made.manifest.parent / "hashes.json").read_bytes())
    return path


class TestMake:
    def test_the_manifest_says_what_is_in_each_room(self, tiny: KnownRoom, tmp_path: Path) -> None:
        made = make_set(MakeArgs("mini", tmp_path, "0,1"), launch=Bench(tiny))
        tree = json.loads(made.manifest.read_text())
        assert (tree["set"], tree["version"]) == ("mini", SETS["mini"].version)
        assert tree["licence"] == "CC0-1.0"
        assert list(tree["rooms"]) == ["0", "1"]
        row = tree["rooms"]["0"]
        assert row["truth"] == truth_hash(tiny)
        assert row["capture"] == capture_hash(add_noise(tiny, SETS["mini"].noise, 0))
        assert (row["pieces"], row["people"], row["touched"]) == (3, 1, 2)
        assert row["frames"] == len(tiny.bodies.frame)
        assert (row["missed"], row["false"]) == (0, 0)
        assert tree["rooms"]["1"]["truth"] == row["truth"]
        assert tree["rooms"]["1"]["capture"] != row["capture"]

    def test_what_is_made_is_not_made_again_and_what_failed_is(
        self, tiny: KnownRoom, tmp_path: Path
    ) -> None:
        args, bench = MakeArgs("mini", tmp_path, "11-13"), Bench(tiny)
        made = make_set(args, launch=bench)
        assert sorted(bench.done) == [11, 12, 13]
        assert list(made.failed) == ["13"]
        assert "room 13 failed: it said nothing" in told(made, check=False)
        again = Bench(tiny)
        make_set(replace(args, seeds="10-13"), launch=again)
        assert sorted(again.done) == [10, 13]

    def test_a_check_finds_rooms_that_changed_and_those_it_does_not_know(
        self, tiny: KnownRoom, tmp_path: Path, hashes: Path
    ) -> None:
        args = MakeArgs("mini", tmp_path / "other", "0-2", check=True)
        made = make_set(args, launch=Bench(tiny))
        assert (made.changed, made.unknown) == ({}, ("2",))
        assert "2 rooms are as the package knows them" in told(made, check=True)
        tree = json.loads(hashes.read_text())
        tree["rooms"]["1"]["truth"] = "0" * 16
        hashes.write_text(json.dumps(tree))
        changed = make_set(args, launch=Bench(tiny))
        assert changed.changed == {"1": ["truth"]}
        assert "room 1 differs in truth" in told(changed, check=True)
        other = make_set(replace(args, out=tmp_path / "third"), launch=Bench(moved(tiny, 0.002)))
        assert sorted(other.changed) == ["0", "1"]

    def test_hashes_of_another_version_are_refused(self, hashes: Path) -> None:
        hashes.write_text(json.dumps({**json.loads(hashes.read_text()), "version": 0}))
        with pytest.raises(InputError, match="no hashes of mini 1"):
            known_hashes("mini")
        with pytest.raises(InputError, match="no hashes of rooms 1"):
            known_hashes("rooms")

    def test_what_is_no_set_is_refused(self, tmp_path: Path) -> None:
        with pytest.raises(InputError, match="SET: 'flats' is none of mini, rooms, two"):
            make_set(MakeArgs("flats", tmp_path))
        with pytest.raises(InputError, match="--workers: -1"):
            make_set(MakeArgs("mini", tmp_path, workers=-1))
        with pytest.raises(InputError, match="--seeds"):
            make_set(MakeArgs("mini", tmp_path, "x"))


class TestSets:
    def test_no_room_is_used_to_choose_and_to_report(self) -> None:
        for name, rooms in SETS.items():
            held, chosen = set(parse_seeds(rooms.seeds)), set(parse_seeds(rooms.development))
            assert held, name
            assert chosen, name
            assert not held & chosen, name
            assert not held & set(range(1000)), "rooms 0 to 999 were looked at"
        assert len(parse_seeds(SETS["rooms"].seeds)) == 30

    def test_the_standard_set_is_what_rooms_have_always_been(self) -> None:
        assert SETS["rooms"].room == RoomConfig()
        assert SETS["rooms"].noise == NoiseConfig()

    def test_sets_that_are_compared_room_by_room_differ_in_the_noise_alone(self) -> None:
        for name in ("wrong-shape", "detected"):
            assert SETS[name].room == SETS["rooms"].room
            assert SETS[name].seeds == SETS["rooms"].seeds
        noise = SETS["wrong-shape"].noise
        assert noise.other_shapes == 1
        assert replace(noise, other_shapes=0.0) == NoiseConfig()

    def test_the_package_knows_the_held_out_rooms_of_the_set_that_is_made_in_seconds(self) -> None:
        known = known_hashes("mini")
        assert {int(seed) for seed in known} == set(parse_seeds(SETS["mini"].seeds))


def test_a_way_keeps_farther_from_furniture_where_it_must(tiny: KnownRoom) -> None:
    bounds = np.array([[-2.4, -5.2], [2.4, -1.8]])
    start, goal = np.array([-1.8, -2.8]), np.array([1.6, -4.6])
    share = np.linspace(0, 1, 50)[:, None]
    for apart in (0.0, 0.15):
        path = way(start, goal, tiny.plan.pieces, bounds, apart)
        dense = np.concatenate([a + share * (b - a) for a, b in itertools.pairwise(path)])
        assert free_of(dense, tiny.plan.pieces, BODY + apart - 0.04).all()


def nearest(room: KnownRoom) -> np.ndarray:
    """Distance of each body's skin to the furniture by winding numbers, 10 cm at most [m]."""
    world = to_world(room.bodies.verts, room.truth.camera.R_cam_world).double().numpy()
    out = np.full(len(world), 0.1)
    for piece in room.truth.objects:
        mesh = place_object(piece)
        verts, faces = mesh.verts.double().numpy(), mesh.faces.numpy()
        low, high = verts.min(0) - 0.1, verts.max(0) + 0.1
        near = ((world > low) & (world < high)).all(-1)
        rows = np.nonzero(near)[0]
        if len(rows):
            np.minimum.at(out, rows, exact(world[near], verts, faces))
    return out


def furniture_in_use(room: KnownRoom) -> set[int]:
    return {k for k in room.touched.unique().tolist() if k >= 0}


def by_id(pieces: tuple[SceneObject, ...]) -> dict[str, SceneObject]:
    return {piece.id: piece for piece in pieces}


@pytest.mark.slow
class TestPromises:
    """One held-out room of each set."""

    def test_mini_is_small_and_has_all_files_for_other_tools(self, tmp_path: Path) -> None:
        job = Job("mini", 1000, MADE, tmp_path)
        make_one(job, captures=True)
        row = json.loads((job.folder / DONE).read_text())
        assert differences(row, known_hashes("mini")["1000"]) == []
        assert 3 <= row["pieces"] <= 5
        assert 40 <= row["frames"] <= 80
        capture = read("folder", job.home / CAPTURE)
        assert (capture.scene.camera.width, capture.scene.camera.height) == (320, 180)
        assert capture.bodies is not None
        assert capture.people is not None
        from mover.io.capture.bodies_file import read_bodies
        from mover.io.capture.scene_file import read_scene

        truth = read_scene(job.home / CAPTURE / "truth" / "scene.json")
        assert {p.id for p in truth.objects} == {p.id for p in capture.scene.objects}
        assert len(read_bodies(job.home / CAPTURE / "truth" / "bodies.npz").frame) == row["frames"]

    def test_in_two_there_are_two_who_do_not_run_into_each_other(self) -> None:
        room = make_room(1003, SETS["two"].room)
        assert set(room.bodies.person.tolist()) == {0, 1}
        assert room.bodies.joints is not None
        places = {
            (f, p): j[0]
            for f, p, j in zip(
                room.bodies.frame.tolist(),
                room.bodies.person.tolist(),
                room.bodies.joints,
                strict=True,
            )
        }
        frames = {f for f, _ in places}
        both = [f for f in frames if (f, 0) in places and (f, 1) in places]
        assert len(both) >= 100
        assert min(float((places[f, 0] - places[f, 1]).norm()) for f in both) > 0.25
        assert len(furniture_in_use(room)) >= 2

    def test_in_free_nobody_touches_anything_but_the_floor(self) -> None:
        room = make_room(1000, SETS["free"].room)
        assert len(room.bodies.frame) >= 150
        assert nearest(room).min() > 0.0499
        assert furniture_in_use(room) == set()
        assert float(room.passing.float().mean()) >= 0.25
        way_walked = room.bodies.verts.mean(1)[:, [0, 2]]
        assert float((way_walked[1:] - way_walked[:-1]).norm(dim=-1).sum()) > 10

    def test_clutter_is_cluttered(self) -> None:
        room = make_room(1000, SETS["clutter"].room)
        hidden, cut = hidden_shares(room.truth), truncated_shares(room.truth)
        assert 9 <= len(room.truth.objects) <= 14
        assert sum(share >= 0.3 for share in hidden) >= 4
        assert sum(share >= 0.1 for share in cut) >= 2
        assert len(furniture_in_use(room)) >= 3
        assert int(room.bodies.frame.max()) + 1 >= 150

    def test_long_is_a_minute_with_many_interactions(self) -> None:
        room = make_room(1000, SETS["long"].room)
        assert int(room.bodies.frame.max()) + 1 == 300
        assert room.bodies.fps == 5
        assert len(furniture_in_use(room)) >= 5

    def test_rooms_are_used_and_their_noise_is_that_of_their_set(self) -> None:
        room = make_room(1000, SETS["rooms"].room)
        true = by_id(room.truth.objects)
        assert 6 <= len(true) <= 9
        assert int(room.bodies.frame.max()) + 1 >= 200
        assert len(furniture_in_use(room)) >= 3
        shapes = spoilt(room, 1000, SETS["wrong-shape"])
        for name, piece in by_id(shapes.capture.scene.objects).items():
            assert piece.category == true[name].category
            same = piece.mesh.verts.shape == true[name].mesh.verts.shape
            assert not same or not torch.allclose(piece.mesh.verts, true[name].mesh.verts)
        missed = invented = renamed = 0
        for seed in range(20):
            given = by_id(spoilt(room, seed, SETS["detected"]).capture.scene.objects)
            missed += len(set(true) - set(given))
            invented += len(set(given) - set(true))
            found = set(true) & set(given)
            renamed += sum(given[k].category != true[k].category for k in found)
        count = 20 * len(true)
        assert 0.04 < missed / count < 0.26
        assert 0.02 < invented / count < 0.2
        assert 0.02 < renamed / count < 0.18


@pytest.mark.slow
def test_the_command_makes_what_mover_evaluate_reads(tmp_path: Path) -> None:
    """The initial scene, taken for a result, is as far from the truth as the noise has put it."""
    job = Job("mini", 1001, MADE, tmp_path)
    make_one(job, captures=True)
    folder, out = job.home / CAPTURE, tmp_path / "result"
    out.mkdir()
    from mover.io.capture.scene_file import read_scene, write_scene

    capture = read("folder", folder)
    for name in ("initial.json", "scene.json"):
        write_scene(capture.scene, out / name)
    metrics = evaluate_folder(out, folder / "truth")
    assert read_scene(out / "scene.json").camera.width == 320
    assert math.degrees(metrics["result"]["pitch_error"]) == pytest.approx(3, abs=1.01)
    assert 0 < metrics["result"]["iou3d"] < 1
