"""Pictures of the objects that came out worst: in the image and from above."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from ..geometry.boxes import box_of, corners
from ..metrics_scene import image_box
from ..records import load, map_tensors, replacing
from ..report_overlay import draw_overlay
from ..report_pictures import bitmap, canvas
from ..types import Piece, Scene
from .changes import set_named
from .job import Job, Rebuilt, Trial, noisy_room
from .page import shown
from .tables import Experiment

WORST = 3  # so many pictures
SIDE, HEAD, GAP = 420, 30, 6  # [px] of a panel, of its title, between panels
WIDEST = 1600  # [px] of a whole overlay
MARGIN = 0.3  # around an object, as a share of its size in the image
CLEARANCE = 0.8  # [m] around it in the plan
OTHERS, GUESS, FOUND, TRUE = (205, 205, 205), (120, 120, 190), (200, 60, 50), (30, 120, 60)
BASE = (0, 4, 5, 1)  # corners of a box around its bottom, the last two at its front


@dataclass(frozen=True)
class Worst:
    """An object that came out badly."""

    seed: int
    preset: str
    item: Mapping[str, Any]
    """Its row of metrics.json."""


def worst_objects(experiment: Experiment, count: int = WORST) -> list[Worst]:
    """The objects of the last preset with the lowest IoU3D after the full method."""
    rows = [
        Worst(outcome.seed, outcome.preset, item)
        for outcome in experiment.outcomes
        if outcome.preset == experiment.presets[-1]
        for item in outcome.objects
    ]
    return sorted(rows, key=lambda w: (w.item["full"]["iou3d"], w.seed, w.item["id"]))[:count]


def draw_worst(experiment: Experiment, rooms: str, out: Path) -> list[str]:
    """Draw worst_1.png, ... into OUT/ROOMS; returns their names.

    Each shows the object before, after and in truth in the image, and all three from above.
    """
    names: list[str] = []
    trials: dict[Job, Trial] = {}
    for place, worst in enumerate(worst_objects(experiment), 1):
        job = Job(rooms, worst.seed, worst.preset, out)
        if job not in trials:
            trials[job] = map_tensors(_plain, _trial(job))
        rebuilt = map_tensors(_plain, load(Rebuilt, job.folder / "scenes"))
        names.append(f"worst_{place}.png")
        with replacing(out / rooms / names[-1]) as part:
            draw_object(worst, trials[job], rebuilt).save(part)
    return names


def draw_object(worst: Worst, trial: Trial, rebuilt: Rebuilt) -> Image.Image:
    """Overlays of the initial, the rebuilt and the true scene around an object, and a plan."""
    name, item = worst.item["id"], worst.item
    scenes = {"before": trial.capture.scene, "after": rebuilt.full, "truth": trial.truth}
    found = {key: _piece(scene, name) for key, scene in scenes.items()}
    region = _region([(scenes[k], p) for k, p in found.items() if p is not None and k != "before"])
    panels: list[tuple[str, Image.Image]] = []
    for key, stage in (("before", "initial"), ("after", "full"), ("truth", "")):
        overlay = draw_overlay(canvas(trial.capture.reference, scenes[key], WIDEST), scenes[key])
        title = f"{key}: {_numbers(item[stage])}" if stage else f"truth: {_traits(worst)}"
        panels.append((title, _crop(bitmap(overlay), region)))
    panels.append(("above: before blue, after red, truth green", _plan(trial.truth, found)))
    return _joined(panels)


def _trial(job: Job) -> Trial:
    """The room of a job; studies do not keep theirs, so that it may have to be made again."""
    if job.room.with_suffix(".json").exists():
        return load(Trial, job.room)
    return noisy_room(job.seed, set_named(job.rooms))


def _plain(tensor: Tensor) -> Tensor:
    return tensor.float() if tensor.is_floating_point() else tensor


def _numbers(values: Mapping[str, float]) -> str:
    centre, yaw = shown("center_error", values), shown("yaw_error", values)
    return f"IoU3D {shown('iou3d', values)}, centre {centre} cm, yaw {yaw}°"


def _traits(worst: Worst) -> str:
    item = worst.item
    use = "touched" if item["touched"] else "untouched"
    return f"{worst.preset}, seed {worst.seed}, {item['id']}, {use}, {item['hidden']:.0%} hidden"


def _piece(scene: Scene, name: str) -> Piece | None:
    return next((piece for piece in scene.pieces if piece.id == name), None)


def _region(seen: Sequence[tuple[Scene, Piece]]) -> Float[Tensor, "4"]:
    """A square around all of them, inside the image where it fits, as shares of its sides."""
    boxes = [image_box(piece, scene.camera) for scene, piece in seen]
    shown_boxes = [box for box in boxes if box is not None]
    if not shown_boxes:
        return torch.tensor([0.0, 0.0, 1.0, 1.0])
    stack = torch.stack(shown_boxes)
    low, high = stack[:, :2].amin(0), stack[:, 2:].amax(0)
    camera = seen[0][0].camera
    size = torch.tensor([camera.width, camera.height]).to(low)
    half = ((high - low) * size).max() * (0.5 + MARGIN) / size
    middle = (low + high) / 2
    inside = torch.minimum(torch.maximum(middle, half), 1 - half)
    middle = torch.where(half < 0.5, inside, 0.5)
    return torch.cat([middle - half, middle + half])


def _crop(picture: Image.Image, region: Float[Tensor, "4"]) -> Image.Image:
    """The region; black where it leaves the image."""
    size = torch.tensor([picture.width, picture.height] * 2)
    left, top, right, bottom = (region * size).round().int().tolist()
    square = picture.crop((left, top, max(right, left + 1), max(bottom, top + 1)))
    return square.resize((SIDE, SIDE), Image.Resampling.LANCZOS)


def _plan(truth: Scene, found: Mapping[str, Piece | None]) -> Image.Image:
    """Footprints from above, away from the camera upwards; a thick edge is the front."""
    plan = Image.new("RGB", (SIDE, SIDE), "white")
    pen = ImageDraw.Draw(plan)
    bases = {key: _base(piece) for key, piece in found.items() if piece is not None}
    everything = torch.cat(list(bases.values()))
    low, high = everything.amin(0) - CLEARANCE, everything.amax(0) + CLEARANCE
    zoom = SIDE / float((high - low).max())
    shift = SIDE / 2 - zoom * (low + high) / 2
    for piece in truth.pieces:
        pen.polygon(_points(_base(piece) * zoom + shift), outline=OTHERS)
    for key, colour in (("before", GUESS), ("truth", TRUE), ("after", FOUND)):
        if key in bases:
            points = _points(bases[key] * zoom + shift)
            pen.polygon(points, outline=colour, width=2)
            pen.line(points[2:], fill=colour, width=6)
    pen.line([(GAP, SIDE - 12), (GAP + zoom * 0.5, SIDE - 12)], fill="black", width=2)
    pen.text((GAP, SIDE - 30), "0.5 m", fill="black", font=ImageFont.load_default(13))
    return plan


def _base(piece: Piece) -> Float[Tensor, "4 2"]:
    """Footprint (x, z) [m]; its last two corners are at the front."""
    return corners(box_of(piece))[list(BASE)][:, [0, 2]]


def _points(places: Float[Tensor, "points 2"]) -> list[tuple[float, float]]:
    return [(x, z) for x, z in places.tolist()]


def _joined(panels: Sequence[tuple[str, Image.Image]]) -> Image.Image:
    """Panels side by side under their titles."""
    width = len(panels) * (SIDE + GAP) - GAP
    page = Image.new("RGB", (width, SIDE + HEAD), "white")
    pen = ImageDraw.Draw(page)
    for index, (title, panel) in enumerate(panels):
        left = index * (SIDE + GAP)
        pen.text(
            (left + 4, HEAD / 2), title, fill="black", font=ImageFont.load_default(14), anchor="lm"
        )
        page.paste(panel, (left, HEAD))
    return page
