"""The viewer and the report of a real run in a real browser: looked at, moved, solved again."""

import contextlib
import dataclasses
import io
import json
import math
import os
import socket
import subprocess
import sys
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from test_pipeline import light
from test_report import browser, differ

from mover.app.viewer.drawing import read_shown
from mover.core import records
from mover.energy.config import Adam
from mover.geometry.boxes import box_of
from mover.geometry.rotations import rot_y
from mover.io.capture.edits import Pin, Place, edit_scene, placement_of, read_edits, write_edits
from mover.io.capture.folder import write_capture
from mover.io.capture.scene_file import read_scene
from mover.io.files.fields import write_json

__all__ = ["browser"]  # the fixture
SQUARE = 0.9 / 7 * 1.7  # [m] along x and z, from the foot of the gizmo to its square's middle
SIZE = {"width": 1280, "height": 800}


def program(*arguments: object) -> dict[str, Any]:
    """The program as a user calls it, for `subprocess`."""
    words = [sys.executable, "-m", "mover", *map(str, arguments)]
    return {"args": words, "env": dict(os.environ, OMP_NUM_THREADS="1")}


def call(*arguments: object) -> None:
    subprocess.run(**program(*arguments), check=True, capture_output=True)


@pytest.fixture(scope="module")
def folder(tmp_path_factory, small_capture) -> Path:
    """A small capture, its settings, and its result in `out`."""
    folder = tmp_path_factory.mktemp("view")
    write_capture(small_capture, folder / "capture")
    config, slow = light("robust"), Adam(15, 0.03)
    config = dataclasses.replace(
        config,
        layout=dataclasses.replace(config.layout, method=slow, yaws=8, num_hypotheses=3, coarse=1),
        place=dataclasses.replace(config.place, method=slow),
    )
    write_json({"config": records.plain(config)}, folder / "config.json")
    call("run", folder / "capture", "--out", folder / "out", "--config", folder / "config.json")
    return folder


def free_port() -> int:
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        return int(found.getsockname()[1])


class Viewer:
    """A running viewer and a page that looks at it."""

    def __init__(self, browser: Any, shots: Path, *arguments: object) -> None:
        pytest.importorskip("viser")
        self.shots, self.troubles, self.requests = shots, [], []
        self.server = subprocess.Popen(**program(*arguments), stdout=subprocess.PIPE, text=True)
        self.url = self.server.stdout.readline().split()[0]
        self.page = browser.new_page(viewport=SIZE)
        self.page.on("console", lambda m: self.troubles.append(m.text) if m.type == "error" else 0)
        self.page.on("pageerror", lambda e: self.troubles.append(str(e)))
        self.page.on("request", lambda r: self.requests.append(r.url))
        self.page.on("websocket", lambda w: self.requests.append(w.url))
        self.page.goto(f"{self.url}?fixedDpr=1")  # else it follows the speed of the machine
        self.page.get_by_role("tab", name="Room").wait_for(timeout=60_000)
        self.page.wait_for_timeout(3000)
        with contextlib.suppress(Exception):  # a note that there is no GPU
            self.page.locator("[role=alert] button").click(timeout=5000)

    def see(self, name: str, wait: int = 2000) -> np.ndarray:
        """The 3D view as it is now; also kept as a file to look at."""
        self.page.wait_for_timeout(wait)
        raw = self.page.screenshot(path=self.shots / f"{name}.png")
        whole = np.asarray(Image.open(io.BytesIO(raw)).convert("RGB")).astype(int)
        return whole[:, : int(self.canvas()["width"])]

    def canvas(self) -> dict[str, float]:
        return self.page.locator("canvas").first.bounding_box()

    def tab(self, name: str) -> None:
        self.page.get_by_role("tab", name=name).click()
        self.page.wait_for_timeout(300)

    def drag(self, start: tuple[float, float], end: tuple[float, float]) -> None:
        self.page.mouse.move(*start)
        self.page.wait_for_timeout(500)
        self.page.mouse.down()
        self.page.mouse.move(start[0] + 4, start[1] + 3, steps=3)
        self.page.mouse.move(*end, steps=12)
        self.page.wait_for_timeout(500)
        self.page.mouse.up()
        self.page.wait_for_timeout(1500)

    def close(self) -> None:
        self.page.close()
        self.server.terminate()
        self.server.wait(20)
        self.server.stdout.close()


