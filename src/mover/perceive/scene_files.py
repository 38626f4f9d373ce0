"""What the first scene is found from in a capture folder, and how it is written there."""

import logging
from pathlib import Path

import torch

from ..geometry.runs import decode
from ..readers.camera_file import camera_of, camera_to_json
from ..readers.fields import maybe, number, write_json
from ..readers.hypotheses_file import write_hypotheses
from ..readers.objects_file import detections_of
from ..readers.parts import folder_parts
from ..readers.people_file import people_of
from ..readers.scene_file import write_scene
from ..records import InputError
from .depth_map import read_depth
from .layout import FirstScene, Picture

log = logging.getLogger(__name__)


def read_picture_of(folder: Path, depth: Path | None = None) -> Picture:
    """Camera, annotations and hidden pixels of a capture that needs no scene yet.

    Raises:
        InputError: If camera.json or objects.json is missing or wrong.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: there is no such folder, expected a capture")
    parts = folder_parts(folder)
    if parts.camera is None or parts.objects is None:
        raise InputError(f"{folder}: a first scene needs camera.json and objects.json in it")
    camera = camera_of(parts.camera)
    detections = detections_of(parts.objects, camera, log.warning)
    blank = torch.zeros(camera.height, camera.width, dtype=torch.bool)
    masks = [blank if d.mask is None else decode(d.mask, 0) for d in detections]
    hidden = blank
    if parts.people is not None:
        reference = people_of(parts.people, camera, log.warning).reference
        for row in range(0 if reference is None else len(reference.counts)):
            assert reference is not None
            hidden = hidden | decode(reference, row)
    known = maybe(parts.camera, "height")
    return Picture(
        camera=camera,
        detections=detections,
        masks=torch.stack(masks) if masks else blank[None][:0],
        people=hidden,
        height=None if known is None else number(known, 0.1, 100.0),
        depth=None if depth is None else read_depth(depth, camera),
    )


def write_first_scene(first: FirstScene, folder: Path) -> None:
    """Write scene.json with its meshes, the tilt into camera.json, and what else is possible."""
    write_scene(first.scene, folder / "scene.json")
    parts = folder_parts(folder)
    assert parts.camera is not None
    given = {k: v for k, v in parts.camera.value.items() if k == "height"}
    write_json({**camera_to_json(first.scene.camera), **given}, folder / "camera.json")
    groups = {group[0].piece.id: [h.piece for h in group] for group in first.others}
    energies = {group[0].piece.id: [h.energy for h in group] for group in first.others}
    write_hypotheses(folder, groups, energies)
