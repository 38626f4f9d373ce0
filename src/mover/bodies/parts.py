"""Parts of a body that touch things: soles, seat, thighs, back, palms, forearms.

Of a skinned body they follow from the weights and from normals and heights in the zero pose, so
that no list of vertices is shipped. Meshes of unknown topology are matched to the open body.
"""

import logging

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..records import InputError, record
from ..types import Bodies
from .bare import match
from .limbs import LANDMARKS, landmark_rings, thin
from .lowest import lowest_soles
from .part_names import PARTS
from .skin import model_parts
from .skinning import SkinnedBody, open_body
from .smpl_arrays import KINDS
from .smpl_files import load_smpl
from .smpl_model import skin_of_model

log = logging.getLogger(__name__)

__all__ = ["LANDMARKS", "PARTS", "Parts", "members", "parts_of"]

POSES = 4
"""Poses that vote on the parts of an unknown mesh."""


@record
class Parts:
    """Which part of the body each vertex belongs to."""

    part_of: Int[Tensor, " verts"]
    """Index into `PARTS`; -1: none."""
    rings: Int[Tensor, "landmarks members"]
    """Vertices around each of `LANDMARKS`: their mean is about where the joint is. Empty where the
    mesh could not be matched to a human body."""


def members(parts: Parts, *names: str) -> Bool[Tensor, " verts"]:
    """Which vertices belong to one of these parts."""
    wanted = torch.tensor([PARTS.index(n) for n in names], device=parts.part_of.device)
    return torch.isin(parts.part_of, wanted)


def parts_of(bodies: Bodies, up_cam: Float[Tensor, "3"] | None = None) -> Parts:
    """Parts of these bodies: by the model's skin where it is known, else by geometry.

    Args:
        bodies: People with one topology, in any poses.
        up_cam: Direction of up in the frame of `bodies`; a level camera or +y of the world if not
            given. Asked only of a mesh that cannot be matched to a human body: its soles are what
            lies lowest.
    """
    found = _find(bodies, up_cam)
    device = bodies.verts.device
    return Parts(found.part_of.to(device), found.rings.to(device))


def _find(bodies: Bodies, up_cam: Float[Tensor, "3"] | None) -> Parts:
    model = known_model(bodies.faces, bodies.verts.shape[1]) or _users_model(bodies)
    if model is not None:
        return _of_model(model)
    if bodies.verts.shape[0] == 0:
        return _unmatched(torch.full((bodies.verts.shape[1],), -1))
    rows = torch.linspace(0, bodies.verts.shape[0] - 1, POSES).round().long().unique()
    meshes = bodies.verts[rows].detach().cpu().double()
    faces = bodies.faces.detach().cpu()
    found = match(meshes.numpy(), faces.numpy())
    if found is not None:
        return Parts(torch.from_numpy(found.part), torch.from_numpy(found.rings))
    log.warning("the bodies' mesh does not look like a whole person: only its soles are looked for")
    default = (0.0, -1.0, 0.0) if bodies.space == "camera" else (0.0, 1.0, 0.0)
    up = torch.tensor(default) if up_cam is None else up_cam.detach().cpu()
    return _unmatched(lowest_soles(meshes, faces, up.to(meshes)))


def known_model(faces: Int[Tensor, "faces 3"], verts: int) -> SkinnedBody | None:
    """The shipped body with exactly this topology, if there is one."""
    for model in (open_body("small"), open_body("full")):
        if model.verts.shape[0] == verts and torch.equal(model.faces, faces.cpu()):
            return model
    return None


def _users_model(bodies: Bodies) -> SkinnedBody | None:
    """The skin of the user's licensed model, where its files are there and fit these bodies."""
    named = [] if bodies.pose is None else [(bodies.pose.model, bodies.pose.gender)]
    count = bodies.verts.shape[1]
    for name, gender in [*named, *((n, "neutral") for n, k in KINDS.items() if k.verts == count)]:
        try:
            skin = skin_of_model(load_smpl(name, gender)) if name in KINDS else None
        except InputError:
            continue
        if skin is not None and torch.equal(skin.faces, bodies.faces.cpu()):
            return skin
    return None


def _of_model(model: SkinnedBody) -> Parts:
    rings = thin(model.verts.numpy(), landmark_rings(model))
    return Parts(model_parts(model), torch.from_numpy(rings))


def _unmatched(part_of: Int[Tensor, " verts"]) -> Parts:
    return Parts(part_of, torch.zeros((0, 0), dtype=torch.long))
