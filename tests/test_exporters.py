"""Exports, read back by other programs or by a few naive lines: everything is where it was."""

import math
from dataclasses import astuple, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from furnished import along_the_axes as along_the_axes  # for every test
from furnished import bodies_of, furnished, moved, moving_pose, similar, two_people, write_out
from little_room import walkers
from make_scenes import four
from test_export import Glb, bounds_of, placed

import mover.io.export.usd
from mover.app.cli import run_command
from mover.bodies.skinning import open_body, zero_pose
from mover.core.errors import InputError
from mover.core.records import rows_of
from mover.core.types import Bodies, BodyPose, Scene
from mover.geometry.placement import place_object, placed_at
from mover.geometry.rotations import axis_angle
from mover.io.export.finished import Finished, keyframes, read_finished
from mover.io.export.posed import export_amass
from mover.io.export.scene_glb import export_glb, export_ply, placement_of
from mover.io.export.usd import export_usd
from mover.io.formats import chosen
from mover.io.people.found import Known
from mover.io.people.tools import amass


def scaled(scene: Scene) -> Scene:
    size, pieces = torch.tensor([1.2, 0.9, 1.1]), enumerate(scene.objects)
    return replace(scene, objects=tuple(replace(p, scale=size + 0.05 * k) for k, p in pieces))


def finished(tmp_path: Path, bodies: Bodies | None = None) -> Finished:
    return read_finished(write_out(tmp_path / "out", scaled(furnished()), bodies))


