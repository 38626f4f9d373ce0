"""Retargeted clips: limbs point where the actor's limbs point, people stand on the floor."""

from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from mover.app.cli import run_command
from mover.bodies.skinning import open_body
from mover.core.errors import InputError
from mover.core.records import fingerprint
from mover.core.types import Bodies
from mover.geometry.camera import to_world
from mover.io.capture.bodies_file import read_bodies
from mover.io.capture.scene_file import read_scene
from mover.io.formats import read
from mover_bench.rooms import clip as clips
from mover_bench.rooms.clip import clip_room
from mover_bench.rooms.config import RoomConfig
from mover_bench.rooms.mocap import retarget, swing
from mover_bench.rooms.placed import distances

CMU = Path(__file__).parents[2] / "shared" / "data" / "cmu"
ASF, AMC = CMU / "01.asf", CMU / "01_08.amc"
LIMBS = {
    "hip": ("knee", "femur"), "knee": ("ankle", "tibia"), "shoulder": ("elbow", "humerus"),
    "elbow": ("wrist", "radius"),
}  # fmt: skip
SKELETON = """:units
  angle deg
:root
  order TX TY TZ RX RY RZ
  position 0 0 0
:bonedata
{bones}:hierarchy
  begin
    root {names}
  end
"""
BONE = """  begin
    name {name}
    direction {way}
    length 2.0
    axis 0 0 0 XYZ
  end
"""
WAYS = {"femur": "0 -1 0", "tibia": "0 -1 0", "foot": "0 0 1", "toes": "0 0 1"}
SPINE = ("lowerback", "upperback", "thorax", "upperneck", "head")


def stick_figure(folder: Path, pose: str) -> tuple[Path, Path]:
    """An actor in a T-pose whose root alone moves."""
    ways = dict.fromkeys(SPINE, "0 1 0")
    for side, out in (("l", 1), ("r", -1)):
        ways |= {side + n: w for n, w in WAYS.items()}
        ways |= {side + n: f"{out} 0 0" for n in ("humerus", "radius", "wrist")}
    bones = "".join(BONE.format(name=n, way=w) for n, w in ways.items())
    asf, amc = folder / "a.asf", folder / "a.amc"
    asf.write_text(SKELETON.format(bones=bones, names=" ".join(ways)))
    amc.write_text(f":DEGREES\n{pose}")
    return asf, amc


def test_an_actor_in_a_t_pose_gives_the_t_pose_on_the_floor_scaled_by_the_legs(
    tmp_path: Path,
) -> None:
    files = stick_figure(tmp_path, "1\nroot 0 4 0 0 0 0\n2\nroot 1 4 0 0 90 0\n")
    bodies = retarget(*files, 120.0)
    assert bodies.pose is not None
    assert bodies.joints is not None
    assert len(bodies.verts) == 2
    assert abs(float(bodies.verts[..., 1].min())) < 1e-3
    names = bodies.joint_names
    joints = bodies.joints[0]
    for side, out in (("left", 1.0), ("right", -1.0)):
        arm = joints[names.index(f"{side}_wrist")] - joints[names.index(f"{side}_shoulder")]
        assert torch.allclose(arm / arm.norm(), torch.tensor([out, 0, 0]), atol=1e-3)
    legs = [joints[names.index(f"left_{j}")] for j in ("hip", "knee", "ankle")]
    leg = (legs[1] - legs[0]).norm() + (legs[2] - legs[1]).norm()
    step = bodies.joints[1, 0] - joints[0]
    assert torch.allclose(step, torch.tensor([1.0, 0, 0]) * leg / 4, atol=1e-3), "a leg has 4 units"
    turned = bodies.joints[1] - bodies.joints[1, 0]
    x, y, z = (joints - joints[0]).unbind(-1)
    assert torch.allclose(turned, torch.stack([z, y, -x], -1), atol=1e-3), "a quarter to the left"


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("angle deg", "angle rad", "line 2 has 'angle rad', expected angle deg"),
        ("name head", "name hat", "no way from the root to hat"),
        ("length 2.0", "length two", "has 'length two', expected numbers"),
        ("XYZ", "ZYX", "expected three angles and XYZ"),
    ],
)
def test_wrong_skeletons_are_refused_with_the_line(
    tmp_path: Path, old: str, new: str, message: str
) -> None:
    asf, amc = stick_figure(tmp_path, "1\nroot 0 4 0 0 0 0\n")
    asf.write_text(asf.read_text().replace(old, new))
    with pytest.raises(InputError, match=message):
        retarget(asf, amc, 30.0)


