"""Labels of contact: a part of the body, an object, a place on its surface, its normal."""

from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from furnished import bodies_of, furnished, write_out
from little_room import GROUND, box

from mover.app.cli import run_command
from mover.bodies.parts import PARTS, members, parts_of
from mover.bodies.skinning import open_body, zero_pose
from mover.core.errors import InputError
from mover.core.types import Bodies, ContactLabels, Mesh
from mover.geometry.nearest import to_surface
from mover.geometry.placement import StandingMesh
from mover.io.export.contacts import export_contacts, read_labels, write_labels
from mover.io.export.finished import read_finished
from mover.stages.contacts.label_contacts import LabelInputs, label_contacts


def standing(frames: int = 6) -> Bodies:
    """Somebody in the T-pose with both soles on the floor."""
    bodies = bodies_of(zero_pose(frames, open_body()))
    lift = GROUND - float(bodies.verts[..., 1].min())
    up = torch.tensor([0.3, lift, -3.0])
    return replace(bodies, verts=bodies.verts + up, joints=bodies.joints + up, pose=None)


def labelled(bodies: Bodies, *meshes: Mesh, floor: float | None = GROUND) -> ContactLabels:
    ids = tuple(f"box_{k}" for k in range(len(meshes)))
    stands = tuple((StandingMesh(mesh),) for mesh in meshes)
    return label_contacts(LabelInputs(bodies, parts_of(bodies), stands, ids, floor))


def shelf_beside(bodies: Bodies, side: str, gap: float) -> Mesh:
    """A box whose top is so far below the lowest vertex of a palm."""
    palm = bodies.verts[0, members(parts_of(bodies), f"{side}_palm")]
    low = float(palm[:, 1].min())
    x, z = (float(v) for v in palm[:, [0, 2]].mean(0))
    mesh = box(0.6, 0.3, 0.6)
    return Mesh(mesh.verts + torch.tensor([x, low - gap - 0.3, z]), mesh.faces)


def chosen(labels: ContactLabels, part: str, thing: str) -> torch.Tensor:
    return (labels.part == PARTS.index(part)) & (labels.object == labels.objects.index(thing))


def test_soles_stand_on_the_floor_and_nothing_else_touches_it():
    bodies = standing()
    labels = labelled(bodies)
    assert labels.objects == ("ground",)
    assert set(labels.part.tolist()) == {PARTS.index("left_sole"), PARTS.index("right_sole")}
    assert sorted(labels.frame.tolist()) == sorted(2 * bodies.frame.tolist())
    assert labels.position[:, 1].tolist() == pytest.approx([GROUND] * len(labels.frame))
    assert torch.equal(labels.normal, torch.tensor([[0.0, 1, 0]]).expand(len(labels.frame), 3))
    assert float(labels.confidence.min()) > 0.8
    left = labels.position[chosen(labels, "left_sole", "ground")]
    ankle = bodies.joints[0, bodies.joint_names.index("left_ankle")]
    assert float((left - ankle)[:, [0, 2]].norm(dim=-1).max()) < 0.15


@pytest.mark.parametrize("gap", [0.005, -0.03])
def test_a_hand_over_a_box_touches_its_top(gap):
    bodies = standing()
    shelf = shelf_beside(bodies, "left", gap)
    labels = labelled(bodies, shelf)
    mine = chosen(labels, "left_palm", "box_0")
    assert int(mine.sum()) == len(bodies.frame)
    assert labels.gap[mine].tolist() == pytest.approx([gap] * int(mine.sum()), abs=0.004)
    away = to_surface(labels.position[mine], shelf.verts, shelf.faces)
    assert float(away.max()) < 0.01
    assert labels.normal[mine][:, 1].min() > 0.9
    assert not chosen(labels, "right_palm", "box_0").any()


def test_the_nearer_the_surer_and_what_is_far_is_no_touch():
    bodies, sure = standing(2), []
    for gap in (0.01, 0.03, 0.045, 0.08):
        labels = labelled(bodies, shelf_beside(bodies, "right", gap))
        mine = chosen(labels, "right_palm", "box_0")
        sure.append(float(labels.confidence[mine].max()) if mine.any() else 0.0)
    assert sure == sorted(sure, reverse=True)
    assert sure[0] > 0.35
    assert sure[-1] == 0.0


def test_an_inverted_mesh_is_no_different_and_an_unknown_floor_is_not_touched():
    bodies = standing(2)
    shelf = shelf_beside(bodies, "left", -0.03)
    straight = labelled(bodies, shelf, floor=None)
    turned = labelled(bodies, Mesh(shelf.verts, shelf.faces.flip(-1)), floor=None)
    assert torch.equal(straight.gap, turned.gap)
    assert torch.equal(straight.normal, turned.normal)
    assert len(straight.gap)
    assert straight.objects.index("ground") not in straight.object


def out_with_labels(tmp_path: Path) -> tuple[Path, ContactLabels]:
    bodies = standing()
    out = write_out(tmp_path / "out", furnished(("table",)), bodies)
    labels = labelled(bodies, shelf_beside(bodies, "left", 0.01))
    write_labels(labels, out / "contacts.npz")
    return out, labels


@pytest.mark.parametrize("up", ["y", "z"])
def test_tables_hold_each_label_at_its_frame_part_and_object(tmp_path, up):
    out, labels = out_with_labels(tmp_path)
    (file,) = export_contacts(read_finished(out), tmp_path, up).files
    data = np.load(file)
    frames, parts, things = data["contact"].shape
    assert (parts, things) == (len(data["parts"]), len(data["objects"]))
    assert data["objects"].tolist() == ["box_0", "ground"]
    assert data["object_contact"].shape == (frames, things)
    seen = np.zeros_like(data["contact"], dtype=bool)
    for k in range(len(labels.frame)):
        row = data["frame"].tolist().index(int(labels.frame[k]))
        at = row, int(labels.part[k]), int(labels.object[k])
        seen[at] = True
        x, y, z = labels.position[k].tolist()
        truth = (x, y, z) if up == "y" else (x, -z, y - GROUND)
        assert data["contact"][at] == pytest.approx(float(labels.confidence[k]))
        assert data["position"][at] == pytest.approx(truth, abs=1e-5)
        assert np.linalg.norm(data["normal"][at]) == pytest.approx(1, abs=1e-4)
    assert (data["contact"][~seen] == 0).all()
    assert np.isnan(data["position"][~seen]).all()
    assert np.array_equal(data["object_contact"], (data["contact"] >= 0.5).any(1))


def test_a_result_without_labels_says_what_writes_them(tmp_path, capsys):
    out = write_out(tmp_path / "out", furnished(("table",)), standing(2))
    assert run_command("export", [str(out), "--to", "contacts"]) == 2
    assert "`mover run` writes it" in capsys.readouterr().err


def test_labels_come_back_from_their_file_and_a_wrong_one_is_refused(tmp_path):
    out, labels = out_with_labels(tmp_path)
    again = read_labels(out / "contacts.npz")
    for field in fields(ContactLabels):
        same = getattr(labels, field.name) == getattr(again, field.name)
        assert same if isinstance(same, bool) else same.all(), field.name
    with np.load(out / "contacts.npz") as data:
        arrays = dict(data)
    for wrong, words in (
        ({**arrays, "normal": arrays["normal"][:, :2]}, "field 'normal' has shape .* expected"),
        ({"probability": np.zeros((2, 3))}, "lacks frame"),
    ):
        np.savez(out / "contacts.npz", **wrong)
        with pytest.raises(InputError, match=rf"contacts\.npz: {words}"):
            read_labels(out / "contacts.npz")
