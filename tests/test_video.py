"""`mover video`: steps that are kept, bodies from anywhere, networks that are missing, the way."""

import json
import sys
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from mover.app import chain
from mover.app.chain import check_bodies, digest, import_bodies, steps_in
from mover.app.cli import run_command
from mover.app.cli.video import VideoArgs, video_to_room
from mover.core.errors import InputError
from mover.io.capture.bodies_file import read_bodies, write_bodies
from mover.io.files.fields import write_json
from mover.perceive import config
from mover.perceive.config import FACTS, ModelsConfig, missing
from mover.perceive.steady import first_cut

NAMES = ("first", "second")


class TestSteps:
    def do(self, folder: Path, word: str, yours: bool = False, of: str = "") -> list[str]:
        """One step in a new process that writes a word, made from in.txt and the word."""
        lines, made = list[str](), folder / "made.txt"
        steps = steps_in(folder, lines.append, NAMES)
        steps.do("first", [folder / "in.txt", word], made, lambda: made.write_text(word) and None,
                 yours=yours, of=of)  # fmt: skip
        return lines

    @pytest.mark.parametrize("yours", [False, True])
    def test_a_step_is_done_again_only_where_what_it_is_made_from_changed(self, tmp_path, yours):
        source, made = tmp_path / "in.txt", tmp_path / "made.txt"
        source.write_text("a")
        assert len(self.do(tmp_path, "one", yours)) == 2
        assert self.do(tmp_path, "one", yours) == ["1/2 first: kept"]
        assert (len(self.do(tmp_path, "two", yours)), made.read_text()) == (2, "two")
        made.write_text("user's")
        assert self.do(tmp_path, "two", yours) == ["1/2 first: kept"]
        source.write_text("b")
        lines = self.do(tmp_path, "two", yours)
        if yours:  # what replaced a result outlives what it was made from
            assert lines == ["1/2 first: made.txt is yours and stays; without it, it is made"]
            assert made.read_text() == "user's"
            (line,) = self.do(tmp_path, "two", yours, "another video")
            assert "made.txt is yours and stays, though the video or its lens has changed" in line
        else:
            assert made.read_text() == "two"
        made.unlink()
        self.do(tmp_path, "three", yours)
        assert made.read_text() == "three"

    def test_what_a_step_made_of_another_video_goes_and_what_replaced_it_stays(self, tmp_path):
        made = tmp_path / "made.txt"
        for text in (None, "user's"):
            self.do(tmp_path, "one")
            made.write_text(text or made.read_text())
            steps_in(tmp_path, print, NAMES).undo("first", made)
            assert made.exists() == (text is not None)

    def test_a_step_that_dies_is_not_taken_for_finished(self, tmp_path: Path):
        def dies() -> None:
            (tmp_path / "made.txt").write_text("half")
            raise InputError("no")

        with pytest.raises(InputError):
            steps_in(tmp_path, print, NAMES).do("first", [], tmp_path / "made.txt", dies)
        assert len(self.do(tmp_path, "one")) == 2

    @pytest.mark.parametrize("text", ["", "{", "[]", '{"steps": 3}', '{"steps": {"first": 5}}'])
    def test_a_damaged_log_is_said_and_dropped(self, tmp_path: Path, text: str):
        (tmp_path / "steps.json").write_text(text)
        lines = list[str]()
        assert steps_in(tmp_path, lines.append, NAMES).log == {}
        assert "steps.json is damaged" in lines[0]

    def test_files_count_by_their_content_and_words_are_no_files(self, tmp_path: Path):
        a, b = tmp_path / "a", tmp_path / "b"
        for path in (a, b):
            path.write_text("x")
        assert digest([a]) == digest([b]) != digest(["x"])
        assert digest([tmp_path / "none"]) != digest([])