@pytest.mark.parametrize(
    ("pose", "message"),
    [
        ("1\nroot 0 4 0\n", "expected 6 numbers"),
        ("1\nroot 0 4 0 0 0 nan\n", "expected 6 numbers"),
        ("root 0 4 0 0 0 0\n", "expected a frame's number"),
        ("1\nroot 0 4 0 0 0 0\n2\n", "frame 2 lacks root"),
        ("", "has no frames"),
    ],
)
def test_wrong_motions_are_refused(tmp_path: Path, pose: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        retarget(*stick_figure(tmp_path, pose), 30.0)


def test_frame_rates_beyond_the_clip_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="at most 120"):
        retarget(*stick_figure(tmp_path, "1\nroot 0 4 0 0 0 0\n"), 240.0)


def test_a_swing_turns_one_direction_into_the_other_about_their_normal() -> None:
    rng = np.random.default_rng(0)
    for a, b in rng.normal(size=(20, 2, 3)):
        turn = swing(a, b)
        assert np.allclose(turn @ a / np.linalg.norm(a), b / np.linalg.norm(b))
        assert np.allclose(turn @ np.cross(a, b), np.cross(a, b))
    assert np.allclose(swing(a, 2 * a), np.eye(3))


@pytest.fixture(scope="module")
def clip() -> Bodies:
    if not AMC.exists():
        pytest.skip("no motion capture files here")
    return retarget(ASF, AMC, 4.0)


def test_limbs_point_where_a_plain_reading_of_the_clip_says(clip: Bodies) -> None:
    assert clip.joints is not None
    frames = amc_frames()
    assert len(clip.frame) == (len(frames) - 1) // 30 + 1
    for row in (0, 20, 50, len(clip.frame) - 1):
        truth = directions(frames[30 * row])
        for side in ("left", "right"):
            for joint, (end, bone) in LIMBS.items():
                ends = [clip.joint_names.index(f"{side}_{j}") for j in (joint, end)]
                way = (clip.joints[row, ends[1]] - clip.joints[row, ends[0]]).double().numpy()
                assert np.allclose(way / np.linalg.norm(way), truth[side[0] + bone], atol=2e-3)


def amc_frames() -> list[dict[str, list[float]]]:
    """Numbers of each bone in each frame, read without checks."""
    frames: list[dict[str, list[float]]] = []
    for words in (line.split() for line in AMC.read_text().splitlines()[3:]):
        if len(words) == 1:
            frames.append({})
        else:
            frames[-1][words[0]] = [float(w) for w in words[1:]]
    return frames


def directions(frame: dict[str, list[float]]) -> dict[str, np.ndarray]:
    """Where each bone points, by recursion from the bone to the root with scipy's rotations."""
    head, hierarchy = ASF.read_text().split(":hierarchy")
    bones: dict[str, dict[str, list[str]]] = {}
    for block in head.split(":bonedata")[1].split("begin")[1:]:
        fields = {w[0]: w[1:] for w in (line.split() for line in block.splitlines()) if w}
        bones[fields["name"][0]] = fields
    parent = {c: w[0] for w in (x.split() for x in hierarchy.splitlines()) for c in w[1:]}

    def turn(name: str) -> Rotation:
        if name == "root":
            return Rotation.from_euler("xyz", frame["root"][3:], degrees=True)
        axes = Rotation.from_euler("xyz", [float(a) for a in bones[name]["axis"][:3]], degrees=True)
        angles = dict(zip(bones[name].get("dof", []), frame.get(name, []), strict=True))
        own = Rotation.from_euler(
            "xyz", [angles.get(k, 0.0) for k in ("rx", "ry", "rz")], degrees=True
        )
        return turn(parent[name]) * axes * own * axes.inv()

    return {n: turn(n).apply([float(d) for d in bones[n]["direction"]]) for n in bones}