class Moving(Glb):
    """A naive reader of animated glTF: the formulas of its specification, one node at a time."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        nodes = enumerate(self.tree["nodes"])
        self.parent = {child: k for k, node in nodes for child in node.get("children", [])}

    def named(self, name: str) -> int:
        return next(k for k, n in enumerate(self.tree["nodes"]) if n.get("name") == name)

    def value(self, node: int, path: str, time: float, rest: Any) -> np.ndarray:
        """What a channel says at a time, or the node itself."""
        for animation in self.tree.get("animations", []):
            for channel in animation["channels"]:
                if channel["target"] == {"node": node, "path": path}:
                    found = self.sampled(animation["samplers"][channel["sampler"]], time)
                    return found / np.linalg.norm(found) if path == "rotation" else found
        return np.array(self.tree["nodes"][node].get(path, rest), float)

    def sampled(self, sampler: dict[str, Any], time: float) -> np.ndarray:
        times, values = self.array(sampler["input"]), self.array(sampler["output"])
        values = values.reshape(len(times), -1).astype(float)
        after = int(np.searchsorted(times, time + 1e-6))
        if after == 0 or after == len(times):
            return values[min(after, len(times) - 1)]
        if sampler["interpolation"] == "STEP":
            return values[after - 1]
        share = (time - times[after - 1]) / (times[after] - times[after - 1])
        return (1 - share) * values[after - 1] + share * values[after]

    def matrix(self, node: int | None, time: float) -> np.ndarray:
        if node is None:
            return np.eye(4)
        tree = self.tree["nodes"][node]
        if "matrix" in tree:
            local = np.array(tree["matrix"]).reshape(4, 4).T
        else:
            x, y, z, w = self.value(node, "rotation", time, [0, 0, 0, 1])
            turn = trimesh.transformations.quaternion_matrix([w, x, y, z])[:3, :3]
            size = self.value(node, "scale", time, [1, 1, 1])
            local = four(turn * size, self.value(node, "translation", time, [0, 0, 0]))
        return self.matrix(self.parent.get(node), time) @ local

    def skinned(self, name: str, time: float) -> np.ndarray:
        node = self.tree["nodes"][self.named(name)]
        part = self.tree["meshes"][node["mesh"]]["primitives"][0]["attributes"]
        keys = ("POSITION", "JOINTS_0", "WEIGHTS_0")
        verts, joints, weights = (self.array(part[key]) for key in keys)
        skin = self.tree["skins"][node["skin"]]
        inverse = self.array(skin["inverseBindMatrices"]).reshape(-1, 4, 4).transpose(0, 2, 1)
        moves = np.stack([self.matrix(j, time) for j in skin["joints"]]) @ inverse
        flat = np.concatenate([verts, np.ones((len(verts), 1))], 1)
        blend = (weights[..., None, None] * moves[joints]).sum(1)
        return (blend @ flat[..., None])[:, :3, 0]

    def morphed(self, name: str, time: float) -> np.ndarray:
        node = self.named(name)
        part = self.tree["meshes"][self.tree["nodes"][node]["mesh"]]["primitives"][0]
        verts = self.array(part["attributes"]["POSITION"]).astype(float)
        weights = self.value(node, "weights", time, [])
        for weight, target in zip(weights, part.get("targets", []), strict=True):
            verts = verts + weight * self.array(target["POSITION"])
        flat = np.concatenate([verts, np.ones((len(verts), 1))], 1)
        return (flat @ self.matrix(node, time).T)[:, :3]


def rows(bodies: Bodies, person: int) -> list[tuple[int, float]]:
    first = int(bodies.frame.min())
    found = (bodies.person == person).nonzero()[:, 0].tolist()
    return [(k, (int(bodies.frame[k]) - first) / (bodies.fps or 5.0)) for k in found]


def miss(found: np.ndarray, verts: torch.Tensor) -> float:
    """Largest distance between vertices [m]."""
    return float(np.linalg.norm(found - verts.numpy(), axis=1).max())


@pytest.fixture(scope="module")
def two(tmp_path_factory):
    """Two people, and their export on bones."""
    folder, bodies = tmp_path_factory.mktemp("two"), two_people()
    return bodies, export_glb(finished(folder, bodies), folder)


@pytest.mark.parametrize("person", [0, 1])
def test_bones_carry_the_skin_to_the_result_in_every_frame(two, person):
    bodies, found = two
    glb, name = Moving(found.files[0]), f"person_{person}_body"
    worst = max(miss(glb.skinned(name, t), bodies.verts[k]) for k, t in rows(bodies, person))
    assert worst < 0.006  # four weights a vertex, where the model has six
    assert f"{1e3 * worst:.0f} mm" in " ".join(found.notes) or person == 1


def test_a_person_is_hidden_while_they_are_not_seen(two):
    bodies, glb = two[0], Moving(two[1].files[0])
    seen = [t for _, t in rows(bodies, 1)]
    gap = int(np.argmax(np.diff(seen)))
    for time, size in ((0.0, 0.0), (seen[0], 1.0), (seen[gap], 1.0), (seen[gap] + 1.5, 0.0)):
        assert np.ptp(glb.skinned("person_1_body", time), axis=0).max() > 0.5 or size == 0.0
        assert glb.matrix(glb.named("person_1"), time)[0, 0] == size
    assert glb.matrix(glb.named("person_0"), 0.0)[0, 0] == 1.0


def test_shapes_are_the_result_at_the_keys_and_near_it_between(tmp_path):
    bodies = bodies_of(moving_pose(30, pace=0.1))
    glb = Moving(export_glb(finished(tmp_path, bodies), tmp_path, "morph").files[0])
    off = [miss(glb.morphed("person_0_body", t), bodies.verts[k]) for k, t in rows(bodies, 0)]
    keys = len(glb.tree["meshes"][-1]["primitives"][0]["targets"]) + 1
    assert sum(v < 1e-5 for v in off) >= keys
    assert max(off) < 0.0055
    assert keys < 30


def test_bodies_without_parameters_still_move_and_have_no_bones_and_no_parameters(tmp_path):
    bodies = walkers(20, people=2)
    home = finished(tmp_path, bodies)
    found = export_glb(home, tmp_path)
    k, t = rows(bodies, 1)[-1]
    assert miss(Moving(found.files[0]).morphed("person_1_body", t), bodies.verts[k]) < 1e-5
    assert "--capture" in " ".join(found.notes)
    with pytest.raises(InputError, match="--body skin"):
        export_glb(home, tmp_path, "skin")
    with pytest.raises(InputError, match="--capture"):
        export_amass(home, tmp_path)


def test_parameters_of_the_capture_move_bodies_that_were_turned_and_sized(tmp_path):
    truth, scene = two_people(), scaled(furnished())
    grown = similar(truth, 1.03)
    result, given = replace(grown, space="world"), replace(truth, space="camera")
    home = Finished(write_out(tmp_path / "out", scene), scene, result, given)
    glb = Moving(export_glb(home, tmp_path).files[0])
    k, t = rows(result, 1)[3]
    assert miss(glb.skinned("person_1_body", t), result.verts[k]) < 0.006
    arrays = np.load(export_amass(home, tmp_path).files[1])
    assert arrays["size"] == pytest.approx(1.03, abs=1e-4)


def test_trimesh_opens_the_file_with_the_objects_in_place(tmp_path):
    home = finished(tmp_path, two_people(4))
    (file,) = export_glb(home, tmp_path).files
    for piece in home.scene.objects:
        assert placed(file, piece.id).bounds == pytest.approx(bounds_of(piece), abs=1e-5)


@pytest.mark.parametrize("people", [False, True])
def test_an_object_that_is_moved_jumps_to_its_next_place(tmp_path, people):
    home = finished(tmp_path, two_people(4) if people else None)
    scene = moved(home.scene, 8)
    glb = Moving(export_glb(replace(home, scene=scene), tmp_path).files[0])
    first, step = 0, 0.2
    if home.bodies is not None and home.bodies.fps is not None:
        first, step = int(home.bodies.frame.min()), 1 / home.bodies.fps
    assert first < 7
    for frame in (first, 7, 8, 20):
        for one in scene.objects:
            found = glb.matrix(glb.named(one.id), (frame - first) * step + 1e-4)
            assert found == pytest.approx(placement_of(placed_at(one, frame)), abs=1e-5)


def test_no_frame_between_keys_is_farther_off_than_is_said_and_few_keys_are_few():
    verts = bodies_of(moving_pose(60)).verts
    time = torch.linspace(0, 4, 60).double().square()  # uneven
    keys, off = keyframes(verts, time, 0.004, 1000)
    seen = verts[:, :: max(1, verts.shape[1] // 300)].numpy()
    worst = 0.0
    for k in range(60):
        b = next(i for i in keys if i >= k)
        a = max(i for i in keys if i <= k)
        share = 0.0 if a == b else float((time[k] - time[a]) / (time[b] - time[a]))
        line = seen[a] + share * (seen[b] - seen[a])
        worst = max(worst, float(np.linalg.norm(line - seen[k], axis=1).max()))
    assert worst == pytest.approx(off, abs=1e-6)
    assert off <= 0.004
    assert (keys[0], keys[-1]) == (0, 59)
    few, off = keyframes(verts, time, 0.0, 7)
    assert len(few) == 7
    assert off > 0


@pytest.mark.parametrize("up", ["y", "z"])
def test_the_parameters_give_the_bodies_back(tmp_path, up):
    bodies = two_people()
    found = export_amass(finished(tmp_path, bodies), tmp_path, up)
    names = ["amass_0.npz", "amass_1_000014.npz", "amass_1_000056.npz"]  # the second leaves between
    assert [file.name for file in found.files] == names
    for file in found.files:
        arrays = np.load(file)
        angles = torch.from_numpy(arrays["poses"])
        count = len(angles)
        assert angles.shape == (count, 165)
        assert np.array_equal(arrays["root_orient"], arrays["poses"][:, :3])
        assert np.array_equal(arrays["pose_hand"], arrays["poses"][:, 75:])
        pose = BodyPose(
            "makehuman", "neutral", torch.from_numpy(arrays["betas"]).float().expand(count, -1),
            angles[:, :3], angles[:, 3:66], torch.from_numpy(arrays["trans"]),
            {"left_hand_pose": angles[:, 75:120], "right_hand_pose": angles[:, 120:]},
        )  # fmt: skip
        rows = torch.isin(bodies.frame, torch.from_numpy(arrays["frame"]))
        truth = bodies.verts[rows & (bodies.person == int(arrays["person"]))]
        if up == "z":
            x, y, z = truth.unbind(-1)
            truth = torch.stack([x, -z, y], -1)
        assert float((open_body().posed(pose)[0] - truth).norm(dim=-1).max()) < 1e-4
        assert arrays["mocap_framerate"] == 5.0  # every second frame of 10 a second
    again = amass(tmp_path, Known())
    parts = [(p.track, p.fields.get("frames").value.tolist()) for p in again]
    there = [bodies.frame[bodies.person == p] for p in (0, 1)]
    assert parts == [(0, there[0].tolist()), *((1, f.tolist()) for f in there[1].tensor_split(2))]


def test_a_motion_has_equal_steps_and_frames_between_its_rows_lie_between(tmp_path, capsys):
    """A walk of 100 frames at a constant pace that turns, without three short spans."""
    kept = torch.tensor([k for k in range(100) if k not in (3, 10, 11, 12, 50, 51)])
    pose = zero_pose(100, open_body())
    root = torch.stack([torch.arange(100) * n for n in (0.0, 0.06, 0.0)], -1)  # past half a turn
    pose = replace(pose, global_orient=root, transl=root * 0.5)
    every = replace(bodies_of(pose), frame=torch.arange(100))
    few = replace(rows_of(every, kept), fps=None)
    out = write_out(tmp_path / "out", furnished(("chair",)), few)
    assert run_command("export", [str(out), "--to", "amass"]) == 0
    said = capsys.readouterr().out
    assert "6 frames without the person interpolated" in said
    assert "no frame rate ('fps'): 5 frames a second are assumed" in said
    arrays = np.load(out / "export" / "amass_0.npz")
    assert (arrays["frame"] == np.arange(100)).all()
    assert arrays["trans"] == pytest.approx(pose.transl.numpy(), abs=1e-5)
    turns = axis_angle(torch.from_numpy(arrays["root_orient"]))
    assert float((turns - axis_angle(root)).abs().max()) < 1e-5
    (person,) = amass(out / "export", Known())
    matrix = person.fields.get("turn").value.reshape(3, 3)
    assert (matrix == np.eye(3)).all()


def test_single_objects_stand_in_the_world(tmp_path):
    home = finished(tmp_path)
    files = export_ply(home, tmp_path).files
    for piece, file in zip(home.scene.objects, files, strict=True):
        assert file.name == f"{piece.id}.ply"
        found = trimesh.load_mesh(file)
        truth = trimesh.Trimesh(*(x.numpy() for x in astuple(place_object(piece))))
        assert found.bounds == pytest.approx(bounds_of(piece), abs=1e-5)
        assert found.area == pytest.approx(truth.area, rel=1e-4)


def test_the_command_writes_what_is_asked_for(tmp_path, capsys):
    out = write_out(tmp_path / "out", furnished(("chair",)), bodies_of(moving_pose(3)))
    assert run_command("export", [str(out), "--to", "glb", "ply", "amass"]) == 0
    names = {p.name for p in (out / "export").rglob("*") if p.is_file()}
    assert {"scene.glb", "chair_0.ply", "amass_0.npz"} <= names
    assert "on bones" in capsys.readouterr().out


def test_without_usd_core_the_way_to_get_it_is_said_and_the_rest_is_written(
    tmp_path, monkeypatch, capsys
):
    monkeypatch.setattr(mover.io.export.usd, "find_spec", lambda _: None)
    with pytest.raises(InputError, match=r"\.\[usd\]"):
        export_usd(finished(tmp_path), tmp_path)
    out = write_out(tmp_path / "out", furnished(("chair",)))
    assert run_command("export", [str(out), "--to", "usd", "ply"]) == 2
    assert ".[usd]" in capsys.readouterr().err
    assert list(out.rglob("chair_0.ply"))


def test_a_second_export_gives_the_same_bytes(tmp_path):
    home = finished(tmp_path, two_people(5))
    for name in ("glb", "ply", "amass"):
        one = chosen("--to", name, "export")(home, tmp_path / "a").files
        two = chosen("--to", name, "export")(home, tmp_path / "b").files
        assert [f.read_bytes() for f in one] == [f.read_bytes() for f in two]


def test_angles_turn_back(tmp_path):
    """Quaternions of neighbouring frames are on one side, so that viewers turn the short way."""
    pose = moving_pose(40)
    spin = torch.linspace(0, 4 * math.pi, 40)
    pose = replace(pose, global_orient=torch.stack([0 * spin, spin, 0 * spin], -1))
    glb = Moving(export_glb(finished(tmp_path, bodies_of(pose)), tmp_path).files[0])
    animation = glb.tree["animations"][0]
    for channel in animation["channels"]:
        if channel["target"]["path"] == "rotation":
            values = glb.array(animation["samplers"][channel["sampler"]]["output"])
            assert ((values[1:] * values[:-1]).sum(1) > 0).all()