class TestBodies:
    @pytest.mark.parametrize(
        ("source", "tool", "words"),
        [("nowhere.npz", "", "neither `fit`"), ("fit", "nope", "'nope' is none of")],
    )
    def test_what_cannot_work_is_said_before(self, source: str, tool: str, words: str):
        with pytest.raises(InputError, match=words):
            check_bodies(source, tool)

    def make(self, capture: Path, code: str) -> None:
        command = f"{sys.executable} -c {json.dumps(code)} {{video}} {{frames}} {{camera}} {{out}}"
        import_bodies(command, "", capture / "video.mp4", capture)

    def test_a_command_that_fails_is_one_sentence(self, tmp_path: Path):
        for code, words in (("exit(3)", "ended with code 3"), ("pass", "wrote nothing to")):
            with pytest.raises(InputError, match=words):
                self.make(tmp_path, code)
        with pytest.raises(InputError, match=r"--bodies: no-such-program: No such file"):
            import_bodies("no-such-program {out}", "", tmp_path, tmp_path)

    def test_a_command_gets_the_video_the_frames_and_the_lens_and_its_bodies_are_read(
        self, tmp_path: Path, small_room
    ):
        write_bodies(small_room.bodies, tmp_path / "theirs.npz")
        code = (
            "import shutil, sys; assert [a.rsplit('/', 1)[-1] for a in sys.argv[1:]] == "
            "['video.mp4', 'frames', 'camera.json', 'bodies-by-command.npz'], sys.argv; "
            f"shutil.copy('{tmp_path / 'theirs.npz'}', sys.argv[4])"
        )
        self.make(tmp_path, code)
        found = read_bodies(tmp_path / "bodies.npz")
        assert torch.equal(found.verts, read_bodies(tmp_path / "theirs.npz").verts)

    def test_a_file_that_holds_no_bodies_is_refused_and_nothing_is_written(self, tmp_path: Path):
        np.savez(tmp_path / "other.npz", a=np.zeros(3))
        with pytest.raises(InputError, match=r"other\.npz"):
            import_bodies(str(tmp_path / "other.npz"), "", tmp_path, tmp_path)
        assert not (tmp_path / "bodies.npz").exists()


class TestNetworks:
    def test_everything_that_is_missing_is_said_at_once_with_licence_size_and_what_to_do(
        self, monkeypatch: pytest.MonkeyPatch
    ):
        monkeypatch.setattr(config.importlib.util, "find_spec", lambda _: None)
        found = "; ".join(missing(ModelsConfig(), mediapipe=True))
        for name, facts in FACTS.items():
            assert f"hf download {name}" in found
            assert all(fact in found for fact in facts)
        assert all(f"the package {name}" in found for name in config.PACKAGES)

    def test_all_default_networks_have_their_facts(self):
        models = ModelsConfig()
        assert {models.masks, models.keypoints} == set(FACTS)

    def test_the_command_says_so_before_any_work(self, tmp_path, capsys, monkeypatch):
        monkeypatch.setenv("HF_HUB_OFFLINE", "1")
        monkeypatch.setenv("HF_HUB_CACHE", str(tmp_path / "empty"))
        (tmp_path / "empty").mkdir()
        for name, words in (("a.mp4", "a video"), ("a.jpg", "a picture"), ("empty", "has no pic")):
            if "." in name:
                (tmp_path / name).write_bytes(b"no video")
            assert run_command("video", [str(tmp_path / name), "--out", str(tmp_path / "out")]) == 2
            (line,) = capsys.readouterr().err.splitlines()
            assert f"{name}: " in line
            assert words in line
        Image.new("RGB", (9, 9)).save(tmp_path / "a.jpg")
        assert run_command("video", [str(tmp_path / "a.jpg"), "--out", str(tmp_path / "out")]) == 2
        lines = capsys.readouterr().err.splitlines()
        assert lines[0] == "mover video: not on this machine:"
        assert sum("hf download" in line for line in lines[1:]) == 2
        assert not (tmp_path / "out" / "capture").exists()
        (tmp_path / "a.json").write_text("{}")
        assert run_command("video", [str(tmp_path / "a.json"), "--out", str(tmp_path)]) == 2
        assert "a.json: is no video, expected one" in capsys.readouterr().err

    @pytest.mark.skipif(find_spec("transformers") is None, reason="transformers is not installed")
    def test_a_folder_without_weights_is_missing_and_one_with_them_is_not(self, tmp_path: Path):
        models = ModelsConfig(str(tmp_path), "")
        assert len([s for s in missing(models) if "holds no network" in s]) == 1
        (tmp_path / "config.json").write_text("{}")
        (tmp_path / "model.safetensors").write_bytes(b"")
        assert not [s for s in missing(models) if "holds no network" in s]


