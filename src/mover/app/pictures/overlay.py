"""A room over its images: furniture tinted, shaded, outlined and named; stills and films of it.

Surfaces in front of a camera become pixels of a sheet, a picture of four channels: colour times
opacity, and opacity.
"""

import dataclasses
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor
from torch.nn.functional import avg_pool2d, normalize

from mover.app.pictures import FILM, STILL, RenderConfig, check_ending
from mover.app.pictures.film import (
    pixels,
    save_film,
    save_still,
    sized,
    video_library,
    video_pictures,
)
from mover.bodies.corrected import in_world
from mover.core.colours import colour, css, person_colour
from mover.core.errors import InputError
from mover.core.observe import Observer, Step, silent
from mover.core.records import map_tensors, record, rows_of
from mover.core.types import Bodies, Camera, Capture, Masks, Scene
from mover.geometry.camera import project, to_camera
from mover.geometry.mesh import face_normals, vertex_normals
from mover.geometry.placement import place_object, placed_at
from mover.geometry.raster import first_hit
from mover.geometry.rle import decode
from mover.io.capture.bodies_file import read_bodies
from mover.io.capture.scene_file import read_scene
from mover.io.formats import read
from mover.stages.masks import widened

FINE = 2  # drawn at twice the size and averaged: smooth edges
LIGHT = (0.35, 0.85, 0.40)  # from where a lamp shines, in the world
NO_OWNER = -1  # owner of a pixel that shows no surface
PERSON = 100_000  # owner of person 0; the furniture is counted from 0
SHARP = 0.85  # cosine between two surfaces whose edge is drawn
LINE, CREASE = 0.75, 0.25  # how opaque outlines and inner edges are
THICK = 550  # [px] of width for each fine pixel of an outline's thickness
OPACITY = 0.62  # of surfaces
AMBIENT, LAMP, FILL = 0.62, 0.48, 0.12  # light of the room, the lamp and the camera
METRE, FAINT = 0.5, 0.6  # opacity of the floor's lines, and their brightness
NEAR = 0.05  # [m], in front of the camera: what is nearer may be anywhere in the picture
EDGE = 1.2  # [m], how far the floor reaches beyond what stands on it


@record
class Surfaces:
    """Triangles in the world, each with a colour and the index of its owner."""

    verts: Float[Tensor, "verts 3"]  #: [m]
    faces: Int[Tensor, "faces 3"]
    normals: Float[Tensor, "faces 3"]
    """Unit vectors; of smooth skin the mean of the normals at the corners."""
    tint: Float[Tensor, "faces 3"]  #: in [0, 1]
    owner: Int[Tensor, " faces"]  #: index of the object, or `PERSON` and the number of the track


@record
class Drawn:
    """What each pixel of an eye shows."""

    owner: Int[Tensor, "h w"]  #: as in `Surfaces`; `NO_OWNER` for nothing
    face: Int[Tensor, "h w"]  #: the first one; any for nothing
    normals: Float[Tensor, "faces 3"]
    """Of the surfaces in the world, towards the eye."""
    tint: Float[Tensor, "faces 3"]


def furniture(scene: Scene) -> Surfaces:
    """All objects of a scene, in the colours of the report."""
    parts: list[Surfaces] = []
    for index, item in enumerate(scene.objects):
        mesh = place_object(item)
        verts, faces = mesh.verts.detach().float(), mesh.faces.long()
        tint = torch.tensor(colour(index)).expand(len(faces), 3)
        owner = torch.full((len(faces),), index)
        parts.append(Surfaces(verts, faces, face_normals(verts, faces), tint, owner))
    return joined(parts)


def people(bodies: Bodies, rows: list[int]) -> Surfaces:
    """Some rows of the bodies, which are in the world, smooth, in the colours of the people."""
    parts: list[Surfaces] = []
    for row in rows:
        verts, faces = bodies.verts[row].detach().float(), bodies.faces.long()
        person = int(bodies.person[row])
        normals = normalize(vertex_normals(verts, faces)[faces].sum(1), dim=-1)
        tint = torch.tensor(person_colour(person)).expand(len(faces), 3)
        owner = torch.full((len(faces),), PERSON + person)
        parts.append(Surfaces(verts, faces, normals, tint, owner))
    return joined(parts)


