"""People from today's tools: joints fall on their pixels, left stays left."""

import json
import os
import pickle
import re
import types
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import make_people as made
import make_smpl
import numpy as np
import pytest
import tiny_capture as tiny
import torch
import trimesh
from test_safe_pickle import BOMBS, Calls

from mover.app import cli
from mover.bodies import BODY_MODELS, load_model
from mover.bodies.keypoints import LAYOUTS
from mover.bodies.skeleton import JOINTS
from mover.core.errors import InputError
from mover.core.types import BodyPose
from mover.geometry.camera import project
from mover.io.capture.bodies_file import odd_bodies, read_bodies, write_bodies
from mover.io.capture.camera_file import camera_of
from mover.io.capture.pose_file import into_camera
from mover.io.files.fields import At
from mover.io.formats import names
from mover.io.people.bodies import bodies_from
from mover.io.people.found import Known
from mover.io.people.keypoints import keypoints_from, read_keypoints, write_keypoints

joblib = pytest.importorskip("joblib", reason="the fixtures are written by joblib, as the tools do")

CAMERA = camera_of(At(made.camera_json(), "camera.json"))
KNOWN = Known(camera=CAMERA)


@dataclass(frozen=True)
class Case:
    """What is true of a tool's files beside the person in them."""

    needed: str
    """A field without which they are refused."""
    model: str = "smpl"
    gapless: bool = False
    """Its rows are all frames of a video."""
    focal: float | None = None
    """The lens that it assumes, about the image's middle [px]; None: the true one, or none."""


DIAGONAL = float(np.hypot(made.WIDTH, made.HEIGHT))
CASES = {
    "4dhumans": Case("body_pose", focal=25000), "phalp": Case("smpl", focal=25000),
    "amass": Case("poses", "smplh", gapless=True),
    "amass:smplx": Case("trans", "smplx", gapless=True),
    "gem": Case("body_params_incam", "smplx", gapless=True, focal=DIAGONAL),
    "gvhmr": Case("transl", "smplx", gapless=True, focal=DIAGONAL),
    "pare": Case("pose"), "pare:images": Case("orig_cam"), "vibe": Case("betas"),
    "prompthmr": Case("trans", "smplx", focal=1500),
    "prox": Case("global_orient", "smplx"), "smplifyx": Case("body_pose", "smplx", focal=5000),
    "sam3dbody": Case("pred_cam_t", "smplx"), "slahmr": Case("pose_body", "smplh"),
    "tram": Case("pred_trans", focal=900),
    "wham": Case("betas", focal=DIAGONAL),
}  # fmt: skip


@dataclass(frozen=True)
class Toy:
    """The fixtures' body as a model of the package."""

    name: str

    @property
    def faces(self) -> torch.Tensor:
        return torch.from_numpy(made.flesh(self.name)[2])

    @property
    def joint_names(self) -> tuple[str, ...]:
        count, _ = made.COUNTS[self.name]
        return tuple(JOINTS[k] if k < 22 else f"part{k}" for k in range(count))

    def posed(self, pose: BodyPose) -> tuple[torch.Tensor, torch.Tensor]:
        angles = np.zeros((len(pose.transl), made.COUNTS[self.name][0], 3))
        body = pose.body_pose.shape[1] // 3
        angles[:, 0] = pose.global_orient
        angles[:, 1 : 1 + body] = pose.body_pose.reshape(-1, body, 3)
        flat = "flat_hand_mean" in pose.extra
        if self.name == "smplx":
            for start, name in ((25, "left_hand_pose"), (40, "right_hand_pose")):
                if name in pose.extra:
                    angles[:, start : start + 15] = pose.extra[name].reshape(-1, 15, 3)
        given = pose.transl.numpy(), pose.betas.numpy()
        verts, joints = made.posed(self.name, angles, *given, flat_hands=flat)
        return torch.from_numpy(verts).float(), torch.from_numpy(joints).float()


@pytest.fixture(autouse=True)
def models(monkeypatch):
    for name in made.COUNTS:
        monkeypatch.setitem(BODY_MODELS, name, lambda _, name=name: Toy(name))


@pytest.fixture(scope="module")
def faces(tmp_path_factory):
    """A mesh file with the triangles of the SMPL-X toy."""
    path = tmp_path_factory.mktemp("faces") / "faces.ply"
    verts = made.person("smplx")["verts"][0]
    trimesh.Trimesh(verts, made.flesh("smplx")[2], process=False).export(path)
    return path


def known_of(tool: str, faces: Path, **more: Any) -> Known:
    return replace(KNOWN, **({"faces": faces} if tool == "sam3dbody" else {}), **more)


def read(tool: str, source: Path, known: Known = KNOWN) -> Any:
    """Bodies or keypoints of a fixture's tool."""
    reader = keypoints_from if tool in made.KEYPOINTS else bodies_from
    return reader(tool.split(":")[0], source, known)


