"""Whatever a source holds: it is imported or refused with a message; nothing in it runs."""

import json
import os
import re
import shutil
import tempfile
import zipfile
from dataclasses import replace
from pathlib import Path

import make_scenes as layouts
import numpy as np
import pytest
import tiny_capture as tiny
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from kept_mats import mats_read_once as mats_read_once  # for every test
from PIL import Image
from test_safe_pickle import Calls

from mover.app.cli.video import VideoArgs, video_to_room
from mover.core.errors import InputError
from mover.io.capture.merge import import_into
from mover.io.capture.parts import Hints
from mover.io.files.cameras import read_camera_file
from mover.io.files.fields import At
from mover.io.files.meshes import read_mesh
from mover.io.formats import IMPORTED, chosen
from mover.io.masks.instance_files import read_instances

SLOW = (HealthCheck.too_slow, HealthCheck.function_scoped_fixture)
FUZZ = settings(max_examples=150, deadline=None, suppress_health_check=SLOW)
AHEAD = np.array([0, 0, 3.0])
JOINTS = np.tile(np.linspace(0, 1, 25)[:, None], (2, 1, 3)) + AHEAD


def little() -> layouts.Room:
    things = [
        layouts.Thing(f"{c}_{i}", c, tiny.STEP * 0.5, tiny.STEP_FACES,
                      np.array([0.4 * i - 0.4, -1.4, -3.0]), 0.3 * i, np.ones(3))
        for i, c in enumerate(("chair", "table"))
    ]  # fmt: skip
    K = np.array([[60.0, 0, 32], [0, 60.0, 24], [0, 0, 1]])
    return layouts.Room(K, np.diag([1.0, -1, -1]), (64, 48), -1.4, things)


@pytest.fixture(scope="module")
def sources(tmp_path_factory):
    room, home = little(), tmp_path_factory.mktemp("sources")
    steps = np.stack([tiny.STEP + AHEAD] * 2)
    masks = np.zeros((2, 48, 64), dtype=bool)
    masks[0, 5:20, 3:20], masks[1, 22:40, 30:50] = True, True
    kinds = layouts.write_masks(home / "masks", masks, ["chair", "couch"])
    return {
        "total3d": layouts.write_total3d(home / "t3d", room),
        "sam3d": layouts.write_sam3d(home / "sam3d", room),
        "holisticmesh": layouts.write_holisticmesh(home / "hm", room),
        "glb": layouts.write_glb(home / "glb" / "a.glb", room),
        "boxes": layouts.write_boxes(home / "boxes" / "a.json", room),
        "release": layouts.write_release(home / "rel", room, steps, tiny.STEP_FACES),
        "pigraphs": layouts.write_pigraphs(home / "pig", room, "a_b_c", JOINTS, mirror=False),
        **{f"masks:{k}": v for k, v in kinds.items()},
    }


def import_or_refuse(format: str, source: Path, home: Path) -> bool:
    """Whether it was taken; nothing may be written outside of `home`/out and its work folder."""
    out, work = home / "out", home / "work"
    for folder in (out, work):
        shutil.rmtree(folder, ignore_errors=True)
    work.mkdir(parents=True)
    before = sorted(p for p in home.rglob("*") if not p.is_relative_to(work))
    try:
        camera = At(layouts.camera_json(little()), "camera.json")
        hints = Hints(work=work, camera=None if format == "total3d" else camera)
        import_into(out, chosen("FORMAT", format.split(":")[0], *IMPORTED)(source, hints))
    except InputError as error:
        assert str(error)  # noqa: PT017
        assert sorted(p for p in home.rglob("*") if not p.is_relative_to(work)) == before
        return False
    outside = (p for p in home.rglob("*") if not p.is_relative_to(work))
    assert sorted(p for p in outside if not p.is_relative_to(out)) == before
    return True


def copied(source: Path, home: Path) -> Path:
    """The source's folder in a new place; the same path in it."""
    shutil.rmtree(home, ignore_errors=True)
    folder = source if source.is_dir() else source.parent
    return shutil.copytree(folder, home / "in") / source.relative_to(folder)


