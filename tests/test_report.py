"""The report: what its pictures show, that its data are whole, and that it stands alone."""

import base64
import dataclasses
import io
import json
import math
import re
from html.parser import HTMLParser
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from little_room import GROUND, box, camera, mesh_of, piece, room, walkers
from PIL import Image, ImageColor

from mover.app.pictures.overlay import draw_overlay, save_overlay
from mover.app.report.page import ReportContent, write_report
from mover.app.report.plan import draw_top, extent_of
from mover.app.report.scene_view import pack_view, thin, thin_choice
from mover.app.report.tables import find_changes, metrics_table, objects_table
from mover.core.colours import colour, css
from mover.core.types import Capture, Scene
from mover.geometry.boxes import box_of
from mover.geometry.camera import to_camera, to_world
from mover.geometry.placement import place_object
from mover.geometry.raster import first_hit

CHROMIUM = Path("/usr/bin/chromium")
FLAGS = [
    "--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist", "--disable-background-networking",
]  # fmt: skip


def bare(scene: Scene) -> ReportContent:
    return ReportContent("bare", None, {"initial": scene, "result": scene})


def full() -> ReportContent:
    values = {"iou3d": 0.3, "p2s": 0.2, "contact_f1": 0.1, "center_error": 0.5}
    better = {"iou3d": 0.6, "p2s": 0.1, "contact_f1": 0.5, "center_error": 0.1}
    each = [{"id": "sofa_0", "initial": values, "result": better}]
    return ReportContent(
        "A <b>room</b> & more",
        torch.linspace(0.2, 0.8, 360)[:, None, None].expand(360, 640, 3),
        {"initial": room(0.5, -0.1, -1.4), "result": room(0.05), "truth": room()},
        {"initial": walkers(ground=-1.4), "result": walkers()},
        {"initial": values, "result": better, "objects": each},
        ("table_0: nobody touches it <script>",),
        [
            {"name": name, "seconds": 12.5, "memory": 800.0, "kept": True}
            for name in ("place_objects", "refine_camera")
        ],
        {"place": {"weights": {"depth": 8.0}}, "seed": 0},
        [{"id": "sofa_0", "category": "sofa", "mask_pixels": 1234, "touched": True}],
        command="mover demo",
    )


class TestOverlay:
    def test_changes_exactly_the_pixels_where_rays_meet_furniture(self):
        alone = piece("sofa_0", box(1.8, 0.8, 0.9), (0.0, -3.5), 0.4, GROUND)
        scene = Scene(camera(), None, (alone,))  # no floor: no grid
        image = torch.rand(180, 320, 3, generator=torch.Generator().manual_seed(0))
        drawn = draw_overlay(image, scene)
        verts = to_camera(place_object(alone).verts, scene.camera.R_cam_world)
        half = torch.tensor([0.5, 0.5, 1.0])[:, None] * scene.camera.K
        hit = first_hit(verts, alone.mesh.faces, half, (180, 320))[1] >= 0
        changed = (drawn - image).abs().amax(-1) > 0.01
        near = torch.nn.functional.max_pool2d(hit[None, None].float(), 3, 1, 1)[0, 0] > 0
        assert hit.sum() > 2000
        assert not (changed & ~near).any()
        assert (changed & hit).sum() >= 0.99 * hit.sum()

    def test_shows_the_nearer_object_in_its_own_colour(self):
        front = piece("a", box(1, 1.4, 0.2), (0.0, -2.5), 0.0, GROUND)
        behind = piece("b", box(3, 2, 0.2), (0.0, -4.5), 0.0, GROUND)
        for pieces, index in (((front, behind), 0), ((behind, front), 1)):
            drawn = draw_overlay(torch.full((360, 640, 3), 0.5), Scene(camera(), None, pieces))
            middle = drawn[215, 280] - drawn[215, 280].mean()  # beside the label
            tint = torch.tensor(colour(index))
            cosine = torch.cosine_similarity(middle, tint - tint.mean(), dim=0)
            assert cosine > 0.95

    def test_leaves_an_empty_room_alone(self):
        image = torch.rand(30, 40, 3, generator=torch.Generator().manual_seed(0))
        assert torch.equal(draw_overlay(image, Scene(camera(), GROUND, ())), image)

    def test_draws_the_floor_one_metre_apart_where_the_ground_is(self):
        pole = piece("a", box(0.1, 0.1, 0.1), (-2.5, -6.0), 0.0, GROUND)
        far = piece("b", box(0.1, 0.1, 0.1), (2.5, -2.5), 0.0, GROUND)
        scene = Scene(camera(), GROUND, (pole, far))
        drawn = draw_overlay(torch.full((720, 1280, 3), 0.4), scene)
        for x, line in ((0.0, True), (0.5, False)):
            point = to_camera(torch.tensor([x, GROUND, -3.5]), scene.camera.R_cam_world)
            u, v, w = (scene.camera.K @ point * 2).tolist()
            row, column = int(2 * v / w), int(2 * u / w)
            assert (drawn[row, column - 1 : column + 2].max() > 0.45) == line

    def test_of_a_capture_is_saved_as_a_picture(self, tmp_path: Path):
        image = torch.full((720, 1280, 3), 0.3)
        capture = Capture("c", room(), None, (), image, None, None, None, None, ())
        with Image.open(save_overlay(capture, tmp_path / "check.png")) as saved:
            drawn = torch.from_numpy(np.asarray(saved).copy()).float() / 255
        assert drawn.shape == (720, 1280, 3)
        assert (drawn - draw_overlay(image, room())).abs().max() <= 0.51 / 255