def joined(parts: list[Surfaces]) -> Surfaces:
    """Several surfaces as one."""
    if not parts:
        none = torch.zeros(0, 3)
        return Surfaces(none, none.long(), none, none, torch.zeros(0).long())
    starts = torch.tensor([0, *[len(p.verts) for p in parts]]).cumsum(0).tolist()
    return Surfaces(
        torch.cat([p.verts for p in parts]),
        torch.cat([p.faces + start for p, start in zip(parts, starts, strict=False)]),
        torch.cat([p.normals for p in parts]),
        torch.cat([p.tint for p in parts]),
        torch.cat([p.owner for p in parts]),
    )


def draw_picture(
    surfaces: Surfaces, camera: Camera, base: Float[Tensor, "h w 3"], ground: float | None = None
) -> tuple[Float[Tensor, "h w 3"], Int[Tensor, "fine_h fine_w"]]:
    """Surfaces over a picture `base` of a camera, of any size.

    The lines of the floor are drawn where its height `ground` [m] is known. Also returned are the
    owners of the pixels, `FINE` along each side of one.
    """
    camera = sized_camera(camera, base.shape[1], base.shape[0])
    sheet, owner = draw_sheet(surfaces, camera, floor_lines(camera, ground, surfaces.verts))
    return over(sheet, base).clamp(0, 1), owner


def floor_lines(
    camera: Camera, ground: float | None, verts: Float[Tensor, "verts 3"]
) -> Float[Tensor, "h w 4"] | None:
    """Lines of the floor below some points; None: its height is not known, or there are none."""
    if ground is None or ground >= 0 or not len(verts):
        return None
    flat = verts[:, [0, 2]]
    return metre_lines(camera, ground, flat.amin(0) - EDGE, flat.amax(0) + EDGE)


def draw_sheet(
    surfaces: Surfaces, camera: Camera, lines: Float[Tensor, "h w 4"] | None
) -> tuple[Float[Tensor, "h w 4"], Int[Tensor, "fine_h fine_w"]]:
    """Surfaces over lines of the floor, and the owners of the fine pixels."""
    drawn = draw(surfaces, sized_camera(camera, FINE * camera.width, FINE * camera.height))
    sheet = paint(drawn)
    if lines is not None:
        free = avg_pool2d((drawn.owner == NO_OWNER).float()[None], FINE)[0, ..., None]
        sheet = sheet + (1 - sheet[..., 3:]) * FAINT * lines * free
    return sheet, drawn.owner


def sized_camera(camera: Camera, width: int, height: int) -> Camera:
    """The same view in pictures of another size [px]."""
    zoom = torch.tensor([width / camera.width, height / camera.height, 1.0])
    K = camera.K.detach().float() * zoom[:, None]
    return Camera(K, camera.R_cam_world.detach().float(), width, height)


def draw(surfaces: Surfaces, camera: Camera) -> Drawn:
    """What the camera sees of the surfaces, whatever their winding."""
    size = (camera.height, camera.width)
    if not len(surfaces.faces):
        none = torch.zeros(size, dtype=torch.long)
        return Drawn(none + NO_OWNER, none, torch.zeros(1, 3), torch.zeros(1, 3))
    points = to_camera(surfaces.verts, camera.R_cam_world)
    face = first_hit(points, surfaces.faces, camera.K, size)[1]
    owner = torch.where(face >= 0, surfaces.owner[face.clamp_min(0)], NO_OWNER)
    away = (surfaces.verts[surfaces.faces].mean(1) * surfaces.normals).sum(-1, keepdim=True) > 0
    normals = torch.where(away, -surfaces.normals, surfaces.normals)
    return Drawn(owner, face.clamp_min(0), normals, surfaces.tint)


def paint(drawn: Drawn) -> Float[Tensor, "height width 4"]:
    """A sheet at 1 / `FINE` of the size of what is drawn."""
    facing = (drawn.normals @ normalize(torch.tensor(LIGHT), dim=0)).clamp_min(0)
    shade = AMBIENT + LAMP * facing + FILL * drawn.normals[:, 2]
    colours, dark = (drawn.tint * shade[:, None]).clamp(0, 1)[drawn.face], drawn.tint * 0.40
    outline, crease = _lines(drawn, max(1, round(drawn.owner.shape[1] / FINE / THICK)))
    for line, opacity in ((crease, CREASE), (outline, LINE)):
        colours[line] = colours[line].lerp(dark[drawn.face[line]], opacity)
    alpha = torch.where(outline, LINE, torch.where(drawn.owner != NO_OWNER, OPACITY, 0.0))
    fine = torch.cat([colours.mul_(alpha[..., None]), alpha[..., None]], -1)
    return avg_pool2d(fine.permute(2, 0, 1), FINE).permute(1, 2, 0)