def imported(tool: str, folder: Path, faces: Path, **more: Any):
    found = read(tool, made.BODIES[tool](folder), known_of(tool, faces, **more))
    if not tool.startswith("amass"):
        assert found.bodies.space == "camera"
        return found
    assert found.bodies.space == "world"  # a motion has no camera: it is seen from the true one
    R = torch.from_numpy(made.camera_matrix()).float()
    return replace(found, bodies=into_camera(found.bodies, R))


def seen(points: torch.Tensor) -> np.ndarray:
    return project(points, CAMERA.K).numpy()


def test_files_of_a_folder_are_read_whatever_their_kind_and_case(tmp_path, faces):
    path = made.write_sam3dbody(tmp_path)
    whole = bodies_from("sam3dbody", path, known_of("sam3dbody", faces)).bodies
    first, second, *_ = sorted(path.glob("*.npz"))
    first.rename(first.with_suffix(".NPZ"))
    with np.load(second) as arrays:
        second.with_suffix(".pkl").write_bytes(pickle.dumps(dict(arrays)))
    second.unlink()
    found = bodies_from("sam3dbody", path, known_of("sam3dbody", faces)).bodies
    assert found.frame.tolist() == whole.frame.tolist()
    assert torch.equal(found.verts.sum((1, 2)).sort()[0], whole.verts.sum((1, 2)).sort()[0])


@pytest.mark.parametrize("tool", CASES)
def test_bodies_are_right_upright_and_not_mirrored_and_read_again(tool, tmp_path, faces):
    case, found = CASES[tool], imported(tool, tmp_path, faces, fps=30.0)
    true, bodies = made.person(case.model), found.bodies
    said = {"slahmr": "left out NaN", "sam3dbody": "no tracks, so people are followed"}
    said |= dict.fromkeys(("amass", "amass:smplx"), "a motion in a world of its own")
    assert [said[tool] in one for one in found.warnings] == [True] * (tool in said)
    near = bodies.verts[..., 2].mean(1).argmin()  # SAM 3D Body's fixture has another behind
    rows = bodies.person == bodies.person[near]
    assert bodies.frame[rows].tolist() == (list(range(5)) if case.gapless else [*made.FRAMES])
    counts = bodies.person.unique(return_counts=True)[1]
    assert counts.tolist() == [5] * (2 if tool == "sam3dbody" else 1)
    _, owner, _ = made.flesh(case.model)
    body = owner < 22  # GVHMR knows no hands
    verts = bodies.verts[rows]
    off = seen(verts)[:, body] - made.pixels(true["verts"])[:, body]
    assert np.linalg.norm(off, axis=-1).max() < 1
    assert np.abs(verts.numpy()[:, body] - true["verts"][:, body]).max() < 2e-3
    up = torch.from_numpy(made.camera_matrix()[:, 1]).float()
    part = [verts[:, owner == joint].mean(1) for joint in (15, 7, 20, 21)]
    head, foot, left, right = (p @ up for p in part)
    assert (head - foot > 1.2).all()
    assert (left - head > 0.2).all()  # the left arm is raised, the right one hangs
    assert (head - right > 0.2).all()
    assert (seen(part[2])[:, 0] > seen(part[3])[:, 0]).all()  # and they face the camera
    assert (bodies.pose is None) == (tool == "sam3dbody")
    if bodies.pose is not None:
        check_parameters(bodies, case.model)
    write_bodies(bodies, tmp_path / "bodies.npz")
    again = read_bodies(tmp_path / "bodies.npz", lambda _: None)
    assert torch.equal(again.verts, bodies.verts)
    assert again.frame.tolist() == bodies.frame.tolist()
    assert again.fps == 30.0


def check_parameters(bodies, model):
    """They are kept, and give the same meshes and joints."""
    assert bodies.pose.model == model
    verts, joints = Toy(model).posed(bodies.pose)
    assert torch.allclose(verts, bodies.verts, atol=1e-5)
    off = seen(joints[:, :22]) - made.person(model)["pixels"][:, :22]
    assert np.linalg.norm(off, axis=-1).max() < 1
    assert torch.allclose(joints, bodies.joints, atol=1e-5)


FILES = {  # by suffix: how a file is read and written again
    ".json": (lambda path: json.loads(path.read_text()), lambda value, path: path.write_text(
        json.dumps(value, default=lambda x: np.asarray(x).astype(str).tolist()))),
    ".npz": (lambda path: dict(np.load(path, allow_pickle=True)),
             lambda value, path: np.savez(path, **value)),
    ".npy": (lambda path: np.load(path, allow_pickle=True).item(),
             lambda value, path: np.save(path, value, allow_pickle=True)),
    ".pt": (lambda path: torch.load(path, weights_only=True), torch.save),
    ".pkl": (joblib.load, lambda value, path: path.write_bytes(pickle.dumps(value))),
}  # fmt: skip


def load(path: Path) -> Any:
    return FILES[path.suffix][0](path)


def dump(value: Any, path: Path) -> None:
    FILES[path.suffix][1](value, path)


def owners(tree: Any, start: tuple = ()) -> list[tuple[Any, tuple]]:
    """Each value of nested lists and mappings: what holds it, and the way to it."""
    found = []
    for key in tree.keys() if isinstance(tree, dict) else range(len(tree)):
        found.append((tree, (*start, key)))
        if isinstance(tree[key], dict | list) and len(tree[key]) < 100:
            found += owners(tree[key], (*start, key))
    return found


