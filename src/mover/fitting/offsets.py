"""Lasting offsets between a detector's keypoints and a body model's.

A detector's hip is not the model's hip joint: annotators click the skin, and a network repeats its
errors while a person keeps a posture. Three networks put the joints of one sitting man lastingly
1 to 3 px apart where he is 320 px tall (.5 to 1.8 cm), beside noise of 1.1 to 1.6 px that is new in
each frame. A hundred frames do not average that out, so each keypoint of each person has an offset
in the axes of its bone, with a prior of the lengths below.
"""

import torch
from jaxtyping import Float
from torch import Tensor

LASTING = {"hip": 0.03, "pelvis": 0.03, "neck": 0.03, "shoulder": 0.02, "knee": 0.02}
"""[m], prior standard deviation along each axis, by the last word of a keypoint's name."""
OTHERS = 0.015  # [m], of all other keypoints of the body
FINE = 0.003  # [m], of fingers and of the face


def lasting_of(names: list[str]) -> Float[Tensor, " keypoints"]:
    """The prior standard deviation of each keypoint's offset [m]."""
    return torch.tensor([_lasting(name) for name in names])


def _lasting(name: str) -> float:
    fine = name.startswith("face_") or any(
        part in name for part in ("index", "middle", "ring", "pinky", "thumb")
    )
    return FINE if fine else LASTING.get(name.rpartition("_")[2], OTHERS)


def offset_cost(
    offset: Float[Tensor, "people keypoints 3"], lasting: Float[Tensor, " keypoints"]
) -> Float[Tensor, " people"]:
    """Squared standard deviations of the offsets, over all keypoints."""
    return (offset / lasting.to(offset)[:, None]).square().sum((-1, -2))