def over(sheet: Float[Tensor, "h w 4"], picture: Float[Tensor, "h w 3"]) -> Float[Tensor, "h w 3"]:
    """A sheet on a picture."""
    return sheet[..., :3] + (1 - sheet[..., 3:]) * picture


def _lines(drawn: Drawn, thickness: int) -> tuple[Bool[Tensor, "h w"], Bool[Tensor, "h w"]]:
    """Pixels beside another owner, and those beside a crease of their own object."""
    outline, crease = torch.zeros_like(drawn.owner).bool(), torch.zeros_like(drawn.owner).bool()
    for axis in (0, 1):
        n = drawn.owner.shape[axis] - 1
        first, second = drawn.owner.narrow(axis, 0, n), drawn.owner.narrow(axis, 1, n)
        border = first != second
        outline.narrow(axis, 0, n).logical_or_(border)
        outline.narrow(axis, 1, n).logical_or_(border)
        one, other = drawn.face.narrow(axis, 0, n), drawn.face.narrow(axis, 1, n)
        inner = (one != other) & ~border & (first != NO_OWNER) & (first < PERSON)
        at = inner.nonzero(as_tuple=True)
        inner[at] = (drawn.normals[one[at]] * drawn.normals[other[at]]).sum(-1) < SHARP
        crease.narrow(axis, 0, n).logical_or_(inner)
    return widened(outline[None], thickness - 1)[0] & (drawn.owner != NO_OWNER), crease


def floor_points(camera: Camera, height: float) -> Float[Tensor, "h w 3"]:
    """Where the ray of each pixel meets the plane y = `height` [m]; inf where it never does."""
    rows, columns = torch.arange(camera.height) + 0.5, torch.arange(camera.width) + 0.5
    v, u = torch.meshgrid(rows, columns, indexing="ij")
    rays = torch.stack([u, v, torch.ones_like(u)], -1) @ torch.linalg.inv(camera.K).mT
    rays = rays @ camera.R_cam_world
    along = height / torch.where(rays[..., 1].abs() < 1e-6, 1e-6, rays[..., 1])
    return torch.where((along > 0)[..., None], rays * along[..., None], torch.inf)


def metre_lines(
    camera: Camera, height: float, low: Float[Tensor, "2"], high: Float[Tensor, "2"]
) -> Float[Tensor, "h w 4"]:
    """A sheet with white lines at whole metres of the floor, fading at two corners (x, z) [m]."""
    points = floor_points(camera, height)[..., [0, 2]]
    points = torch.where(points.isfinite(), points, 1e6)
    steps = [torch.gradient(points, dim=d)[0].abs() for d in (0, 1)]
    spread = torch.maximum(*steps).clamp_min(1e-6)
    near = ((points - points.round()).abs() / spread).amin(-1)
    coarse = (1 - spread.amax(-1) * 4).clamp(0, 1)
    inside = (torch.minimum(points - low, high - points).amin(-1) / EDGE).clamp(0, 1)
    alpha = METRE * (1.2 - near).clamp(0, 1) * coarse * inside
    return alpha[..., None].expand(-1, -1, 4)


SOME_BODIES = 5  # in the picture of a check
WHITE = (1.0, 1.0, 1.0)
WIDEST = 1280  # [px], of a picture in the report


def draw_overlay(image: Float[Tensor, "h w 3"], scene: Scene) -> Float[Tensor, "height width 3"]:
    """Draw the furniture of `scene` over a picture in [0, 1] of the whole view of its camera."""
    surfaces = furniture(scene)
    if not len(surfaces.faces):
        return image
    picture, owner = draw_picture(surfaces, scene.camera, image, scene.ground)
    return _named(picture, owner[::FINE, ::FINE], scene)


def save_overlay(capture: Capture, path: Path) -> Path:
    """Draw what was given over the reference image into the file `path` (.png, .jpg, ...).

    The initial scene, some of the bodies, and the boxes and masks that all of it should lie on.
    """
    capture = map_tensors(on_cpu, capture)
    scene, bodies = capture.scene, capture.bodies
    frames, picture = list[int](), canvas(capture.reference, scene)
    if bodies is not None:
        count = len(bodies.frame)
        rows = torch.linspace(0, count - 1, min(count, SOME_BODIES)).long()
        frames, some = bodies.frame[rows].tolist(), in_world(rows_of(bodies, rows), scene.camera)
        picture, _ = draw_picture(people(some, list(range(len(rows)))), scene.camera, picture)
    picture = draw_overlay(picture, scene)
    save_still(_given(picture, capture, frames), path)
    return path