@pytest.mark.parametrize("tool", CASES)
def test_a_field_that_is_missing_or_has_a_wrong_shape_is_named(tool, tmp_path, faces):
    name, source = CASES[tool].needed, made.BODIES[tool](tmp_path)
    known, refused = known_of(tool, faces), 0
    files = sorted(p for p in tmp_path.rglob("*") if p.is_file())
    for path in {files[0], files[-1]}:
        kept, as_there = path.read_bytes(), torch.tensor if path.suffix == ".pt" else np.array
        for value in (..., [0.0, 0.0], [[0.0]] * 7):
            tree = load(path)
            ways = [way for _, way in owners(tree) if way[-1] == name]
            for way in ways:
                tiny.put(tree, way, value if value is ... else as_there(value))
            if ways:
                dump(tree, path)
                words = f"no key .*'{name}'" if value is ... else name
                with pytest.raises(InputError, match=words):
                    read(tool, source, known)
                path.write_bytes(kept)
                refused += 1
    assert refused >= 3


CHANGES = 10


def changed(old: Any, rng: np.random.Generator) -> Any:
    options: list[Any] = [None, "abc", 0, -5, np.zeros(0), [1, 2], {"a": 1}, 1e300, b"x"]
    kind = old.dtype.kind if isinstance(old, np.ndarray) else ""
    numeric = isinstance(old, torch.Tensor) or kind in tuple("fiub")
    array = np.asarray(old).astype(float) if numeric else np.zeros(1)
    if array.size > 1:
        broken = array.copy()
        broken.flat[0] = np.inf
        options += [array[:-1], array.ravel(), array.T, array * 1e30, array * np.nan, broken]
    new = options[rng.integers(len(options))]
    is_array = isinstance(old, torch.Tensor) and isinstance(new, np.ndarray)
    return torch.from_numpy(new.copy()) if is_array else new


@pytest.mark.filterwarnings("ignore:invalid value encountered:RuntimeWarning")  # the toy's sums
@pytest.mark.parametrize("tool", [*made.BODIES, *made.KEYPOINTS])
def test_a_file_with_one_wrong_field_is_read_or_refused(tool, tmp_path, faces):
    source, known = (made.BODIES | made.KEYPOINTS)[tool](tmp_path), known_of(tool, faces)
    rng = np.random.default_rng(len(tool))
    files = sorted(path for path in tmp_path.rglob("*") if path.is_file())
    for _ in range(CHANGES):
        path = files[rng.integers(len(files))]
        kept, tree = path.read_bytes(), load(path)
        found = owners(tree)
        node, way = found[rng.integers(len(found))]
        node[way[-1]] = changed(node[way[-1]], rng)
        dump(tree, path)
        try:
            found = read(tool, source, known)
            points = found.points if tool in made.KEYPOINTS else found.bodies.verts
            assert points.isfinite().all()
        except InputError as error:
            assert 20 < len(str(error)) < 600  # noqa: PT017
        path.write_bytes(kept)


def test_every_tool_has_a_fixture():
    assert set(CASES) == set(made.BODIES)
    assert {name.split(":")[0] for name in made.BODIES} == set(names("people"))
    assert {name.split(":")[0] for name in made.KEYPOINTS} == set(names("keypoints"))


@pytest.mark.parametrize("tool", [name for name, case in CASES.items() if case.focal])
def test_without_the_true_lens_bodies_stay_where_the_tool_put_them(tool, tmp_path, faces):
    bodies, case = imported(tool, tmp_path, faces, camera=None).bodies, CASES[tool]
    true = made.person(case.model)
    shift = made.under(made.lens(case.focal), true)
    _, owner, _ = made.flesh(case.model)
    off = bodies.verts.numpy() - true["verts"] - shift[:, None]
    assert np.abs(off[:, owner < 22]).max() < 0.02


def test_tracks_of_slahmr_are_those_that_its_side_file_names(tmp_path):
    folder = made.write_slahmr(tmp_path)
    mask = [frame in made.FRAMES for frame in range(7)]
    tracks = {"12": {"index": 0, "vis_mask": mask}}
    (tmp_path / "track_info.json").write_text(json.dumps({"tracks": tracks, "meta": {}}))
    found = bodies_from("slahmr", folder, KNOWN)
    assert found.warnings == ()
    assert found.bodies.person.tolist() == [12] * 5


def test_of_slahmrs_stages_the_last_one_counts_and_its_file_is_named(tmp_path):
    """Names of slahmr/optim/optimizers.py (vye16/slahmr); numbers are iterations."""
    with np.load(made.write_slahmr(tmp_path) / "video_000060_world_results.npz") as true:
        arrays = dict(true)
    (tmp_path / "video_000060_world_results.npz").unlink()
    names = ("root_fit/v_000030", "smooth_fit/v_000060", "motion_chunks/v_20", "motion_chunks/v_3")
    for off, name in zip((1, 2, 0, 3), names, strict=True):
        file = tmp_path / f"{name}_world_results.npz"
        file.parent.mkdir(exist_ok=True)
        np.savez(file, **{**arrays, "trans": arrays["trans"] + off})
    found = bodies_from("slahmr", tmp_path, KNOWN)
    off = found.bodies.verts.mean(1).numpy() - made.person("smplh")["verts"].mean(1)
    assert np.abs(off).max() < 2e-3
    chosen = "of 4 results motion_chunks/v_20_world_results.npz is read"
    assert f"{tmp_path.name}: {chosen}" in found.warnings