class TestPlan:
    def test_holds_people_who_leave_the_furniture(self):
        bodies = walkers(2)
        away = dataclasses.replace(bodies, verts=bodies.verts + torch.tensor([9.0, 0, 0]))
        assert extent_of(room(), None, away).right > 9.0
        assert extent_of(room(), None, None).right < 4.0

    def test_puts_the_front_where_the_object_looks(self):
        turned = piece("chair_0", box(0.4, 1.0, 0.8), (1.0, -3.0), math.pi / 2, GROUND)
        drawn = draw_top(Scene(camera(), GROUND, (turned,)))
        middle, turn = re.search(r"translate\((.*?)\) rotate\((.*?)\)", drawn).groups()
        assert [float(v) for v in middle.split()] == pytest.approx([1.0, -3.0])
        foot = re.search(r'class="foot" d="M(\S+) ([-.\d]+)h([-.\d]+)v([-.\d]+)h', drawn).groups()
        x, z, width, depth = (float(v) for v in foot)
        assert (x, z, width, depth) == pytest.approx((-0.2, 0.4, 0.4, -0.8))
        # the front, at the middle of the first edge, looks along +x: SVG turns x to z
        angle = math.radians(float(turn))
        front = (-z * math.sin(angle), z * math.cos(angle))
        assert front == pytest.approx((0.4, 0.0), abs=1e-6)

    def test_survives_flat_and_thin_objects(self):
        line = mesh_of(trimesh.Trimesh([[0, 0, 0], [0, 1, 0], [0, 2, 0.0]], [[0, 1, 2]]))
        assert "foot" in draw_top(Scene(camera(), None, (piece("x", line, (0.0, -2.0), 0.0, 0.0),)))

    def test_dots_every_person_and_every_sole(self):
        drawn = draw_top(room(), room(), walkers(30, people=2))
        assert drawn.count('class="person"') == 2
        assert len(re.findall(r"h0(?=[M\"])", drawn)) == 2 * 2 * 30
        assert drawn.count('class="truth"') == 3