FORMATS = ("total3d", "sam3d", "holisticmesh", "glb", "boxes", "release", "pigraphs",
           "masks:coco_text", "masks:mover", "masks:labelme", "masks:npz",
           "masks:labels")  # fmt: skip


def files_of(source: Path) -> list[Path]:
    return sorted(p for p in source.rglob("*") if p.is_file()) if source.is_dir() else [source]


@pytest.mark.parametrize("format", FORMATS)
def test_the_little_room_itself_is_taken(sources, format, tmp_path):
    assert import_or_refuse(format, copied(sources[format], tmp_path), tmp_path)


@pytest.mark.slow
@FUZZ
@example(format="release", which=37, where=0.5, junk=b"(", cut=False)  # an .npy header that goes on
@example(format="total3d", which=3, where=1.0, junk=b"\x80", cut=False)  # no text at an .obj's end
@example(format="total3d", which=0, where=0.0, junk=b"\t", cut=True)  # nothing but a space: .txt
@given(
    format=st.sampled_from(FORMATS), which=st.integers(0, 100), where=st.floats(0, 1),
    junk=st.binary(min_size=1, max_size=8), cut=st.booleans(),
)  # fmt: skip
def test_no_flipped_or_missing_bytes_raise_anything_else(sources, format, which, where, junk, cut):
    with tempfile.TemporaryDirectory() as place:
        home = Path(place) / "home"
        source = copied(sources[format], home)
        paths = files_of(source)
        path = paths[which % len(paths)]
        content = path.read_bytes()
        start = int(where * len(content))
        tail = b"" if cut else content[start + len(junk) :]
        path.write_bytes(content[:start] + junk + tail)
        import_or_refuse(format, source, home)


JUNK = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5)
    | st.sampled_from([..., 0, -1, 1 << 70, 1e308, "ground", "..", "../../x", 64, 48, [], {}]),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=3), inner),
    max_leaves=5,
)  # fmt: skip


@pytest.mark.slow
@FUZZ
@given(
    format=st.sampled_from([f for f in FORMATS if f not in ("glb", "masks:npz")]),
    which=st.integers(0, 10**6), value=JUNK,
)  # fmt: skip
def test_no_junk_in_any_json_field_raises_anything_else(sources, format, which, value):
    with tempfile.TemporaryDirectory() as place:
        home = Path(place) / "home"
        source = copied(sources[format], home)
        paths = [p for p in files_of(source) if p.suffix == ".json"]
        if not paths:
            return
        path = paths[which % len(paths)]
        tree = json.loads(path.read_text())
        ways = tiny.ways_of(tree, most=30)
        tiny.put(tree, ways[which % len(ways)], value)
        path.write_text(json.dumps(tree, default=str))
        import_or_refuse(format, source, home)


def test_pickles_in_arrays_do_not_run(tmp_path):
    mark, bomb = tmp_path / "mark", tmp_path / "a.npz"
    writes = Calls(exec, f"open({str(mark)!r}, 'w').write('run')")
    np.savez(bomb, masks=np.array([writes], dtype=object))
    with pytest.raises(InputError, match="pickled"):
        read_instances(bomb, {}, None)
    folder = layouts.write_sam3d(tmp_path / "sam", little())
    shutil.copy(bomb, folder / "0.npz")
    assert not import_or_refuse("sam3d", folder, tmp_path)
    assert not mark.exists()