@pytest.mark.parametrize(("agree", "cut"), [
    ([1.0, 0.95, 0.9, *[0.05] * 7], 3),
    ([1.0, 0.9, 0.1, 0.1, 0.9, 0.9, 0.9, 0.9], None),  # a person passes close by
    ([1.0, 0.8, 0.6, 0.45, 0.3, 0.2, 0.1, 0.1], None),  # the camera walks away
    ([1.0] * 8, None),
])  # fmt: skip
def test_a_picture_that_changes_at_once_and_for_good_is_a_cut(agree: list[float], cut: int | None):
    assert first_cut(agree) == cut


def test_heights_are_told_to_the_room_by_track(tmp_path: Path):
    rows = [{"track_id": 7}, {"track_id": 3}, {"track_id": 7}]
    (tmp_path / "people.json").write_text(json.dumps({"info": {"fps": 5}, "annotations": rows}))
    chain.write_heights(tmp_path, (1.6, 1.8))
    info = json.loads((tmp_path / "people.json").read_text())["info"]
    assert info == {"fps": 5, "heights": {"3": 1.6, "7": 1.8}}
    chain.write_heights(tmp_path, (1.7,))
    assert json.loads((tmp_path / "people.json").read_text())["info"]["heights"]["7"] == 1.7
    with pytest.raises(InputError, match="height: 3 are given, expected 1, or 2: one a person"):
        chain.write_heights(tmp_path, (1.6, 1.7, 1.8))
    chain.write_heights(tmp_path / "none", (1.7,))  # no person is seen: nothing to write


@pytest.mark.long
@pytest.mark.usefixtures("quick")
def test_a_video_becomes_a_room_and_files_that_are_replaced_stay(tmp_path, small_room, capsys):
    pytest.importorskip("cv2")
    pytest.importorskip("av")
    from mover.app.pictures.film import save_film
    from mover.core.records import rows_of
    from mover_bench.rooms.config import NoiseConfig
    from mover_bench.rooms.known import draw_frame
    from mover_bench.rooms.noise import add_noise
    from mover_bench.rooms.seen import Seen

    video, out, frames = tmp_path / "room.mp4", tmp_path / "out", 60
    save_film((draw_frame(small_room, k) for k in range(frames)), small_room.bodies.fps, video)
    bodies = rows_of(small_room.bodies, small_room.bodies.frame < frames)
    finders = Seen(small_room, add_noise(small_room, NoiseConfig(), 1), 1).finders()
    K, camera = small_room.truth.camera.K, small_room.truth.camera
    lens = {"w": camera.width, "h": camera.height, "fl_x": float(K[0, 0]), "fl_y": float(K[1, 1])}
    write_json({**lens, "cx": float(K[0, 2]), "cy": float(K[1, 2])}, tmp_path / "lens.json")
    args = VideoArgs(video, out, camera=tmp_path / "lens.json")
    video_to_room(args, finders)
    assert (out / "room" / "report.html").is_file()
    found = read_bodies(out / "room" / "bodies.npz")
    true = {k: i for i, k in enumerate(small_room.bodies.frame.tolist())}
    rows = [true[k] for k in found.frame.tolist()]
    heights = small_room.bodies.verts[rows].norm(dim=-1).mean()
    assert (found.verts.norm(dim=-1).mean() / heights - 1).abs() < 0.15
    capsys.readouterr()
    write_bodies(bodies, out / "capture" / "bodies.npz")
    video_to_room(args, finders)
    told = capsys.readouterr().out
    assert [line for line in told.splitlines() if line.endswith("kept")] == [
        "1/4 pictures: kept", "2/4 bodies: kept",
    ]  # fmt: skip
    assert "3/4 first scene ..." in told.splitlines()  # other feet stand on another floor
    video_to_room(args, finders)
    kept = [line for line in capsys.readouterr().out.splitlines() if line.endswith("kept")]
    assert kept == ["1/4 pictures: kept", "2/4 bodies: kept", "3/4 first scene: kept"]
    after = read_bodies(out / "capture" / "bodies.npz")
    assert torch.equal(after.verts, bodies.verts)