class TestTables:
    def test_an_object_that_stays_in_the_camera_has_not_moved(self):
        before = room(pitch=-0.05)
        after = room(pitch=-0.3)
        moved = []
        for p in before.objects:
            middle = box_of(p).center
            seen = to_camera(middle, before.camera.R_cam_world)
            step = to_world(seen, after.camera.R_cam_world) - middle
            moved.append(dataclasses.replace(p, t_world_object=p.t_world_object + step))
        after = dataclasses.replace(after, objects=tuple(moved))
        assert max(c.moved for c in find_changes(before, after).values()) < 1e-5

    def test_tells_turn_and_size(self):
        before = room()
        first = dataclasses.replace(
            before.objects[0],
            yaw=before.objects[0].yaw + 2 * math.pi - 0.5,
            scale=torch.tensor([1.1, 1.0, 0.5]),
        )
        change = find_changes(before, Scene(before.camera, GROUND, (first,)))["chair_0"]
        assert change.turned == pytest.approx(-0.5, abs=1e-5)
        assert change.grown == pytest.approx((1.1, 1.0, 0.5))

    def test_knows_which_way_is_better(self):
        metrics = {"initial": {"iou3d": 0.2, "p2s": 0.1}, "result": {"iou3d": 0.1, "p2s": 0.05}}
        moods = re.findall(r'<td class="(\w*)">', metrics_table(metrics))
        assert moods == ["worse", "better"]

    def test_shows_a_missing_metric_as_missing(self):
        drawn = metrics_table({"initial": {}, "result": {"iou3d": 0.5, "contact": math.nan}})
        assert "0.500" in drawn
        assert "nan" not in drawn
        assert metrics_table({}) == ""

    def test_joins_evidence_to_its_object(self):
        scenes = {"initial": room(0.3), "result": room()}
        drawn = objects_table(scenes, [{"id": "table_0", "mask_pixels": 4321}], None)
        row = next(r for r in drawn.split("<tr>") if "table_0" in r)
        assert "4,321" in row
        assert drawn.count("4,321") == 1


class TestThinning:
    def test_a_soup_is_welded_and_thinned_and_still_the_sphere_that_it_was(self):
        ball = trimesh.creation.icosphere(subdivisions=5)
        rows = np.arange(3 * len(ball.faces)).reshape(-1, 3)
        soup = trimesh.Trimesh(ball.triangles.reshape(-1, 3), rows, process=False)
        few = thin(mesh_of(soup), 3000)
        assert len(few.faces) <= 3000
        assert (few.verts.norm(dim=1) - 1).abs().max() < 0.01

    def test_chosen_vertices_draw_every_pose(self):
        bodies = walkers(3)
        few = thin_choice(bodies.verts[0], bodies.faces, 300)
        assert len(few.faces) <= 300
        bent = bodies.verts[1] * torch.tensor([1.3, 0.6, 1.0])
        whole = trimesh.Trimesh(bent.numpy(), bodies.faces.numpy(), process=False)
        drawn = trimesh.Trimesh(bent[few.kept].numpy(), few.faces.numpy(), process=False)
        assert drawn.volume == pytest.approx(whole.volume, rel=0.03)


