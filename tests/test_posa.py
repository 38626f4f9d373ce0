"""POSA's network on synthetic weights in the true layout; spirals; contact files."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from make_smpl import open_person
from scipy import sparse
from test_readers_people import Toy
from tiny_capture import write_capture

from mover.bodies import BODY_MODELS
from mover.bodies.posa import canonical, decode, load_posa, neighbours, posa_contacts, spirals
from mover.core.errors import InputError
from mover.core.types import Bodies, BodyPose
from mover.geometry.rotations import axis_angle, rot_y
from mover.io.capture.bodies_file import read_contacts
from mover.io.capture.folder import read_capture
from mover.io.capture.pose_file import into_camera
from mover.pipeline.refine import find_posa

OCTAHEDRON = np.array(
    [[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]]
)
CORNERS = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1.0]])


def sphere(level):
    """A closed sphere, wound outwards."""
    shape = trimesh.creation.icosphere(level)
    return np.array(shape.vertices), np.array(shape.faces)


def shapes(channels):
    """Names and shapes of the published network's numbers."""
    first = 36 if channels == 1 else 414
    en, de = "encoder.en_spiral", "decoder.de_spiral"
    dense = {f"{en}.0": (64, first), **{f"{en}.{k}": (64, 576) for k in (1, 3, 5)}}
    dense |= {f"{de}.0": (128, 259), f"{de}.1": (64, 128)}
    dense |= {f"{de}.{k}": (64, 576) for k in (2, 3, 4)}
    found = {}
    for name, shape in dense.items():
        found |= {f"{name}.conv.layer.weight": shape, f"{name}.conv.layer.bias": shape[:1]}
        found |= {f"{name}.norm.weight": shape[:1], f"{name}.norm.bias": shape[:1]}
    plain = {f"{de}.5.layer": (channels, 576), "encoder.en_fc.0.lin": (512, 2624),
             "encoder.en_mu": (256, 512), "encoder.en_log_var": (256, 512)}  # fmt: skip
    for name, shape in plain.items():
        found |= {f"{name}.weight": shape, f"{name}.bias": shape[:1]}
    return found | {"encoder.en_fc.0.norm.weight": (512,), "encoder.en_fc.0.norm.bias": (512,)}


def write_checkpoint(path, channels=1):
    draw = np.random.default_rng(0)
    state = {
        n: torch.from_numpy(draw.normal(0, 0.1, s)).float() for n, s in shapes(channels).items()
    }
    torch.save({"epoch": 3, "model_state_dict": state, "optimizer_state_dict": {}}, path)
    return state


def write_meshes(folder):
    """Matrices and a coarse mesh of the true sizes; `up` repeats the nearest kept vertex."""
    folder.mkdir()
    counts = (10475, 2619, 655)
    verts, faces = sphere(3)
    verts = np.concatenate([verts, np.random.default_rng(1).normal(size=(655 - len(verts), 3))])
    lines = [f"v {x} {y} {z}" for x, y, z in verts] + [f"f {a} {b} {c}" for a, b, c in faces + 1]
    (folder / "mesh_2.obj").write_text("\n".join(lines))
    for level in (1, 2):
        many, few = counts[level - 1], counts[level]
        keep = np.linspace(0, many - 1, few).astype(int)
        down = sparse.csc_matrix((np.ones(few), (np.arange(few), keep)), (few, many))
        near = np.abs(np.arange(many)[:, None] - keep).argmin(1)
        up = sparse.csc_matrix((np.ones(many), (np.arange(many), near)), (many, few))
        sparse.save_npz(folder / f"D_{level}.npz", down)
        sparse.save_npz(folder / f"U_{level}.npz", up)


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("posa")
    write_meshes(folder / "mesh_ds")
    write_checkpoint(folder / "contact.pt")
    return folder


@pytest.fixture
def posa(files):
    return load_posa(files / "contact.pt", files / "mesh_ds")


def smplx_people(turn=(0.0, 0.4, 0.0)):
    verts = np.resize(open_person()[0], (10475, 3))
    verts = torch.from_numpy(verts).float() @ axis_angle(torch.tensor(turn)).mT
    pose = BodyPose("smplx", "neutral", torch.zeros(1, 10), torch.tensor([turn]),
                    torch.zeros(1, 63), torch.zeros(1, 3), {})  # fmt: skip
    return Bodies(verts[None], torch.tensor([[0, 1, 2]]), torch.zeros(1, 1, 3), ("pelvis",),
                  torch.tensor([0]), torch.tensor([0]), 5.0, "world", pose)  # fmt: skip


