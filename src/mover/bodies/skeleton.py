"""The skeleton that every body model here shares: SMPL-X's joints, their order and parents."""

SIDES = ("left", "right")
FINGERS = ("index", "middle", "pinky", "ring", "thumb")

BODY = (
    "pelvis", "left_hip", "right_hip", "spine1", "left_knee", "right_knee", "spine2",
    "left_ankle", "right_ankle", "spine3", "left_foot", "right_foot", "neck", "left_collar",
    "right_collar", "head", "left_shoulder", "right_shoulder", "left_elbow", "right_elbow",
    "left_wrist", "right_wrist",
)  # fmt: skip
"""The 22 joints of the body."""
FACE = ("jaw", "left_eye_smplhf", "right_eye_smplhf")
HANDS = tuple(f"{side}_{finger}{k}" for side in SIDES for finger in FINGERS for k in (1, 2, 3))
"""The 15 joints of the left hand, then those of the right."""

JOINTS = BODY + FACE + HANDS
"""Names of the 55 joints of SMPL-X in its order."""

PARENTS = (
    -1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 15, 15, 15,
    20, 25, 26, 20, 28, 29, 20, 31, 32, 20, 34, 35, 20, 37, 38,
    21, 40, 41, 21, 43, 44, 21, 46, 47, 21, 49, 50, 21, 52, 53,
)  # fmt: skip
"""Index of the parent of each of `JOINTS`; the pelvis has none (-1)."""