def test_the_lens_follows_from_joints_where_the_focal_length_is_missing(tmp_path, faces):
    made.write_sam3dbody(tmp_path, focal=False)
    found = bodies_from("sam3dbody", tmp_path, Known(faces=faces))
    assert np.allclose(found.K, made.lens(1400), atol=0.5)


@pytest.mark.parametrize("tool", ["prompthmr", "tram", "gvhmr"])
def test_a_lens_that_the_files_lack_is_said_and_given_by_its_focal_length(tool, tmp_path):
    path = made.BODIES[tool](tmp_path)
    whole = bodies_from(tool, path, KNOWN)
    if tool == "tram":
        (path / "camera.npy").unlink()
    else:
        tree = load(path)
        del tree["camera" if tool == "prompthmr" else "K_fullimg"]
        tree.pop("camera_world", None)
        dump(tree, path)
    found = bodies_from(tool, path, KNOWN)
    assert any("no lens, so the true one is taken" in text for text in found.warnings)
    assert (found.bodies.verts - whole.bodies.verts).abs().max() > 0.1
    again = bodies_from(tool, path, replace(KNOWN, focal=CASES[tool].focal))
    assert again.warnings == ()
    assert (again.bodies.verts - whole.bodies.verts).abs().max() < 0.05


def test_a_moving_camera_is_named(tmp_path):
    """By its path where the tool knows it, else by its gravity."""
    folder = made.write_tram(tmp_path)
    camera = load(folder / "camera.npy")
    camera["world_cam_T"] = camera["world_cam_T"] + np.linspace(0, 1, 7)[:, None]
    dump(camera, folder / "camera.npy")
    (warning,) = bodies_from("tram", folder, KNOWN).warnings
    assert "turns by up to 0.0 degrees and travels 1.73 m" in warning
    data = made.wham_person()
    for k in range(5):  # the camera rolls
        data["pose_world"][k, :3] = made.rolled(data["pose_world"][k, :3], 0.1 * k)
    path = made.dump({1: data}, tmp_path / "wham_output.pkl")
    (warning,) = bodies_from("wham", path, KNOWN).warnings
    assert "its gravity turns by 0.2" in warning


def test_a_model_file_in_the_true_format_gives_meshes_and_keeps_flat_hands(tmp_path, monkeypatch):
    monkeypatch.undo()
    monkeypatch.setenv("MOVER_BODY_MODELS", str(make_smpl.write_models(tmp_path, ["smplx"])))
    true = made.person("smplx")
    angles = torch.from_numpy(true["angles"]).float()
    pose = BodyPose(
        model="smplx", gender="neutral", betas=torch.zeros(5, 10),
        global_orient=angles[:, 0], body_pose=angles[:, 1:22].flatten(1),
        transl=torch.from_numpy(true["transl"]).float(),
        extra={"left_hand_pose": angles[:, 25:40].flatten(1), "flat_hand_mean": torch.ones(5, 1),
               "right_hand_pose": angles[:, 40:].flatten(1)},
    )  # fmt: skip
    verts, _ = load_model("smplx").posed(pose)
    body = {"rotmat": made.matrices(true["angles"]), "shape": np.zeros(10), "trans": pose.transl}
    people = {3: {"frames": made.FRAMES, "smplx_cam": body}}
    found = bodies_from("prompthmr", made.store({"people": people}, tmp_path / "results.pkl"))
    assert torch.allclose(found.bodies.verts, verts, atol=1e-4)
    assert found.warnings == ()
    assert found.bodies.joint_names[20] == "left_wrist"
    write_bodies(found.bodies, tmp_path / "bodies.npz")
    warnings: list[str] = []
    again = read_bodies(tmp_path / "bodies.npz", warnings.append)
    assert warnings == []  # the parameters in the file give the meshes in the file
    assert torch.allclose(again.pose.transl, pose.transl, atol=1e-4)


# What is wrong is named with its file, its key and the keys that are there.


def smplify_file(folder: Path, **changed: Any) -> Path:
    data = {**made.fit(0, np.array([0, 0, 3.0])), "camera_rotation": None, **changed}
    kept = {key: value for key, value in data.items() if value is not None}
    return made.store(kept, folder / "000.pkl")


def wham_file(folder: Path, **changed: Any) -> Path:
    return made.dump({"7": {**made.wham_person(), **changed}}, folder / "wham_output.pkl")


def tram_without_rotations(folder: Path) -> Path:
    track = made.write_tram(folder) / "hps" / "hps_track_0.npy"
    data = load(track)
    dump({**data, "pred_rotmat": data["pred_rotmat"] * 1.2}, track)
    return folder


