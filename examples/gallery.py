"""Draw every piece of furniture and every motion: python examples/gallery.py FOLDER.

Contact sheets as JPEG: furniture.jpg, seats.jpg (a sitter or sleeper on every style, seen from
the side), motions.jpg (each motion from beginning to end), people.jpg (two people; behind and in
front of furniture, as the camera of a known room sees it).
"""

import dataclasses
import math
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont, ImageOps

from mover.app.pictures.film import pixels
from mover.app.pictures.overlay import Surfaces, backdrop, draw_picture, furniture, joined, people
from mover.bodies.skinning import open_body
from mover.core.types import Bodies, Camera, Scene, SceneObject
from mover.furniture.library import STYLES, make_piece
from mover_bench.rooms.config import RoomConfig
from mover_bench.rooms.known import draw_frame, make_room
from mover_bench.rooms.motion import Performance, Stage, Stop, Task, perform
from mover_bench.rooms.placed import Placed
from mover_bench.rooms.poses import make_person, rows, skinned
from mover_bench.rooms.render import COLOURS

CELL, CAPTION, MOST = (230, 200), 20, 250_000  # [px], [px], [bytes] of a sheet
SEATS = ("chair", "armchair", "office chair", "stool", "bench", "sofa")
SIDE, FRONT, CORNER = math.pi / 2, 0.0, 0.65  # from where the eye looks [rad]


@dataclass(frozen=True)
class Cell:
    """One picture of a sheet."""

    caption: str
    picture: Image.Image


def scene_of(pieces: tuple[Placed, ...]) -> Scene:
    """Pieces on a floor at y = 0, for the painter."""
    placed = [
        SceneObject(p.id, p.furniture.category, p.furniture.mesh, "", None, "ground",
              torch.tensor([p.at[0], 0.0, p.at[1]]), torch.tensor(float(p.heading)), torch.ones(3))
        for p in pieces
    ]  # fmt: skip
    return Scene(Camera(torch.eye(3), torch.eye(3), 1, 1), 0.0, tuple(placed))


def coloured(pieces: tuple[Placed, ...]) -> Surfaces:
    """Pieces in the colours of known rooms."""
    found = furniture(scene_of(pieces))
    colours = [COLOURS.get(p.furniture.category, (0.6, 0.6, 0.6)) for p in pieces]
    tint = torch.tensor(colours or [(0.0, 0.0, 0.0)])[found.owner]
    return dataclasses.replace(found, tint=tint)


def picture_of(still: Surfaces, moving: Surfaces, azimuth: float, elevation: float) -> Image.Image:
    """A picture from around, as near as it may be to see everything."""
    both, (width, height) = joined([still, moving]), CELL
    flat = math.cos(elevation)
    out = [math.sin(azimuth) * flat, math.sin(elevation), math.cos(azimuth) * flat]
    away, right = torch.tensor(out), torch.tensor([math.cos(azimuth), 0.0, -math.sin(azimuth)])
    down = torch.linalg.cross(-away, right)
    R, focal = torch.stack([right, down / down.norm(), -away]), 1.3 * height
    K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])
    middle = (both.verts.amin(0) + both.verts.amax(0)) / 2
    x, y, z = ((both.verts - middle) @ R.mT).unbind(-1)
    reach = 2.12 * focal * torch.maximum(x.abs() / width, y.abs() / height)
    eye = middle + float((reach - z).amax().clamp_min(1.0)) * away
    seen = dataclasses.replace(both, verts=both.verts - eye)
    base = backdrop(height, width)
    return Image.fromarray(pixels(draw_picture(seen, Camera(K, R, width, height), base)[0]))


def surfaces_of(verts: np.ndarray) -> Surfaces:
    """One body."""
    one, zero = torch.from_numpy(verts)[None].float(), torch.zeros(1).long()
    body = Bodies(one, open_body().faces, None, (), zero, zero, None, "world", None)
    return people(body, [0])