@pytest.mark.parametrize("shuffled", [False, True])
def test_neighbours_go_round_clockwise_and_are_those_of_the_faces(shuffled):
    verts, faces = sphere(2)
    if shuffled:
        faces = np.random.default_rng(4).permutation(faces)
    mesh, left_out = neighbours(faces, len(verts))
    assert left_out == 0
    for v in range(len(verts)):
        around = mesh[v]
        assert set(around) == set(faces[(faces == v).any(1)].ravel()) - {v}
        assert len(around) == len(set(around))
        turn = 0.0
        for a, b in zip(around, around[1:] + around[:1], strict=True):
            turn += np.cross(verts[a] - verts[v], verts[b] - verts[v]) @ verts[v]
        assert turn < 0, "seen from outside the neighbours follow each other clockwise"


def test_a_branching_triangle_is_left_out():
    mesh, left_out = neighbours(np.concatenate([OCTAHEDRON, [[0, 2, 1]]]), 6)
    assert left_out == 1
    assert all(len(mesh[v]) == 4 for v in range(6))


def test_an_open_fan_begins_at_its_border():
    mesh, _ = neighbours(np.array([[0, 1, 2], [0, 2, 3], [0, 3, 4]]), 5)
    assert mesh[0] == [4, 3, 2, 1]
    assert mesh[2] in ([3, 0, 1], [1, 0, 3])


def test_spirals_go_outwards_ring_by_ring():
    verts, faces = sphere(2)
    rows = spirals(verts, faces, 9)
    mesh, _ = neighbours(faces, len(verts))
    for v in range(20, 60):
        ring = mesh[v]
        assert rows[v, 0] == v
        assert rows[v, 1 : len(ring) + 1].tolist() == ring[:8]
        outer = {n for r in ring for n in mesh[r]} - {v, *ring}
        assert set(rows[v, len(ring) + 1 :]) <= outer
        assert len(set(rows[v])) == 9


def test_where_rings_end_the_nearest_vertices_stand_instead():
    rows = spirals(CORNERS, OCTAHEDRON, 5)
    assert (np.sort(spirals(CORNERS, OCTAHEDRON, 6), 1) == np.arange(6)).all()
    assert (rows[:, 0] == np.arange(6)).all()
    lonely = np.concatenate([CORNERS, [[9.0, 0, 0]]])
    assert spirals(lonely, OCTAHEDRON, 3)[6].tolist() == [6, 0, 2]


def test_a_frontal_person_lies_in_posas_axes():
    points = torch.tensor([[[0.3, 0.0, 0.0], [0.0, 0.5, 0.0], [0.0, 0.0, 0.2]]])
    expected = torch.tensor([[[0.3, 0, 0], [0, -0.5, 0], [0, 0, -0.2]]])
    for angle in (0.0, 1.0, -2.5):
        turn = rot_y(torch.tensor([angle]))
        found = canonical(points @ turn[0].mT, torch.zeros(1, 3), turn)
        torch.testing.assert_close(found, expected, atol=1e-6, rtol=0)


def test_who_bends_forward_keeps_the_tilt_but_not_the_heading():
    lean = axis_angle(torch.tensor([[0.6, 0.0, 0.0]]))
    head = torch.tensor([[[0.0, 0.5, 0.0]]])
    one, two = (
        canonical(head @ (rot_y(torch.tensor(a)) @ lean[0]).mT, torch.zeros(1, 3),
                  rot_y(torch.tensor(a))[None] @ lean)
        for a in (0.0, 2.0)
    )  # fmt: skip
    torch.testing.assert_close(one, two, atol=1e-6, rtol=0)
    expected = [0.0, -0.5 * np.cos(0.6), -0.5 * np.sin(0.6)]
    torch.testing.assert_close(one[0, 0], torch.tensor(expected).float(), atol=1e-6, rtol=0)


def test_synthetic_weights_in_the_true_layout_run(files, caplog):
    posa = load_posa(files / "contact.pt", files / "mesh_ds")
    assert "not the official one" in caplog.text
    bodies = smplx_people()
    found = posa_contacts(posa, bodies)
    assert found.shape == (1, 10475)
    assert ((found >= 0) & (found <= 1)).all()
    assert found.std() > 1e-3
    assert torch.equal(found, posa_contacts(posa, bodies))
    turned = posa_contacts(posa, smplx_people((0.0, -2.0, 0.0)))
    torch.testing.assert_close(turned, found, atol=1e-4, rtol=0)


def test_bodies_in_a_cameras_axes_are_upright_by_its_tilt(files, tmp_path, monkeypatch):
    monkeypatch.setitem(BODY_MODELS, "smplx", lambda _: Toy("smplx"))
    write_capture(tmp_path / "c")
    capture, people = read_capture(tmp_path / "c"), smplx_people()
    paths = files / "contact.pt", files / "mesh_ds", 0
    wanted = posa_contacts(load_posa(*paths[:2]), people)
    in_camera = into_camera(people, capture.scene.camera.R_cam_world)
    found = find_posa(in_camera, *paths, tmp_path / "c" / "camera.json")
    torch.testing.assert_close(found, wanted, atol=1e-4, rtol=0)
    other = find_posa(replace(in_camera, space="world"), *paths, None)
    assert (other - wanted).abs().max() > 1e-3
    with pytest.raises(InputError, match=r"in the camera's axes; --camera must say where up is"):
        find_posa(in_camera, *paths, None)