def _given(
    picture: Float[Tensor, "h w 3"], capture: Capture, frames: Sequence[int]
) -> Float[Tensor, "h w 3"]:
    """Boxes and masks of the furniture in the objects' colours, people's in some frames white."""
    from scipy.ndimage import binary_erosion

    page, size = Image.fromarray(pixels(picture)), (picture.shape[1], picture.shape[0])
    pen, camera = ImageDraw.Draw(page), capture.scene.camera
    zoom = torch.tensor([size[0] / camera.width, size[1] / camera.height] * 2)
    order = [one.annotation for one in capture.scene.objects]
    masks: list[tuple[Masks, int, tuple[float, float, float]]] = []
    for seen in capture.detections:
        tint = colour(order.index(seen.id)) if seen.id in order else WHITE
        pen.rectangle((seen.box * zoom).tolist(), outline=css(tint), width=2)
        masks += [] if seen.mask is None else [(seen.mask, 0, tint)]
    if capture.people is not None:
        shown = torch.isin(capture.people.frame, torch.tensor(frames, dtype=torch.long))
        masks += [(capture.people.masks, row, WHITE) for row in shown.nonzero()[:, 0].tolist()]
    found = np.asarray(page).copy()
    for mask, row, tint in masks:
        shape = Image.fromarray(decode(mask, row).numpy()).resize(size)
        inside = np.asarray(shape, dtype=np.bool_)
        found[inside & ~binary_erosion(inside, iterations=2)] = [round(255 * c) for c in tint]
    return torch.from_numpy(found).float() / 255


def on_cpu(tensor: Tensor) -> Tensor:
    """On the CPU, in single precision, without a history."""
    there = tensor.detach().cpu()
    return there.float() if there.is_floating_point() else there


def canvas(image: Float[Tensor, "h w 3"] | None, scene: Scene) -> Float[Tensor, "height width 3"]:
    """What the furniture is drawn on, at most `WIDEST` pixels wide: the image or a backdrop."""
    if image is None:
        width = min(WIDEST, scene.camera.width)
        return backdrop(max(1, round(width * scene.camera.height / scene.camera.width)), width)
    if image.shape[1] <= WIDEST:
        return image.detach().cpu().float()
    size = (WIDEST, max(1, round(WIDEST * image.shape[0] / image.shape[1])))
    return sized(Image.fromarray(pixels(image)), size)


def backdrop(height: int, width: int) -> Float[Tensor, "height width 3"]:
    """A neutral picture, a little lighter above."""
    fade = torch.linspace(0.93, 0.80, height)[:, None, None]
    return fade.expand(height, width, 3) * torch.tensor([0.985, 0.99, 1.0])


def _named(
    picture: Float[Tensor, "h w 3"], owner: Int[Tensor, "h w"], scene: Scene
) -> Float[Tensor, "h w 3"]:
    """Write each visible object's id over its middle, moved down until it covers no other."""
    page = Image.fromarray(pixels(picture))
    pen = ImageDraw.Draw(page)
    size = max(10.0, picture.shape[1] / 80)
    font = ImageFont.load_default(size)
    taken: list[tuple[float, float, float, float]] = []
    for index, item in enumerate(scene.objects):
        visible = (owner == index).nonzero()
        if len(visible) < size * size:
            continue
        y, x = visible.double().mean(0).tolist()
        wide, high = pen.textlength(item.id, font) / 2 + 0.55 * size, 0.75 * size
        box = (x - wide, y - high, x + wide, y + high)
        while any(
            box[0] < b[2] and b[0] < box[2] and box[1] < b[3] and b[1] < box[3] for b in taken
        ):
            y += 0.5 * size
            box = (x - wide, y - high, x + wide, y + high)
        taken.append(box)
        red, green, blue = (0.72 * c for c in colour(index))
        pen.rounded_rectangle(box, size * 0.45, fill=css((red, green, blue)))
        pen.text((x, y), item.id, fill="white", font=font, anchor="mm")
    return torch.from_numpy(np.asarray(page).copy()).float() / 255


FPS = 5.0  # of images that have no time


