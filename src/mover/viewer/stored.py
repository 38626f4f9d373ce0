"""Read the evidence back from the stages that a run left on disk."""

import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

import torch

from .. import records
from ..stages.assign_touches import Contacts
from ..stages.gather_cues import Cues
from ..types import Scene
from .layers import (
    Layers,
    contact_points,
    depth_points,
    floor_ellipses,
    place_ellipses,
    space_surface,
)

log = logging.getLogger(__name__)
Out = TypeVar("Out")


def read_layers(out: Path, run: Mapping[str, Any], scene: Scene) -> Layers:
    """The evidence of a result; what a run did not leave, or not in today's form, is left out.

    Args:
        out: Folder of the result.
        run: What its run.json holds.
        scene: The result.
    """
    cues = _last(Cues, "gather_cues", out, run)
    contacts = _last(Contacts, "assign_touches", out, run)
    points = None
    if cues is not None and cues.maps is not None:
        points = depth_points(cues.maps, scene.camera)
    spread = run.get("camera_covariance")
    return Layers(
        near=None if points is None else points.near,
        far=None if points is None else points.far,
        space=None if cues is None else space_surface(cues.space.volume),
        contacts=contact_points(
            None if contacts is None else contacts.touches, tuple(p.id for p in scene.pieces)
        ),
        ellipses={} if spread is None else floor_ellipses(scene, torch.tensor(spread)),
        places=place_ellipses(run.get("explanations", ())),
    )


def _last(kind: type[Out], stage: str, out: Path, run: Mapping[str, Any]) -> Out | None:
    """The output of a stage when it last ran."""
    names = [str(s.get("fingerprint") or "") for s in run.get("stages", ()) if s["name"] == stage]
    if not names or not names[-1]:
        return None
    path = out / "stages" / stage / names[-1]
    if not path.with_suffix(".json").is_file():
        return None
    try:
        return records.load(kind, path)
    except Exception as error:  # another version's records may differ in any way
        log.warning("%s of %s cannot be shown: %s", stage, out, error)
        return None