def test_samples_average_random_codes(posa):
    bodies = smplx_people()
    drawn = posa_contacts(posa, bodies, 3, seed=1)
    assert torch.equal(drawn, posa_contacts(posa, bodies, 3, seed=1))
    assert not torch.equal(drawn, posa_contacts(posa, bodies, 3, seed=2))


def test_the_decoder_is_the_published_one_layer_by_layer(posa):
    draw = np.random.default_rng(5)
    x = torch.from_numpy(draw.normal(size=(2, 655, 3))).float()
    z = torch.from_numpy(draw.normal(size=256)).float()
    w = posa.weights
    h = np.concatenate([x.numpy(), np.broadcast_to(z.numpy(), (2, 655, 256))], -1)
    for layer in range(6):
        name = f"decoder.de_spiral.{layer}" + (".conv" if layer < 5 else "") + ".layer"
        if layer > 1:
            h = np.stack([h[:, posa.spirals[:, k]] for k in range(9)], 2).reshape(2, 655, -1)
        h = h @ w[f"{name}.weight"].numpy().T + w[f"{name}.bias"].numpy()
        if layer == 5:
            break
        groups = h.reshape(2, 655, 8, -1)
        mean = groups.mean((1, 3), keepdims=True)
        groups = (groups - mean) / np.sqrt(groups.var((1, 3), keepdims=True) + 1e-5)
        norm = f"decoder.de_spiral.{layer}.norm"
        h = groups.reshape(h.shape) * w[f"{norm}.weight"].numpy() + w[f"{norm}.bias"].numpy()
        h = np.maximum(h, 0)
    np.testing.assert_allclose(decode(posa, x, z).numpy(), 1 / (1 + np.exp(-h)), atol=1e-4)


def test_semantic_weights_have_their_own_count(files, tmp_path):
    state = write_checkpoint(tmp_path / "contact_semantics.pt", 43)
    assert sum(v.numel() for v in state.values()) == 1_923_435
    posa = load_posa(tmp_path / "contact_semantics.pt", files / "mesh_ds")
    assert posa.channels == 43
    assert posa_contacts(posa, smplx_people()).shape == (1, 10475)


def test_other_networks_and_bodies_are_refused(files, posa, tmp_path):
    state = write_checkpoint(tmp_path / "a.pt")
    state["extra"] = torch.zeros(3)
    torch.save({"model_state_dict": state}, tmp_path / "b.pt")
    (tmp_path / "c.pt").write_text("no")
    meshes = files / "mesh_ds"
    for name, folder, words in (
        ("b.pt", meshes, "1875012 numbers"), ("c.pt", meshes, "broken torch file"),
        ("a.pt", tmp_path, r"mesh_2\.obj"),
    ):  # fmt: skip
        with pytest.raises(InputError, match=words):
            load_posa(tmp_path / name, folder)
    bodies = smplx_people()
    for error, words, change in (
        (InputError, "meshes only", {"pose": None}),
        (InputError, "100 vertices", {"verts": bodies.verts[:, :100]}),
        (ValueError, "camera", {"space": "camera"}),
    ):
        with pytest.raises(error, match=words):
            posa_contacts(posa, replace(bodies, **change))


def test_contacts_of_files_are_matched_by_frame(tmp_path):
    one = smplx_people()
    bodies = replace(one, verts=one.verts[:, :5].repeat(2, 1, 1), frame=torch.tensor([4, 2]),
                     person=torch.tensor([0, 0]), pose=None, joints=None)  # fmt: skip
    for frame in (2, 4):
        np.save(tmp_path / f"{frame + 1:06d}_sample_00.npy", np.full((5, 1), frame / 10))
    found = read_contacts(tmp_path, bodies, first=1)
    assert found[:, 0].tolist() == pytest.approx([0.4, 0.2])
    with pytest.raises(InputError, match="no file for frame 2"):
        read_contacts(tmp_path, bodies)
    np.savez(tmp_path / "deco.npz", contact_label=np.eye(2, 5), pose=np.zeros(3))
    assert read_contacts(tmp_path / "deco.npz", bodies).tolist() == np.eye(2, 5).tolist()
    np.save(tmp_path / "wrong.npy", np.zeros((2, 6)))
    with pytest.raises(InputError, match=r"shape \(2, 5\)"):
        read_contacts(tmp_path / "wrong.npy", bodies)
    np.save(tmp_path / "objects.npy", np.array([{}], dtype=object), allow_pickle=True)
    with pytest.raises(InputError, match="pickled"):
        read_contacts(tmp_path / "objects.npy", bodies)