def test_zip_bombs_are_not_unpacked(tmp_path):
    with zipfile.ZipFile(tmp_path / "a.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("masks.npy", layouts.promise(10**6, 10**6) + b"\0" * 10**6)
    with pytest.raises(InputError, match="bytes"):
        read_instances(tmp_path / "a.npz", {}, None)
    (tmp_path / "b.npy").write_bytes(layouts.promise(10**9, 3) + b"\0" * 100)
    with pytest.raises(InputError, match=r"b\.npy"):
        read_instances(tmp_path / "b.npy", {}, None)


@pytest.mark.parametrize("kind", ["ply", "off", "obj"])
def test_headers_of_a_thousand_million_vertices_are_refused(tmp_path, kind):
    source = layouts.write_total3d(tmp_path / "in", little())
    for path in (source / "output").glob("*.obj"):
        path.unlink()
    header = {
        "ply": "ply\nformat binary_little_endian 1.0\nelement vertex 1000000000\nproperty float x\n"
        "property float y\nproperty float z\nelement face 1000000000\n"
        "property list uchar int vertex_indices\nend_header\n",
        "off": "OFF\n1000000000 1000000000 0\n0 0 0\n",
        "obj": "v 0 0 0\nv 1 0 0\nv 0 1 1\nf 1 2 1000000000\n",
    }[kind]
    for i, c in ((0, 5), (1, 7)):
        (source / "output" / f"{i}_{c}.{kind}").write_text(header)
    assert not import_or_refuse("total3d", source, tmp_path)


@pytest.mark.parametrize("name", ["../../escaped", "/tmp/escaped", "..", "a/b", "CON:", "\0", ""])
def test_names_cannot_leave_the_folder(tmp_path, name):
    room = little()
    things = [replace(t, name=name or "x") for t in room.things[:1]]
    source = layouts.write_boxes(tmp_path / "in" / "a.json", replace(room, things=things))
    assert import_or_refuse("boxes", source, tmp_path) or "\0" in name
    tree = json.loads(source.read_text())
    tree["objects"][0]["category"] = name
    source.write_text(json.dumps(tree))
    import_or_refuse("boxes", source, tmp_path)


def test_a_gltf_cannot_bring_other_files_along(tmp_path):
    secret = tmp_path / "secret.png"
    layouts.picture((8, 8)).save(secret)
    path = layouts.write_glb(tmp_path / "in" / "a.glb", little())
    images = {"images": [{"uri": "../secret.png"}]}
    path.write_bytes(layouts.with_json(path.read_bytes(), lambda tree: tree.update(images)))
    with pytest.raises(InputError, match="images beside it"):
        chosen("FORMAT", "glb", *IMPORTED)(path, Hints(work=tmp_path))


PIPED = ["a.npy", "a.npz", "a.json", "a.png", "a.pkl"]


@pytest.mark.parametrize("name", PIPED)
def test_a_pipe_a_device_and_a_folder_are_no_files(name, tmp_path):
    os.mkfifo(tmp_path / name)
    with pytest.raises(InputError, match=rf"^{name}: .*is no file \(a pipe\)"):
        read_instances(tmp_path / name, {}, None)
    with pytest.raises(InputError, match=rf"{name}: .*is no file \(a pipe\)"):
        read_camera_file(tmp_path / name, None)
    (tmp_path / name).unlink()
    (tmp_path / name).symlink_to("/dev/null")
    with pytest.raises(InputError, match=rf"^{name}: .*is no file \(a device\)"):
        read_instances(tmp_path / name, {}, None)
    with pytest.raises(InputError, match=rf"{name}: is no file \(a device\), expected a video or"):
        video_to_room(VideoArgs(tmp_path / name, out=tmp_path / "out"))
    (tmp_path / "m.glb").mkdir()
    with pytest.raises(
        InputError, match=r"objects\.mesh' has .m\.glb., which is no file .a folder., expected"
    ):
        read_mesh(At("m.glb", "scene.json", "objects.mesh"), tmp_path)


@pytest.mark.parametrize(("size", "said"), [
    ((13000, 13000), "13000 x 13000 pixels"), ((20000, 10000), "200000000 pixels"),
])  # fmt: skip
def test_a_picture_of_too_many_pixels_says_so(size, said, tmp_path):
    Image.new("1", size).save(tmp_path / "a.png")
    with pytest.raises(InputError, match=rf"^a.png: .*too large: {said}, at most \d+ are read"):
        read_instances(tmp_path / "a.png", {}, None)


def test_masks_of_more_than_two_gigabytes_are_refused_by_their_header(tmp_path):
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.writestr("masks.npy", layouts.promise(1000, 600, 600))
    with pytest.raises(InputError, match=r"'masks' has 2880000000 bytes or more, expected at most"):
        read_instances(tmp_path / "a.npz", {}, None)


OTHERS = {
    "a zip archive": (b"PK\x05\x06" + b"\0" * 18, "it is a zip archive: unpack it"),
    "gzip": (b"\x1f\x8b\x08" + b"\0" * 20, r"it is packed by gzip: unpack it \(gunzip\)"),
    "JSON": (b'{"a": 1}', "it is JSON: call it .json"),
    "an array": (layouts.promise(2, 3), "it is an array of NumPy: call it .npy"),
    "junk": (b"\x07hello there\n", ""),
}
OWN_ENDS = {"a zip archive": ("npz",), "JSON": ("json",), "an array": ("npy",)}


@pytest.mark.parametrize("what", OTHERS)
@pytest.mark.parametrize(
    "ending", ["npy", "npz", "json", "png", "glb", "gltf", "ply", "stl", "off"]
)
def test_a_file_of_another_kind_is_named_by_what_it_is(what, ending, tmp_path):
    content, words = OTHERS[what]
    path = tmp_path / f"a.{ending}"
    path.write_bytes(content)
    is_masks, mesh = ending in ("npy", "npz", "json", "png"), At(path.name, "scene.json", "mesh")
    with pytest.raises(InputError, match=rf"a\.{ending}") as caught:
        _ = read_instances(path, {}, None) if is_masks else read_mesh(mesh, tmp_path)
    own = ending in OWN_ENDS.get(what, ()) or (what, ending) == ("JSON", "gltf")
    assert own or re.search(words, str(caught.value))
    pythons = r"magic|Expecting|reading|Not a ply|zip file|UTF-8|char 0|Error|\[\]"
    assert not re.search(pythons, str(caught.value))


def test_a_zip_of_pictures_is_no_file_of_arrays(tmp_path):
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.writestr("0.png", b"")
    with pytest.raises(
        InputError, match=r"a.npz: cannot be read .it is a zip archive with 0.png., expected an"
    ):
        read_instances(tmp_path / "a.npz", {}, None)


@pytest.mark.parametrize(("children", "words"), [
    ({0: [0]}, "with nodes in a circle, expected trees of nodes"),
    ({0: [1], 1: [0]}, "with nodes in a circle, expected trees of nodes"),
    ({0: [1], 2: [1]}, "with a node of several parents, expected trees of nodes"),
])  # fmt: skip
def test_a_gltf_whose_nodes_are_no_trees_is_refused(children, words, tmp_path):
    path = layouts.write_glb(tmp_path / "in" / "a.glb", little())

    def change(tree):
        tree["nodes"] = [{**node, "children": children.get(k, [])}
                         for k, node in enumerate(tree["nodes"])]  # fmt: skip

    path.write_bytes(layouts.with_json(path.read_bytes(), change))
    with pytest.raises(InputError, match=rf"a\.glb.*{words}"):
        chosen("FORMAT", "glb", *IMPORTED)(path, Hints(work=tmp_path))


@pytest.mark.parametrize("wrong", [{"yfov": 0}, {"aspectRatio": 0}, {"yfov": float("inf")}])
def test_a_camera_of_a_gltf_without_an_angle_is_refused(tmp_path, wrong):
    path = layouts.write_glb(tmp_path / "in" / "a.glb", little())

    def change(tree):
        tree["cameras"][0]["perspective"].update(wrong)

    path.write_bytes(layouts.with_json(path.read_bytes(), change))
    with pytest.raises(InputError, match="a camera that cannot be read"):
        chosen("FORMAT", "glb", *IMPORTED)(path, Hints(work=tmp_path))


def test_xml_bombs_are_refused(tmp_path):
    path = tmp_path / "a.xml"
    path.write_text('<!DOCTYPE x [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;">]><x>&b;</x>')
    with pytest.raises(InputError, match="entities"):
        read_camera_file(path, (64, 48))