@contextlib.contextmanager
def viewing(browser: Any, shots: Path, *arguments: object):
    viewer = Viewer(browser, shots, *arguments)
    try:
        yield viewer
        home = viewer.url.removeprefix("http://")
        allowed = tuple(f"{kind}://{home}" for kind in ("http", "ws", "blob:http"))
        assert [url for url in viewer.requests if not url.startswith(allowed)] == []
    finally:
        viewer.close()


def where(point: torch.Tensor, scene, canvas: dict[str, float]) -> tuple[float, float]:
    """Where the first view of the room shows a point of the world [px]."""
    middle = torch.stack([box_of(p).center for p in scene.objects]).mean(0).double()
    eye = torch.tensor([float(middle[0]) + 1.0, 2.2, 1.8], dtype=torch.float64)
    ahead = torch.nn.functional.normalize(middle - eye, dim=0)
    right = torch.linalg.cross(ahead, torch.tensor([0.0, 1, 0]).double())
    right = torch.nn.functional.normalize(right, dim=0)
    ray = point.double() - eye
    depth = float(ray @ ahead)
    zoom = canvas["height"] / 2 / math.tan(math.radians(55) / 2) / depth
    x = canvas["x"] + canvas["width"] / 2 + zoom * float(ray @ right)
    y = canvas["y"] + canvas["height"] / 2 - zoom * float(ray @ torch.linalg.cross(right, ahead))
    return x, y


def nearest(scene):
    """The object in front."""
    return max(scene.objects, key=lambda p: float(box_of(p).center[2]))


def edited(file: Path) -> list[dict[str, Any]]:
    return json.loads(file.read_text())["edits"] if file.exists() else []


