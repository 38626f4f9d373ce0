"""People's masks of PROX: Kinect's body index on the colour frames, stored mirrored.

A pixel holds the number of a body, 0 to 5, or 255 where nobody is. Kinect numbers a person anew
when it has lost them, and there is one person in a recording, so all bodies of a frame are one.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Bool

from mover.core.errors import InputError
from mover.io.datasets.prox_files import SIZE, Timeline
from mover.io.files.fields import At, reason
from mover.io.masks.instances import Instance, Instances, code_of, people_tree

BODIES = 6  # that Kinect tells apart
NOBODY = 255
MOST = 0.7  # of the picture that a person may fill


def people_masks(
    lines: Sequence[Timeline], tracks: Mapping[str, int], fps: float | None
) -> At | None:
    """The fields of people.json; None where no recording has masks.

    Args:
        lines: The frames of the recordings.
        tracks: Track of each subject.
        fps: Frames a second; None: stills.

    Raises:
        InputError: If a picture is no body index.
    """
    items: list[Instance] = []
    for line in lines:
        for frame, path in line.files("BodyIndexColor").items():
            code = code_of(read_body_index(path))
            if code is not None:
                track = tracks[line.recording.subject]
                items.append(Instance("person", None, code, frame=frame, track=track))
    if not items:
        return None
    return people_tree(Instances(tuple(items), SIZE, "BodyIndexColor"), fps)


def read_body_index(path: Path) -> Bool[np.ndarray, "h w"]:
    """Where somebody is, in the flipped picture.

    Raises:
        InputError: If it cannot be read, has another size, or holds other numbers.
    """
    from PIL import Image

    try:
        with Image.open(path) as picture:
            pixels = np.asarray(picture.convert("L"))
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise InputError(f"{path}: cannot be read ({reason(error)}), expected a picture") from error
    if pixels.shape != SIZE[::-1]:
        found = f"{pixels.shape[1]} x {pixels.shape[0]} pixels"
        raise InputError(f"{path}: has {found}, expected {SIZE[0]} x {SIZE[1]}")
    other = np.unique(pixels[(pixels >= BODIES) & (pixels != NOBODY)])
    if len(other):
        raise InputError(
            f"{path}: has the number {other[0]}, expected bodies 0 to {BODIES - 1}, and {NOBODY}"
            " where nobody is"
        )
    somebody = pixels < BODIES
    if somebody.mean() > MOST:
        share = f"{somebody.mean():.0%} of the picture is a body"
        raise InputError(f"{path}: {share}, expected {NOBODY} where nobody is")
    return somebody[:, ::-1]