class TestView:
    def unpack(self, view: tuple[str, str]) -> tuple[dict[str, Any], bytes]:
        return json.loads(view[0]), base64.b64decode(view[1])

    def test_bodies_come_back_within_a_millimetre(self):
        bodies = walkers(20, people=2)
        tree, block = self.unpack(pack_view({"result": room()}, {"result": bodies}))
        people, world = tree["people"], tree["people"]["worlds"]["result"]
        count = len(people["rows"]) * people["n_verts"] * 3
        whole = np.frombuffer(block, np.int16, count, world["verts"])
        verts = whole.reshape(-1, people["n_verts"], 3) * world["step"] + world["middle"]
        kept = thin_choice(bodies.verts[len(bodies.verts) // 2], bodies.faces, 1600).kept
        assert [tuple(r) for r in people["rows"]] == list(
            zip(bodies.frame.tolist(), bodies.person.tolist(), strict=True)
        )
        assert np.abs(verts - bodies.verts[:, kept].numpy()).max() < 1e-3

    def test_objects_come_back_at_their_place(self):
        scene = room()
        tree, block = self.unpack(pack_view({"result": scene}, {}))
        for given, packed in zip(scene.objects, tree["scenes"]["result"]["pieces"], strict=True):
            mesh = tree["meshes"][packed["mesh"]]
            whole = np.frombuffer(block, np.int16, mesh["n_verts"] * 3, mesh["verts"])
            verts = whole.reshape(-1, 3) * mesh["step"] + mesh["middle"]
            assert verts.min(0) == pytest.approx(given.mesh.verts.amin(0).numpy(), abs=1e-4)
            assert packed["t"] == pytest.approx(given.t_world_object.tolist(), abs=1e-5)

    def test_a_mesh_that_did_not_change_is_packed_once(self):
        tree, _ = self.unpack(pack_view({"initial": room(0.5), "result": room()}, {}))
        assert len(tree["meshes"]) == 3

    def test_long_videos_are_sampled_with_both_ends(self):
        tree, _ = self.unpack(pack_view({"result": room()}, {"result": walkers(1000)}))
        frames = tree["people"]["frames"]
        assert len(frames) == 120
        assert (frames[0], frames[-1]) == (0, 2997)

    def test_an_unknown_floor_is_under_the_lowest_thing(self):
        scene = dataclasses.replace(room(), ground=None)
        tree, _ = self.unpack(pack_view({"result": scene}, {}))
        assert tree["scenes"]["result"]["floor"] == pytest.approx(GROUND)


class Addresses(HTMLParser):
    """Everything in a page that a browser might fetch."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []

    def handle_starttag(self, _tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found += [
            v for k, v in attrs if v and k in ("src", "href", "srcset", "action", "data")
        ]


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> str:
    """The text of a full page."""
    return write_report(tmp_path_factory.mktemp("page"), full()).read_text()


class TestPage:
    def test_asks_for_nothing_outside_itself(self, page: str):
        addresses = Addresses()
        addresses.feed(page)
        assert all(a.startswith("data:") for a in addresses.found)
        assert set(re.findall(r"https?://[^\s\"'<)]*", page)) <= {"http://www.w3.org/2000/svg"}
        assert not re.search(r"@import|url\((?!data:)", page)
        assert "default-src 'none'" in page

    def test_writes_what_the_user_named_as_text(self, page: str):
        assert "A &lt;b&gt;room&lt;/b&gt; &amp; more" in page
        assert "it &lt;script&gt;" in page
        assert not re.search(r"\{\{\w+\}\}", page)

    @pytest.mark.parametrize(
        "name", ["</script><b>", "{{title}}", "<!--<script>", "{% raw %}", "{{ content }}"]
    )
    def test_data_of_any_name_leave_the_page_whole(self, tmp_path: Path, name: str):
        odd = dataclasses.replace(room().objects[0], id=name, category=name)
        page = write_report(tmp_path, bare(Scene(camera(), GROUND, (odd,)))).read_text()
        data = re.search(r'id="view-data">(.*?)</script>', page, re.S)[1]
        assert "<" not in data
        piece = json.loads(data)["scenes"]["result"]["pieces"][0]
        assert (piece["id"], piece["category"]) == (name, name)

    @pytest.mark.parametrize("scene", [room(), Scene(camera(), None, ())], ids=["room", "empty"])
    def test_missing_parts_leave_no_hole(self, tmp_path: Path, scene: Scene):
        page = write_report(tmp_path / "page.html", bare(scene)).read_text()
        for absent in ("None", "nan", 'data-show="truth"', 'class="time"', 'id="photo"'):
            assert absent not in re.sub(r"<(script|style).*?</\1>", "", page, flags=re.S)

    def test_is_written_again_with_metrics(self, tmp_path: Path):
        content = full()
        first = write_report(tmp_path, dataclasses.replace(content, metrics=None)).read_text()
        again = write_report(tmp_path, content).read_text()
        assert "How far from the truth" not in first
        assert "How far from the truth" in again
        assert [p.name for p in tmp_path.iterdir()] == ["report.html"]

    def test_takes_double_precision_and_gradients(self, tmp_path: Path):
        scene = room()
        grown = tuple(
            dataclasses.replace(p, t_world_object=p.t_world_object.double().requires_grad_())
            for p in scene.objects
        )
        assert write_report(tmp_path, bare(dataclasses.replace(scene, objects=grown))).exists()

    def test_has_one_colour_for_an_object_everywhere(self, page: str):
        tint = css(colour(1))
        assert page.count(f"--tint:{tint}") == 3  # the table, and a group in either plan
        assert f'"colour":"{tint}"' in page
        assert ImageColor.getrgb(tint) == tuple(round(255 * c) for c in colour(1))


@pytest.fixture(scope="module")
def browser():
    if not CHROMIUM.exists():
        pytest.skip(f"{CHROMIUM} is not installed")
    sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    with sync_api.sync_playwright() as play:
        chromium = play.chromium.launch(executable_path=str(CHROMIUM), args=FLAGS)
        yield chromium
        chromium.close()


class Visit:
    """A page in a browser, and everything that it complained about or asked for."""

    def __init__(self, browser: Any, path: Path, **how: Any) -> None:
        self.page = browser.new_page(**how)
        self.troubles: list[str] = []
        self.page.on("console", lambda m: self.troubles.append(m.text))
        self.page.on("pageerror", lambda e: self.troubles.append(str(e)))
        self.page.on("request", lambda r: self.note(r.url, path))
        self.page.goto(path.as_uri())
        self.page.wait_for_timeout(400)

    def note(self, url: str, path: Path) -> None:
        if url != path.as_uri() and not url.startswith("data:"):
            self.troubles.append(url)

    def see(self, what: str = "#stage canvas") -> np.ndarray:
        self.page.wait_for_timeout(200)
        raw = self.page.locator(what).screenshot()
        return np.asarray(Image.open(io.BytesIO(raw)).convert("RGB")).astype(int)


def differ(a: np.ndarray, b: np.ndarray) -> float:
    """Share of the pixels that differ."""
    return float((np.abs(a - b).max(-1) > 8).mean())


@pytest.mark.slow
class TestBrowser:
    def test_a_full_page_works_in_every_part(self, browser: Any, tmp_path: Path):
        visit = Visit(browser, write_report(tmp_path, full()), reduced_motion="reduce")
        page = visit.page
        page.uncheck("[data-show=labels]")
        first = visit.see()
        assert len(np.unique(first.reshape(-1, 3), axis=0)) > 500  # it draws
        page.click("[data-world=initial]")
        before = visit.see()
        page.locator("[name=time]").fill("3")
        moment = visit.see()
        box = page.locator("#stage canvas").bounding_box()
        page.mouse.move(box["x"] + 300, box["y"] + 200)
        page.mouse.down()
        page.mouse.move(box["x"] + 420, box["y"] + 230, steps=3)
        page.mouse.up()
        turned = visit.see()
        page.click("[data-look=camera]")
        through = visit.see()
        page.check("[data-show=truth]")
        shots = [first, before, moment, turned, through, visit.see()]
        changes = [differ(a, b) for a, b in pairwise(shots)]
        assert min(changes) > 0.002, changes
        assert visit.troubles == []

    def test_the_motion_plays(self, browser: Any, tmp_path: Path):
        visit = Visit(browser, write_report(tmp_path, full()))
        value = "document.querySelector('[name=time]').value"
        start = float(visit.page.evaluate(value))
        visit.page.click(".play")
        for _ in range(100):  # `wait_for_function` would need eval, which the page forbids
            if float(visit.page.evaluate(value)) != start:
                break
            visit.page.wait_for_timeout(100)
        assert float(visit.page.evaluate(value)) != start
        assert visit.troubles == []

    def test_the_camera_sees_what_the_overlay_shows(self, browser: Any, tmp_path: Path):
        content = dataclasses.replace(full(), image=None)
        how = {"viewport": {"width": 1000, "height": 900}, "reduced_motion": "reduce"}
        visit = Visit(browser, write_report(tmp_path, content), **how)
        for name in ("people", "labels"):
            visit.page.uncheck(f"[data-show={name}]")
        visit.page.click("[data-look=camera]")
        view = visit.see()
        scene = content.scenes["result"]
        fit = min(view.shape[1] / 640, view.shape[0] / 360)
        shift = [(view.shape[1] - fit * 640) / 2, (view.shape[0] - fit * 360) / 2]
        for index, p in enumerate(scene.objects):
            verts = place_object(p).verts
            top = torch.stack([verts[:, 0].mean(), verts[:, 1].amax(), verts[:, 2].mean()])
            u, v, w = (scene.camera.K @ to_camera(top, scene.camera.R_cam_world)).tolist()
            seen = view[round(fit * v / w + shift[1]), round(fit * u / w + shift[0])]
            tint = np.array(colour(index))
            a, b = seen - seen.mean(), tint - tint.mean()
            assert a @ b / np.linalg.norm(a) / np.linalg.norm(b) > 0.95, p.id
        assert visit.troubles == []

    def test_the_bar_between_before_and_after_follows_the_pointer(self, browser, tmp_path: Path):
        visit = Visit(browser, write_report(tmp_path, full()))
        visit.page.locator(".compare").scroll_into_view_if_needed()
        box = visit.page.locator(".compare").bounding_box()
        visit.page.mouse.move(box["x"] + box["width"] * 0.5, box["y"] + 50)
        visit.page.mouse.down()
        visit.page.mouse.move(box["x"] + box["width"] * 0.2, box["y"] + 60)
        visit.page.mouse.up()
        cut = visit.page.evaluate(
            "document.querySelector('.compare').style.getPropertyValue('--cut')"
        )
        assert float(cut.strip("%")) == pytest.approx(20, abs=0.5)

    @pytest.mark.parametrize("content", [bare(room()), bare(Scene(camera(), None, ()))])
    def test_a_bare_page_makes_no_trouble(self, browser: Any, tmp_path: Path, content):
        visit = Visit(browser, write_report(tmp_path, content), color_scheme="dark")
        for look in ("camera", "above", "orbit"):
            visit.page.click(f"[data-look={look}]")
        assert visit.troubles == []

    @pytest.mark.parametrize("world", ["initial", "result"])
    def test_people_of_one_world_alone_are_drawn(self, browser, tmp_path: Path, world: str):
        content = dataclasses.replace(full(), bodies={world: walkers(5, 2)})
        visit = Visit(browser, write_report(tmp_path, content), reduced_motion="reduce")
        shown = visit.see()
        visit.page.uncheck("[data-show=people]")
        assert differ(shown, visit.see()) > 0.002
        assert visit.troubles == []

    def test_a_phone_needs_no_sideways_scrolling(self, browser: Any, tmp_path: Path):
        how = {"viewport": {"width": 400, "height": 700}, "has_touch": True, "is_mobile": True}
        visit = Visit(browser, write_report(tmp_path, full()), **how)
        assert visit.page.evaluate("document.documentElement.scrollWidth") <= 400
        tops = "d => [...d.querySelectorAll('.number')].map(n => [n.offsetTop, n.offsetHeight])"
        for stage in visit.page.locator(".stages > div").all():  # its numbers stand beside it
            first = stage.locator("span").first.evaluate("s => s.offsetTop")
            assert all(abs(t - first) < 8 and h > 0 for t, h in stage.evaluate(tops))
        visit.page.locator("#stage canvas").scroll_into_view_if_needed()
        visit.page.uncheck("[data-show=labels]")
        before = visit.see()
        sides = np.concatenate([before[:, :4], before[:, -4:]])
        assert np.ptp(sides, axis=-1).max() < 30  # grey: no furniture is cut at either side
        hand = visit.page.context.new_cdp_session(visit.page)
        moves = [("touchStart", [40]), ("touchMove", [70]), ("touchMove", [120]), ("touchEnd", [])]
        for kind, gaps in moves:
            points = [{"x": 190 + side * gap, "y": 350} for gap in gaps for side in (-1, 1)]
            hand.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})
        assert differ(before, visit.see()) > 0.05  # two fingers zoom
        assert visit.troubles == []