def of_objects(folder: Path) -> Path:
    np.savez(folder / "a_world_results.npz", trans=np.array([{"a": 1}], dtype=object))
    return folder


def prior(folder: Path) -> Path:
    np.savez(folder / "clip_000400_prior_results.npz", latent_pose=np.zeros((1, 5, 32)))
    return folder / "clip_000400_prior_results.npz"


def strange(folder: Path) -> Path:
    return made.store({"one": {"strange": np.zeros(3)}}, folder / "some.pkl")


TWICE, NAN = np.array([0, 1, 1, 2, 3]), np.full((1, 3), np.nan)
REFUSED: dict[str, tuple[Any, ...]] = {
    "a missing key": ("smplifyx", partial(smplify_file, body_pose=None),
                      r"000\.pkl.*'body_pose'.*found 'betas', 'global_orient'"),
    "a code of VPoser": ("smplifyx", partial(smplify_file, body_pose=np.zeros((1, 32))),
                         r"32 numbers, expected 63 angles: .*VPoser"),
    "only NaN": ("smplifyx", partial(smplify_file, global_orient=NAN), "only rows with NaN"),
    "a gender": ("smplifyx", partial(smplify_file, gender="some"),
                 "gender.*one of neutral, female, male"),
    "a person twice": ("wham", partial(wham_file, frame_ids=TWICE), "person 7 twice in frame 1"),
    "a negative frame": ("wham", partial(wham_file, frame_ids=TWICE - 1),
                         "frames are numbered from -1"),
    "no rotations": ("tram", tram_without_rotations, "expected rotation matrices"),
    "objects in an npz": ("slahmr", of_objects, r"'trans' .*no pickled objects"),
    "the prior's file": ("slahmr", prior, r"motion prior.*expected .*_world_results\.npz"),
    "no triangles": ("sam3dbody", made.write_sam3dbody, "--faces"),
    "no lens": ("pare", made.write_pare, "--camera", Known()),
    "an unknown tool": ("hmr", lambda folder: folder, "gvhmr"),
    **{f"a file for {tool}": (tool, strange, r"some\.pkl.*no key.*found '(one|strange)'")
       for tool in ("gvhmr", "slahmr", "wham", "phalp", "prompthmr", "sam3dbody", "pare")},
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_what_is_wrong_is_refused_by_name(case, tmp_path):
    tool, write, words, *known = REFUSED[case]
    with pytest.raises(InputError, match=words):
        read(tool, write(tmp_path), *known)


def test_one_frame_is_enough_and_codes_of_vposer_are_decoded_with_its_weights(tmp_path):
    """The fixture's decoder: the angles are a linear map of the code."""
    assert bodies_from("smplifyx", smplify_file(tmp_path)).bodies.frame.tolist() == [0]
    code = torch.linspace(-1, 1, 32)[None]

    def decode(given):
        return torch.cat([given, given[:, :31]], 1) * 0.1

    path = smplify_file(tmp_path, body_pose=code.numpy())
    found = bodies_from("smplifyx", path, replace(KNOWN, decode=decode))
    torch.testing.assert_close(found.bodies.pose.body_pose, decode(code))


def test_frames_with_nan_are_left_out_and_named(tmp_path):
    data = made.wham_person()
    data["pose"][1, 5] = np.nan
    found = bodies_from("wham", wham_file(tmp_path, pose=data["pose"]), KNOWN)
    assert found.bodies.frame.tolist() == [0, 2, 5, 6]
    assert found.bodies.person.tolist() == [7] * 4
    assert any("NaN in frame 1" in warning for warning in found.warnings)


@pytest.mark.parametrize("tool", made.BODIES)
def test_hostile_pickles_of_every_tool_are_refused_at_once_and_not_run(tool, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = made.BODIES[tool](tmp_path)
    hostile = [(bomb(), ": (unfolds|holds a list)") for bomb in BOMBS.values()]
    hostile.append((Calls(os.system, "touch owned"), ""))
    files = [f for f in tmp_path.rglob("*") if f.is_file()]
    assert {f.suffix for f in files} <= set(FILES)
    for file in [f for f in files if f.suffix not in (".npz", ".json")]:  # these hold no pickles
        kept = file.read_bytes()
        for value, words in hostile:
            dump({"pose": value}, file)
            with pytest.raises(InputError, match=file.name + words):
                read(tool, path)
        file.write_bytes(kept)
    assert not (tmp_path / "owned").exists()


def test_a_result_of_slahmr_given_to_another_tool_is_not_called_one_of_amass(tmp_path):
    (path,) = made.write_slahmr(tmp_path).rglob("*.npz")
    for tool in ("wham", "tram", "smplifyx"):
        with pytest.raises(InputError, match=path.name) as error:
            bodies_from(tool, path, KNOWN)
        assert "AMASS" not in str(error.value)


@pytest.mark.parametrize("write", [made.write_amass, made.write_amass_x])
def test_a_motion_of_amass_given_as_bodies_is_named(write, tmp_path):
    """Also with arrays of objects, as of MoSh's stageii, and to another tool."""
    path = write(tmp_path)
    np.savez(path, **load(path) | {"labels_obs": np.array([["a", None]], dtype=object)})
    with pytest.raises(InputError, match=r"^\w+\.npz: is a motion of AMASS.*--bodies-from amass"):
        read_bodies(path)
    for tool in set(names("people")) - {"amass"}:
        with pytest.raises(InputError, match=r"^\w+\.npz: .*a motion of AMASS.*import-bodies am"):
            bodies_from(tool, path, KNOWN)
    assert len(bodies_from("amass", path).bodies.frame) == 5
    parts = load(path)  # as SMPL-X's motions are, too: its parts without the whole
    whole = parts.pop("poses")
    np.savez(path, **parts, root_orient=whole[:, :3], pose_body=whole[:, 3:66])
    pose = bodies_from("amass", path).bodies.pose
    assert pose is not None
    assert pose.body_pose.numpy() == pytest.approx(whole[:, 3:66], abs=1e-5)


INSTEAD = {
    "a pointer": (b"version https://git-lfs.github.com/spec/v1\noid sha256:0\n", "git lfs pull"),
    "a page": (b"\n<!DOCTYPE html>\n<html></html>", "a web page in place of the file"),
    "nothing": (b"", "it is empty"),
    "text": (b"hello there\n", ""),
    "a part": (None, ""),
}
KIND_OF = {"wham": ".pkl", "gvhmr": ".pt", "slahmr": ".npz", "tram": ".npy", "coco17": ".json"}


@pytest.mark.parametrize("what", INSTEAD)
@pytest.mark.parametrize("tool", KIND_OF)
def test_what_is_in_place_of_a_file_is_named_without_pythons_words(tool, what, tmp_path):
    content, words = INSTEAD[what]
    source = (made.BODIES | made.KEYPOINTS)[tool](tmp_path)
    files = [f for f in tmp_path.rglob(f"*{KIND_OF[tool]}") if f.is_file()]
    for file in files:
        whole = file.read_bytes()
        file.write_bytes(whole[: len(whole) // 2] if content is None else content)
        with pytest.raises(InputError, match=rf"^{file.name}: .*{words}") as caught:
            read(tool, source)
        assert not re.search(r"Error\b|opcode|zip file|KeyError|Memo", str(caught.value))
        file.write_bytes(whole)


def test_a_folder_without_a_name_is_called_by_its_own(tmp_path, monkeypatch):
    smplify_file(tmp_path, global_orient=NAN)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match=rf"^{tmp_path.name}: has only rows with NaN"):
        bodies_from("smplifyx", Path())


@pytest.mark.parametrize("tool", ["smplifyx", "pare:images"])
def test_people_without_tracks_are_followed_by_position_not_by_rank(tool, tmp_path):
    """SMPLify-X numbers people by OpenPose's order in each image, PARE by rows."""
    for frame in range(6):
        places = [np.array([[-1 + 0.05 * frame, 0, 4.0]]), np.array([[1.0, 0, 4.0]])]
        order = places[:: -1 if frame % 2 else 1]
        if tool == "smplifyx":
            for k, place in enumerate(order):
                made.store(made.fit(0, place), tmp_path / f"{frame:04d}" / f"{k:03d}.pkl")
        else:
            given = made.pare_person()
            crop = np.array([[0.4, 0.7, place[0, 0] * 2, 0] for place in order])
            rows = {"pred_pose": given["pose"][[0, 0]], "pred_shape": given["betas"][[0, 0]]}
            made.dump({**rows, "orig_cam": crop}, tmp_path / f"img_{frame:06d}.pkl")
    found = read(tool, tmp_path)
    left = found.bodies.person[found.bodies.verts.mean(1)[:, 0] < 0.4]
    assert left.unique().tolist() == [0]
    assert sorted(found.bodies.person.tolist()) == [0] * 6 + [1] * 6
    assert any("no tracks, so people are followed" in warning for warning in found.warnings)


@pytest.mark.parametrize("above", [True, False])
def test_images_without_numbers_are_frames_by_rank_and_their_people_are_one_image(
    above, tmp_path, caplog
):
    """SMPLify-X: results/<name of the image>/<person>.pkl."""
    for name, people in (("bob", 1), ("anna sits", 2), ("room", 1)):
        for k in range(people):
            fit = made.fit(0, np.array([[2.0 * k, 0, 4.0]]))
            made.store(fit, tmp_path / "results" / name / f"{k:03d}.pkl")
    source = tmp_path if above else tmp_path / "results"
    found = read("smplifyx", source).bodies
    assert found.frame.tolist() == [0, 0, 1, 2]
    assert "names without a number are frames by rank: anna sits = 0, bob = 1" in caplog.text


ODD = {
    "upside down": (lambda d: d["pose"].__setitem__((slice(None), slice(0, 3)), [0.0, 0.3, 0.0]),
                    "people stand on their heads; turn the video by 180 degrees"),
    "small": (lambda d: d["betas"].__setitem__((slice(None), 0), -20.0),
              "people measure .* m across, as small children"),
}  # fmt: skip


@pytest.mark.parametrize("case", ODD)
def test_unlikely_people_are_named_with_a_cure(case, tmp_path):
    change, words = ODD[case]
    data = made.wham_person()
    change(data)
    path = wham_file(tmp_path, pose=data["pose"], betas=data["betas"], pose_world=None)
    found = bodies_from("wham", path, KNOWN).bodies
    (warning,) = odd_bodies(found)
    assert re.search(words, warning)
    write_bodies(found, tmp_path / "bodies.npz")
    said: list[str] = []
    read_bodies(tmp_path / "bodies.npz", said.append)
    assert said == [f"bodies.npz: {warning}"]


def test_pieces_of_whams_walker_are_one_person_and_the_user_can_join_more(tmp_path):
    """yohanshin/WHAM 114: tracks 0, 4, 17 of one, with gaps; then one after a long gap."""
    frames = {0: np.arange(5), 4: np.arange(7, 12), 17: np.arange(40, 45)}
    tracks = {}
    for track, span in frames.items():
        place = np.stack([-1 + 0.02 * span, np.zeros(5), 5 - 0.0 * span], 1)
        tracks[np.int64(track)] = {**made.wham_person(), "frame_ids": span, "trans": place}
    path = made.dump(tracks, tmp_path / "wham_output.pkl")
    found = bodies_from("wham", path, KNOWN)
    assert found.bodies.person.unique().tolist() == [0, 17]
    assert "tracks 0, 4 follow one another" in found.warnings[-2]
    assert "4 and 17 (frames 11 and 40) may be one person; --tracks 17=4" in found.warnings[-1]
    known = replace(KNOWN, tracks={17: 4})
    assert bodies_from("wham", path, known).bodies.person.unique().tolist() == [0]
    made.dump({f"person_{track}": one for track, one in tracks.items()}, path)
    assert bodies_from("wham", path, KNOWN).bodies.person.unique().tolist() == [0, 17]
    made.dump(list(tracks.values()), path)
    assert bodies_from("wham", path, KNOWN).bodies.person.unique().tolist() == [0, 2]
    made.dump({"pose": np.zeros((5, 72)), "trans": np.zeros((5, 3))}, path)
    with pytest.raises(InputError, match=r"'pose' has .* a person under the number of a track"):
        bodies_from("wham", path, KNOWN)


@pytest.mark.parametrize("tool", made.KEYPOINTS)
def test_keypoints_fall_on_the_joints_they_name_and_are_read_again(tool, tmp_path):
    found = read(tool, made.KEYPOINTS[tool](tmp_path), Known(fps=30.0))
    assert found.frame.tolist() == made.FRAMES.tolist()
    assert len(found.person.unique()) == 1
    joints = LAYOUTS[found.layout]
    assert found.points.shape == (5, len(joints), 2)
    assert found.layout == ("openpose137" if tool == "openpose" else found.layout)
    true, checked = made.person("smplx")["pixels"], 0
    for k, name in enumerate(joints):
        joint = made.SHOWN.get("mid_hip" if name == "pelvis" else name)
        if joint is None:
            assert (found.confidence[:, k] == 0).all()
            continue
        assert torch.allclose(found.confidence[:, k], torch.tensor(0.9))
        assert np.abs(found.points[:, k].numpy() - true[:, joint]).max() < 0.01, name
        checked += 1
    counts = {"coco17": 13, "halpe26": 17, "openpose": 19, "mediapipe": 15}
    assert checked == counts[tool.split(":")[0]]
    if tool == "openpose":
        for wrist, body in ((25, 7), (46, 4)):  # the first joint of a hand is its wrist
            assert torch.allclose(found.points[:, wrist], found.points[:, body])
    write_keypoints(found, tmp_path / "keypoints.npz")
    again = read_keypoints(tmp_path / "keypoints.npz")
    assert torch.equal(again.points, found.points)
    assert torch.equal(again.confidence, found.confidence)
    assert (again.layout, again.fps) == (found.layout, 30.0)


def openpose(folder: Path, frame: int, *people: np.ndarray) -> None:
    rows = [{"person_id": [-1], "pose_keypoints_2d": p.ravel().tolist()} for p in people]
    text = json.dumps({"people": rows})
    (folder / f"v_{frame:012d}_keypoints.json").write_text(text)


def test_people_who_are_not_named_are_followed_over_a_gap(tmp_path):
    one = made.seen(made.OPENPOSE)[0]
    other = one + [400, 0, 0] * (one[:, 2:] > 0)
    for frame, people in enumerate([(one, other), (other, one), (other,), (one, other)]):
        openpose(tmp_path, frame, *people)
    found = keypoints_from("openpose", tmp_path)
    assert found.layout == "openpose25"
    nose = found.points[:, 0, 0]
    for person in (0, 1):
        assert len(nose[found.person == person].unique()) == 1
    assert found.person.tolist() == [0, 1, 0, 1, 1, 0, 1]


def test_people_without_joints_are_left_out_and_no_person_is_refused(tmp_path):
    openpose(tmp_path, 0, np.zeros((25, 3)), made.seen(made.OPENPOSE)[0])
    assert len(keypoints_from("openpose", tmp_path).frame) == 1
    openpose(tmp_path, 0, np.zeros((25, 3)))
    with pytest.raises(InputError, match="no joints of anyone"):
        keypoints_from("openpose", tmp_path)


def test_joints_with_nan_are_missing_and_another_number_of_them_is_refused(tmp_path):
    path = made.write_coco17(tmp_path)
    rows = load(path)
    rows[0]["keypoints"][15], rows[0]["track_id"] = float("nan"), float("inf")
    dump(rows, path)
    found = keypoints_from("coco17", path)
    assert found.confidence[0, 5] == 0
    assert found.points.isfinite().all()
    for other in (path, made.write_coco17_ultralytics(tmp_path)):
        with pytest.raises(InputError, match=r"keypoints.*expected 26 joints"):
            keypoints_from("halpe26", other)
    openpose(tmp_path, 0, np.ones((18, 3)))
    with pytest.raises(InputError, match="expected 25 triples"):
        keypoints_from("openpose", tmp_path / "v_000000000000_keypoints.json")


def test_the_command_writes_bodies(tmp_path, capsys):
    path, out = made.write_gvhmr(tmp_path), tmp_path / "bodies.npz"
    (tmp_path / "camera.json").write_text(json.dumps(made.camera_json()))
    line = ["gvhmr", path, "--out", out, "--camera", tmp_path / "camera.json", "--fps", "30"]
    assert cli.run_command("import-bodies", [str(word) for word in line]) == 0
    assert "5 rows, 1 people in 5 frames" in capsys.readouterr().out
    bodies = read_bodies(out)
    assert (bodies.space, bodies.fps) == ("camera", 30.0)


@pytest.mark.slow
def test_an_import_takes_the_bodies_of_a_tool_by_their_path(tmp_path):
    """`--bodies PATH --bodies-from TOOL`: the same bodies as `mover bodies`, in the capture."""
    path = made.write_gvhmr(tmp_path)
    box = {"id": "t", "category": "table", "center": [0, -1, -3], "size": [1.2, 0.8, 0.6]}
    room = {"camera": made.camera_json(), "ground": -1.4, "objects": [{**box, "yaw": 0.3}]}
    (tmp_path / "boxes.json").write_text(json.dumps(room))
    line = ["boxes", tmp_path / "boxes.json", "--out", tmp_path / "room", "--bodies", path]
    assert cli.run_command("import", [*map(str, line), "--bodies-from", "gvhmr"]) == 0
    found = read_bodies(tmp_path / "room" / "bodies.npz")
    direct = bodies_from("gvhmr", path, KNOWN).bodies
    assert found.frame.tolist() == direct.frame.tolist()
    assert (found.verts - direct.verts).abs().max() < 1e-4
    assert found.pose is not None
    bad = [*map(str, line), "--bodies-from", "hmr"]
    assert cli.run_command("import", bad) == 2


def test_the_command_writes_keypoints_and_names_the_tools(tmp_path, capsys):
    path, out = made.write_coco17(tmp_path), tmp_path / "k.npz"
    assert cli.run_command("import-bodies", ["coco17", str(path), "--out", str(out)]) == 0
    assert read_keypoints(out).layout == "coco17"
    assert cli.run_command("import-bodies", ["smpl", str(path)]) == 2
    assert "sam3dbody" in capsys.readouterr().err


SHARED = Path(__file__).parents[2] / "shared" / "data" / "sam3d_body"


@pytest.mark.skipif(not SHARED.is_dir(), reason="the real SAM 3D Body files are not here")
def test_real_people_of_sam_3d_body_fall_on_their_own_keypoints_and_stand_up(tmp_path):
    for file in SHARED.glob("img_*.npz"):
        (tmp_path / file.name).symlink_to(file)
    found = bodies_from("sam3dbody", tmp_path, Known(faces=SHARED / "mhr_lod1_topology.ply"))
    bodies = found.bodies
    assert bodies.verts.shape == (4, 18439, 3)
    assert sorted(bodies.person.tolist()) == [0, 1, 2, 3]
    for file in sorted(SHARED.glob("img_*.npz")):
        given = types.SimpleNamespace(**np.load(file))
        seen_at = project(torch.from_numpy(given.pred_keypoints_3d + given.pred_cam_t), found.K)
        off = np.linalg.norm(seen_at.numpy() - given.pred_keypoints_2d, axis=1)
        assert off.max() < 1
        middle = torch.from_numpy(given.pred_vertices + given.pred_cam_t)
        row = int((bodies.verts.mean(1) - middle.mean(0)).norm(dim=1).argmin())
        assert torch.allclose(bodies.verts[row], middle, atol=1e-5)
        low, high = project(middle, found.K).aminmax(dim=0)
        box = torch.from_numpy(given.bbox)
        assert ((low + high) / 2 - (box[:2] + box[2:]) / 2).norm() < 0.15 * (box[3] - box[1])
        assert high[1] - low[1] > 0.7 * (box[3] - box[1])