def sheet(cells: list[Cell], columns: int) -> Image.Image:
    """All cells on one page."""
    count = math.ceil(len(cells) / columns)
    wide, high = CELL[0], CELL[1] + CAPTION
    page = Image.new("RGB", (columns * wide, count * high), "white")
    pen, font = ImageDraw.Draw(page), ImageFont.load_default(13)
    for index, cell in enumerate(cells):
        x, y = index % columns * wide, index // columns * high
        page.paste(ImageOps.fit(cell.picture, CELL, Image.Resampling.LANCZOS), (x, y))
        pen.text((x + 6, y + CELL[1] + 3), cell.caption, fill="black", font=font)
    return page


def furniture_cells() -> list[Cell]:
    """Every style of every piece."""
    cells = []
    for name, styles in STYLES.items():
        for style in range(styles):
            piece = make_piece(name, np.random.default_rng(style), style)
            still = coloured((Placed(name, piece, (0.0, 0.0), 0.0),))
            size = " x ".join(f"{100 * edge:.0f}" for edge in piece.size)
            cells.append(
                Cell(f"{name} {style}: {size} cm", picture_of(still, joined([]), CORNER, 0.4))
            )
    return cells


@dataclass(frozen=True)
class Played:
    """What a person did among objects."""

    stage: Stage
    done: Performance
    still: Surfaces

    def cell(self, caption: str, frame: int, azimuth: float, elevation: float = 0.12) -> Cell:
        """A picture of a frame."""
        posture = rows(self.done.posture, slice(frame, frame + 1))
        body = surfaces_of(skinned(self.stage.person, posture)[0])
        return Cell(caption, picture_of(self.still, body, azimuth, elevation))


def played(pieces: tuple[Placed, ...], tasks: tuple[Task, ...], seed: int = 0) -> Played:
    """Let a person of a random shape do tasks among pieces."""
    rng = np.random.default_rng(seed)
    shape = [float(b) for b in np.clip(rng.normal(0, 0.7, 4), -1.4, 1.4)] + [0.0] * 6
    stage = Stage(make_person(shape), pieces, np.array([[-3.0, -3.0], [3.0, 3.0]]), 10.0)
    place = np.array([1.6, 2.2])
    done = perform(stage, tasks, Stop(place, 3.0, place), rng)
    for reason in done.refused:
        print(f"refused: {reason}")
    return Played(stage, done, coloured(pieces))


def first_run(labels: tuple[str, ...], wanted: str) -> list[int]:
    """Frames of an action when it is first done."""
    frames = [k for k, label in enumerate(labels) if label == wanted]
    return [k for n, k in enumerate(frames) if k - frames[0] == n]


def spread(frames: list[int], count: int) -> list[int]:
    """Some of the frames, evenly, the first and the last among them."""
    return [frames[round(k)] for k in np.linspace(0, len(frames) - 1, count)] if frames else []


def one(name: str, style: int, sizes: int) -> tuple[Placed, ...]:
    """A piece in the middle of the floor, or none."""
    if not name:
        return ()
    piece = make_piece(name, np.random.default_rng(sizes), style)
    return (Placed(f"{name} {style}", piece, (0.0, 0.0), 0.0),)


MOTIONS: tuple[tuple[str, Task, str, float], ...] = (
    ("", Task("walk", goal=(0.0, -1.5)), "walk", SIDE),
    ("chair", Task("sit", 0), "sit down", SIDE),
    ("chair", Task("sit", 0), "sit", SIDE),
    ("chair", Task("sit", 0), "stand up", SIDE),
    ("armchair", Task("lean", 0), "lean", SIDE),
    ("table", Task("table", 0, side=1), "reach", FRONT),
    ("single bed", Task("lie", 0, side=1, roll=True), "lie down", CORNER),
    ("single bed", Task("lie", 0, side=1, roll=True), "lie", CORNER),
    ("single bed", Task("lie", 0, side=1, roll=True), "get up", CORNER),
)
"""A piece, what is done with it, the label of the frames, and from where they are seen."""


def motion_cells() -> list[Cell]:
    """Six moments of each motion."""
    cells: list[Cell] = []
    for name, task, label, azimuth in MOTIONS:
        play = played(one(name, 0, 1), (task,))
        wanted = "left hand" if label == "reach" and "left hand" in play.done.labels else label
        frames = [k for k, found in enumerate(play.done.labels) if found == label]
        frames = frames if label in ("walk", "lie") else first_run(play.done.labels, wanted)
        if label == "walk":  # two steps on the way, then the last ones
            frames = frames[12:24]
        for frame in spread(frames, 6):
            elevation = 0.12 if azimuth != CORNER else 0.35
            cells.append(play.cell(f"{label}, {frame / 10:.1f} s", frame, azimuth, elevation))
    return cells + pass_cells()