@pytest.mark.slow
class TestViewer:
    def test_plays_and_shows_time_before_and_after(self, browser, folder, tmp_path):
        with viewing(browser, tmp_path, "view", folder / "out", "--port", free_port()) as viewer:
            page, shots = viewer.page, [viewer.see("start")]
            moment = page.get_by_label("Moment").or_(page.locator("input[type=text]")).last
            moment.fill("30")
            moment.press("Enter")
            shots.append(viewer.see("moment"))
            page.get_by_text("before", exact=True).click()
            shots.append(viewer.see("before"))
            page.get_by_text("after", exact=True).click()
            shots.append(viewer.see("after"))
            page.get_by_role("button", name="Look through the camera").click()
            shots.append(viewer.see("through"))
            changes = [differ(a, b) for a, b in pairwise(shots)]
            assert min(changes) > 1e-4, changes
            assert differ(shots[1], shots[3]) < 0.01  # after is after
            page.get_by_role("button", name="Play").click()
            page.wait_for_timeout(2500)
            page.get_by_role("button", name="Pause").click()
            assert differ(shots[-1], viewer.see("played")) > 0.002
            assert viewer.troubles == []

    def test_an_object_is_dragged_pinned_and_a_run_solves_the_edits(
        self, browser, folder, tmp_path
    ):
        out, file = folder / "out", tmp_path / "edits.json"
        scene = read_scene(out / "scene.json")
        piece = nearest(scene)
        command = ("view", out, "--edits", file, "--port", free_port())
        with viewing(browser, tmp_path, *command) as viewer:
            page, canvas = viewer.page, viewer.canvas()
            page.mouse.click(*where(box_of(piece).center, scene, canvas))
            viewer.tab("Object")
            page.wait_for_timeout(1000)
            start = viewer.see("chosen")
            assert page.get_by_label("Object", exact=True).input_value() == piece.id
            off = rot_y(piece.yaw) @ torch.tensor([SQUARE, 0.0, SQUARE])
            hand = piece.t_world_object + off
            goal = hand + torch.tensor([-0.4, 0.0, 0.3])
            viewer.drag(where(hand, scene, canvas), where(goal, scene, canvas))
            assert differ(start, viewer.see("dragged")) > 0.005
            moved = edited(file)
            assert [(e["do"], e["id"]) for e in moved] == [("place", piece.id)]
            went = np.subtract(moved[0]["translation"], piece.t_world_object.tolist())
            assert went == pytest.approx([-0.4, 0, 0.3], abs=0.06)
            page.get_by_label("Pinned").check()
            page.get_by_text("mover run").wait_for()
            assert viewer.troubles == []
        assert [e["do"] for e in edited(file)] == ["place", "pin"]
        solved = tmp_path / "solved"
        call("run", folder / "capture", "--out", solved, "--config", folder / "config.json",
             "--edits", file)  # fmt: skip
        assert read_shown(solved).log["edits"] == 2
        stays(read_edits(file)[0], read_shown(solved).result)

    def test_numbers_and_undo_change_the_list(self, browser, folder, tmp_path):
        out, file = folder / "out", tmp_path / "edits.json"
        piece = nearest(read_scene(out / "scene.json"))
        command = ("view", out, "--edits", file, "--port", free_port())
        with viewing(browser, tmp_path, *command) as viewer:
            page = viewer.page
            viewer.tab("Object")
            page.get_by_label("Object", exact=True).click()
            page.get_by_role("option", name=piece.id).click()
            page.wait_for_timeout(1000)
            page.get_by_label("Front [°]").fill("90")
            page.wait_for_timeout(800)
            assert [e["do"] for e in edited(file)] == ["place"]
            assert edited(file)[0]["yaw"] == pytest.approx(math.pi / 2, abs=1e-4)
            page.get_by_role("button", name="Delete").click()
            page.wait_for_timeout(800)
            assert edited(file)[-1] == {"do": "delete", "id": piece.id}
            page.get_by_role("button", name="Undo the last edit").click()
            page.wait_for_timeout(800)
            assert [e["do"] for e in edited(file)] == ["place"]
            viewer.see("undone")
            assert viewer.troubles == []


def stays(place: Place, result) -> None:
    """The object stands where the edit puts it, on the floor of the result."""
    wanted = {p.id: p for p in edit_scene(result, [place]).objects}[place.id]
    found = {p.id: p for p in result.objects}[place.id]
    assert (wanted.t_world_object - found.t_world_object)[[0, 2]].abs().max() < 1e-4
    assert float((wanted.yaw - found.yaw).abs()) < 2e-4
    assert (wanted.scale - found.scale).abs().max() < 1e-5
    box = box_of(found)
    assert float(box.center[1] - box.size[1] / 2) == pytest.approx(result.ground, abs=1e-4)


@pytest.mark.slow
class TestReplay:
    def test_edits_give_the_same_room_every_time(self, folder, tmp_path):
        """The pinned object stays where it was put; the list replays to the last bit."""
        scene = read_scene(folder / "out" / "scene.json")
        piece = nearest(scene)
        shift = torch.tensor([0.3, 0.0, -0.2])
        put = dataclasses.replace(piece, t_world_object=piece.t_world_object + shift)
        edits = (placement_of(put, scene), Pin(piece.id, True))
        write_edits(edits, tmp_path / "edits.json")
        for name in ("a", "b"):
            call("run", folder / "capture", "--out", tmp_path / name, "--config",
                 folder / "config.json", "--edits", tmp_path / "edits.json")  # fmt: skip
        for file in ("scene.json", "edits.json", "bodies.npz"):
            assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes()
        stays(edits[0], read_scene(tmp_path / "a" / "scene.json"))
        assert read_shown(tmp_path / "a").image is not None
