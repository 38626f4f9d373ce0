"""Which keypoints count, and how much."""

import dataclasses

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..bodies.keypoints import LAYOUTS
from ..records import InputError
from ..types import Camera, Keypoints
from .config import FitConfig, Stage
from .energy import Seen
from .limits import resting, spreads
from .rig import Rig
from .tracks import triples_of

LOOSE = ("neck", "left_hip", "right_hip", "pelvis")
HAND = ("index", "middle", "ring", "pinky", "thumb")


def kind_of(name: str) -> str:
    """`body`, `hand` or `face`: whose weight a keypoint has."""
    if name.startswith("face_"):
        return "face"
    return "hand" if any(part in name for part in HAND) else "body"


def confidence_of(keypoints: Keypoints, config: FitConfig) -> Float[Tensor, "rows layout"]:
    """Confidence of keypoints, 0 where they are missing, not finite, or doubtful."""
    sure = keypoints.confidence.nan_to_num(0).clamp(0, 1)
    there = keypoints.points.isfinite().all(-1) & (sure >= config.least_confidence)
    factor = [config.loose if n in LOOSE else 1.0 for n in LAYOUTS[keypoints.layout]]
    # A hand that is written twice (as wrist of the body and of the hand) counts twice.
    return torch.where(there, sure, torch.zeros_like(sure)) * sure.new_tensor(factor)


def usable_rows(
    keypoints: Keypoints, config: FitConfig
) -> tuple[Int[Tensor, " some"], tuple[str, ...]]:
    """Rows with enough keypoints of the body, and a warning where others are left out.

    Raises:
        InputError: If there is none.
    """
    body = torch.tensor([kind_of(name) == "body" for name in LAYOUTS[keypoints.layout]])
    count = ((confidence_of(keypoints, config) > 0) & body).sum(1)
    rows = torch.nonzero(count >= config.least_joints)[:, 0]
    if not len(rows):
        found = f"{len(count)} rows with at most {int(count.max()) if len(count) else 0}"
        raise InputError(
            f"keypoints: {found} joints of the body, expected a row with {config.least_joints}"
        )
    left = len(count) - len(rows)
    text = f"{left} of {len(count)} rows have fewer than {config.least_joints} joints: left out"
    return rows, (text,) if left else ()


def rows_of(keypoints: Keypoints, rows: Int[Tensor, " some"]) -> Keypoints:
    """Some rows."""
    return dataclasses.replace(
        keypoints, points=keypoints.points[rows], confidence=keypoints.confidence[rows],
        frame=keypoints.frame[rows], person=keypoints.person[rows],
    )  # fmt: skip


def seen_at_all(keypoints: Keypoints, config: FitConfig) -> Bool[Tensor, " layout"]:
    """Keypoints that some row sees and some stage looks at."""
    stages = config.stages
    wanted = {
        "body": True,
        "hand": any(stage.hand_joints > 0 for stage in stages),
        "face": any(stage.face_joints > 0 for stage in stages),
    }
    looked_at = torch.tensor([wanted[kind_of(n)] for n in LAYOUTS[keypoints.layout]])
    return (confidence_of(keypoints, config) > 0).any(0) & looked_at


def seen_of(keypoints: Keypoints, rig: Rig, camera: Camera, config: FitConfig) -> Seen:
    """What the fit looks at."""
    weight = confidence_of(keypoints, config)[:, rig.keypoints]
    pixels = keypoints.points[:, rig.keypoints]
    return Seen(
        pixels=torch.where(weight[..., None] > 0, pixels, torch.zeros_like(pixels)),
        weight=weight,
        K=camera.K.to(pixels),
        height=camera.height,
        up=camera.R_cam_world[:, 1].to(pixels),
        floor=None,
        triples=triples_of(keypoints.frame, keypoints.person, keypoints.fps, config),
        centre=resting(len(weight), pixels),
        spread=spreads(pixels),
        joints=None,
    )


def at_stage(seen: Seen, names: list[str], stage: Stage) -> Seen:
    """The same with the weights that hands and face have in a stage."""
    factor = {"body": 1.0, "hand": stage.hand_joints, "face": stage.face_joints}
    return dataclasses.replace(
        seen, weight=seen.weight * seen.weight.new_tensor([factor[kind_of(n)] for n in names])
    )