def render_result(
    out: Path,
    path: Path,
    config: RenderConfig,
    capture: Path | None = None,
    observe: Observer = silent,
) -> int:
    """Draw a result into a .png, .jpg, .jpeg or .mp4; the number of pictures.

    The video of the capture, or its reference image, is behind the furniture.

    Raises:
        InputError: If something is missing or the ending of `path` is none of these.
    """
    check_ending("--to", path, STILL + FILM)
    initial = config.scene == "initial"
    scene = read_scene(out / ("initial.json" if initial else "scene.json"))
    file = out / ("initial_bodies.npz" if initial else "bodies.npz")
    bodies = read_bodies(file) if file.is_file() else None
    frames = [] if bodies is None else bodies.frame.unique().tolist()
    if not scene.objects and not frames:
        raise InputError("scene.json: the room is empty: there is nothing to draw")
    shown = bodies if config.people else None
    if path.suffix.lower() in STILL:
        middle = frames[len(frames) // 2] if frames else 0
        frame = middle if config.frame is None else config.frame
        save_still(next(render_room(scene, shown, [frame], config.width, capture)), path)
        return 1
    video_library(f"--to {path.name}")
    if bodies is None or not frames:
        raise InputError("--to: nothing moves: ask for a .png")
    steps = torch.tensor(frames).diff().float()
    rate = (bodies.fps or FPS) / (max(1.0, float(steps.median())) if len(steps) else 1.0)
    return save_film(render_room(scene, shown, frames, config.width, capture, observe), rate, path)


def render_room(
    scene: Scene,
    bodies: Bodies | None,
    frames: Sequence[int],
    width: int,
    capture: Path | None = None,
    observe: Observer = silent,
) -> Iterator[Float[Tensor, "h w 3"]]:
    """A room and the people in its world, one picture a frame, even in width and height [px]."""
    width -= width % 2
    size = width, max(2, 2 * round(width * scene.camera.height / scene.camera.width / 2))
    camera, base = sized_camera(scene.camera, *size), backdrop(size[1], size[0])
    found: Iterator[Float[Tensor, "h w 3"] | None] = iter([None] * len(frames))
    if capture is not None:
        image, found = read("folder", capture).reference, video_pictures(capture, frames, size)
        base = base if image is None else sized(Image.fromarray(pixels(image)), size)
    walked = torch.zeros(0, 3)  # two corners of where people ever are
    if bodies is not None and len(bodies.verts):
        ends = bodies.verts.amin((0, 1)), bodies.verts.amax((0, 1))
        walked = torch.stack(ends).detach().float()

    def empty(frame: int) -> tuple[Surfaces, Tensor | None, Tensor]:
        """The furniture where it stands, lines of the floor, and the sheet of both."""
        stands = tuple(placed_at(item, frame) for item in scene.objects)
        room = furniture(dataclasses.replace(scene, objects=stands))
        lines = floor_lines(camera, scene.ground, torch.cat([room.verts, walked]))
        return room, lines, draw_sheet(room, camera, lines)[0]

    known, moved = None, any(item.segments for item in scene.objects)
    for number, (frame, picture) in enumerate(zip(frames, found, strict=True)):
        observe(Step("render", number, len(frames)))
        known = empty(frame) if known is None or moved else known
        room, lines, sheet = known
        rows = [] if bodies is None else (bodies.frame == frame).nonzero()[:, 0].tolist()
        if bodies is not None and rows:  # only where they are is anything new
            part = window_of(bodies.verts[rows].flatten(0, 1), camera)
            if sheet[part].numel():
                surfaces, sheet = joined([room, people(bodies, rows)]), sheet.clone()
                own = None if lines is None else lines[part]
                sheet[part] = draw_sheet(surfaces, cropped(camera, part), own)[0]
        yield over(sheet, base if picture is None else picture).clamp(0, 1)


def window_of(verts: Float[Tensor, "verts 3"], camera: Camera) -> tuple[slice, slice]:
    """Rows and columns of a picture in which points are seen, and their outlines."""
    seen = to_camera(verts.float(), camera.R_cam_world)
    if bool((seen[:, 2] < NEAR).any()):
        return slice(0, camera.height), slice(0, camera.width)
    at = project(seen, camera.K)
    margin = 2 + camera.width // THICK
    ends = torch.stack([at.amin(0).floor() - margin, at.amax(0).ceil() + margin]).long()
    (left, right), (top, bottom) = (
        ends[:, k].clamp(0, side).tolist() for k, side in enumerate((camera.width, camera.height))
    )
    return slice(top, bottom), slice(left, right)


def cropped(camera: Camera, part: tuple[slice, slice]) -> Camera:
    """The camera of a part of a picture."""
    down, right = part
    K = camera.K - torch.tensor([[0.0, 0, right.start], [0, 0, down.start], [0, 0, 0]])
    return Camera(K, camera.R_cam_world, right.stop - right.start, down.stop - down.start)