def test_somebody_who_stands_has_feet_near_the_floor_and_the_head_above_the_pelvis(
    clip: Bodies,
) -> None:
    assert clip.joints is not None
    low = clip.verts[..., 1].amin(1)
    assert float(low.min()) > -0.06, "nobody sinks into the floor"
    standing = torch.cat([clip.joints[:8], clip.joints[-6:]])  # before and after the climb
    names = clip.joint_names
    feet = standing[:, [names.index("left_foot"), names.index("right_foot")], 1]
    assert float(feet.amin(1).max()) < 0.15
    rise = standing[:, names.index("head")] - standing[:, 0]
    assert float(rise[:, 1].min()) > 0.5
    assert float(rise[:, [0, 2]].norm(dim=-1).max()) < 0.3


def test_parameters_give_the_bodies_and_the_same_files_the_same_bodies(clip: Bodies) -> None:
    assert clip.pose is not None
    assert torch.allclose(open_body().posed(clip.pose)[0], clip.verts, atol=1e-4)
    assert fingerprint(clip) == fingerprint(retarget(ASF, AMC, 4.0))


LITTLE = RoomConfig(
    width=320, height=180, pieces=4, least_pixels=30, least_frames=1, least_touches=0
)
TURNING = "".join(f"{k + 1}\nroot {0.02 * k} 4 0 0 {k} 0\n" for k in range(73))


def test_a_clip_takes_place_in_a_known_room_out_of_furniture_and_in_view(tmp_path: Path) -> None:
    files = stick_figure(tmp_path, TURNING)
    room, clip = clip_room(files, 3, LITTLE), retarget(*files, LITTLE.fps)
    assert len(room.bodies.frame) == len(clip.frame) == 4
    world = to_world(room.bodies.verts, room.truth.camera.R_cam_world)
    for row in range(4):  # turned and moved as a whole
        apart = torch.cdist(world[row, ::500], world[0, ::500])
        assert torch.allclose(
            apart, torch.cdist(clip.verts[row, ::500], clip.verts[0, ::500]), atol=1e-3
        )
    assert torch.allclose(world[..., 1] - room.truth.ground, clip.verts[..., 1], atol=1e-3)
    for piece in room.plan.pieces:
        skin = world.reshape(-1, 3).double().numpy() - [0, float(room.truth.ground), 0]
        assert distances(piece, skin).min() > -0.021
    assert room.capture.people is not None
    assert len(room.capture.people.frame) == 4
    assert int(room.whole.min()) > 0
    assert fingerprint(room.bodies) == fingerprint(clip_room(files, 3, LITTLE).bodies)


def test_a_part_of_a_clip_is_its_beginning(tmp_path: Path) -> None:
    files = stick_figure(tmp_path, TURNING)
    assert len(clip_room(files, 3, LITTLE, seconds=0.4).bodies.frame) == 2


def test_a_clip_that_needs_more_floor_than_a_room_has_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(clips, "DRAFTS", 1)
    files = stick_figure(tmp_path, "".join(f"{k + 1}\nroot {k} 4 0 0 0 0\n" for k in range(49)))
    with pytest.raises(InputError, match=r"a\.amc: 0\.6 s over .* fit into none of 1 rooms"):
        clip_room(files, 0, LITTLE)


@pytest.mark.slow
def test_the_command_writes_a_capture_with_its_truth(tmp_path: Path) -> None:
    asf, amc = stick_figure(tmp_path, TURNING)
    out = tmp_path / "room"
    assert run_command("rooms", [str(asf), str(amc), "--out", str(out)]) == 0
    capture = read("folder", out)
    assert capture.bodies is not None
    truth = read_bodies(out / "truth" / "bodies.npz")
    assert set(capture.bodies.frame.tolist()) <= set(truth.frame.tolist())
    assert {p.id for p in read_scene(out / "truth" / "scene.json").objects} == {
        p.id for p in capture.scene.objects
    }


@pytest.mark.parametrize("flags", [["--fps", "0"], ["--fps", "240"], ["--seconds", "-1"]])
def test_the_command_refuses_impossible_rates(flags: list[str], tmp_path: Path, capsys) -> None:
    asf, amc = stick_figure(tmp_path, TURNING)
    assert run_command("rooms", [str(asf), str(amc), *flags]) == 2
    assert flags[0] in capsys.readouterr().err