def pass_cells() -> list[Cell]:
    """Behind a table, around it, and in front of it."""
    tasks = tuple(
        Task("walk", goal=goal) for goal in ((1.6, -1.3), (-1.6, -1.3), (-1.6, 1.2), (1.6, 1.2))
    )
    play = played(one("table", 0, 1), tasks)
    pelvis = play.done.posture.pelvis
    frames = np.flatnonzero((np.abs(pelvis[:, 0]) < 0.75) & (np.arange(len(pelvis)) > 35)).tolist()
    return [play.cell(f"pass, {k / 10:.1f} s", k, FRONT, 0.2) for k in spread(frames, 6)]


def seat_cells() -> list[Cell]:
    """A person on every style of everything that one sits or lies on, from the side."""
    cells: list[Cell] = []
    for name, style in _designs(SEATS):
        pieces = one(name, style, style)
        lean = pieces[0].furniture.back_height > 0
        play = played(pieces, (Task("lean" if lean else "sit", 0),), seed=style)
        for label in ("sit", "lean")[: 1 + lean]:
            cells += _at_rest(play, f"{label}: {name} {style}", label, SIDE)
    for name, style in _designs(("single bed", "double bed", "sofa")):
        play = played(one(name, style, style), (Task("lie", 0, side=1),), seed=style)
        cells += _at_rest(play, f"lie: {name} {style}", "lie", FRONT if name == "sofa" else SIDE)
    for name, style in _designs(("table", "desk", "cabinet")):
        play = played(one(name, style, style), (Task("table", 0, side=0),), seed=style)
        hand = next((h for h in play.done.labels if h.endswith("hand")), "left hand")
        cells += _at_rest(play, f"{hand}: {name} {style}", hand, SIDE)
    return cells


def _designs(names: tuple[str, ...]) -> list[tuple[str, int]]:
    return [(name, style) for name in names for style in range(STYLES[name])]


def _at_rest(play: Played, caption: str, label: str, azimuth: float) -> list[Cell]:
    frames = first_run(play.done.labels, label) if label in play.done.labels else []
    if not frames:
        empty = Image.new("RGB", CELL, (235, 225, 225))
        return [Cell(f"{caption}: refused", empty)]
    return [play.cell(caption, frames[len(frames) // 2], azimuth)]


def people_cells() -> list[Cell]:
    """A known room with two people through its camera, at moments that hide and show them."""
    cells: list[Cell] = []
    for seed, count in ((0, 2), (1, 1)):
        room = make_room(seed, RoomConfig(width=460, height=400, people=count, least_frames=60))
        last = int(room.bodies.frame.max())
        for frame in np.linspace(0.04 * last, 0.96 * last, 8).round().astype(int).tolist():
            doing = {room.actions[k] for k in (room.bodies.frame == frame).nonzero()[:, 0].tolist()}
            caption = f"room {seed}, frame {frame}: {', '.join(sorted(doing))}"
            cells.append(Cell(caption, Image.fromarray(pixels(draw_frame(room, frame)))))
    return cells


def save(page: Image.Image, path: Path) -> None:
    """Write a JPEG of at most `MOST` bytes."""
    for quality in range(88, 30, -4):
        page.save(path, quality=quality, optimize=True)
        if path.stat().st_size <= MOST:
            return


def main(folder: Path, names: list[str]) -> None:
    """Draw the sheets that are asked for, or all."""
    torch.set_num_threads(1)
    folder.mkdir(parents=True, exist_ok=True)
    sheets = {
        "furniture": (furniture_cells, 10),
        "motions": (motion_cells, 6),
        "seats": (seat_cells, 8),
        "people": (people_cells, 4),
    }
    for name in names or list(sheets):
        cells, columns = sheets[name]
        save(sheet(cells(), columns), folder / f"{name}.jpg")
        print(folder / f"{name}.jpg")


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2:])
