r"""E_Body: what keypoints say of bodies, and what is known of bodies and of motion (Sec. 3.2).

    E_Body = Σ_t E_SMPLify-X(t) + λ_smooth L_smooth,
    E_SMPLify-X = (1000 / H)² Σ_j (w_j c_j)² ρ(π(J_j) - x_j) + E_pose + E_shape + E_hands + E_face
                  + E_bend,
    L_smooth = Σ_t ρ(|J_{t-1} + J_{t+1} - 2 J_t|; σ2) + ρ(|π(J_{t-1}) + π(J_{t+1}) - 2 π(J_t)|; σ3)

after Pavlakos et al. 2019 (SMPLify-X, Sec. 3.2 and its published configuration) and the paper;
ρ(r; σ) = σ² r² / (r² + σ²), for keypoints on each coordinate.
Departure: Second differences are taken over real time, so that gaps and frame rates make no
acceleration, and are divided by what people do in that time and, in 3D, by the size of the body:
most of them is noise of the keypoints, which is longer in metres the larger and the farther the
body is estimated to be. σ2 and σ3 remain the lengths beyond which a jump counts as real motion.
Self-collision is left out, as in the authors' video configuration.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from mover.bodies.skeleton import BODY
from mover.core.observe import Energy
from mover.core.records import record
from mover.energy.minimize import weigh
from mover.fitting.config import FitConfig, Stage
from mover.fitting.ground import (
    BALANCE,
    FALLING,
    FRAMES,
    STEP,
    Plane,
    balance_cost,
    level_cost,
    lying_cost,
    plane_of,
    sole_heights,
    support_cost,
)
from mover.fitting.limits import limit_cost
from mover.fitting.offsets import offset_cost
from mover.fitting.stature import Stature, height_cost, shape_cost, size_of
from mover.fitting.unknowns import Decode, Frame, Points, Unknowns, floor_of, points_of
from mover.geometry.camera import project

OF_SHAPES = 0.1  # relative weight for the shape of a body that lies along the view
HEIGHT = 1000.0  # [px], the image height at which the published weights were chosen
BENT = ((17, 1, 1.0), (18, 1, -1.0), (3, 0, -1.0), (4, 0, -1.0))
"""Elbows and knees: joint of the body, axis, and the sign that is the wrong way."""
HIPS, KNEES, ANKLES = (
    [3 * (BODY.index(f"{side}_{joint}") - 1) for side in ("left", "right")]
    for joint in ("hip", "knee", "ankle")
)  # their bending among the angles of the body
LEGS = ("hip", "knee", "ankle", "foot")
UPPER = [k for k, name in enumerate(BODY) if k and not name.endswith(LEGS)]
"""Trunk, head and arms."""


@record
class Triples:
    """Rows of one track at three moments."""

    rows: Int[Tensor, "triples 3"]
    share: Float[Tensor, " triples"]
    """Weight of the first in the straight line through first and last."""
    expected: Float[Tensor, " triples"]
    """Second difference that people make in that time [m]."""
    calm: Float[Tensor, "triples joints"]
    """That of each joint, which is less where its picture stands still [m]."""


@record
class Seen:
    """What is seen of the bodies."""

    pixels: Float[Tensor, "bodies keypoints 2"]
    weight: Float[Tensor, "bodies keypoints"]
    """Confidence times the weight of the keypoint; 0: missing."""
    K: Float[Tensor, "3 3"]
    height: int
    """Of the image [px]."""
    up: Float[Tensor, "3"]
    """Away from the floor, in camera axes."""
    floor: float | None
    """Height of the floor along `up` from the camera [m]."""
    triples: Triples
    centre: Float[Tensor, "bodies 63"]
    """The pose that the prior expects: of the row's posture, or of the body to start from [rad]."""
    spread: Float[Tensor, "bodies 63"]
    """How far from it each angle may be [rad]."""
    stature: Stature | None = None
    """The prior of their heights; None: the mean shape's, as one more coefficient."""
    lasting: Float[Tensor, " keypoints"] | None = None
    """How far a detector puts each keypoint lastingly from the model's [m]; None: nowhere."""
    soles: Float[Tensor, "2"] | None = None
    """Heights of ankles and balls of the feet over the soles [m]; None: no floor is sought."""
    standing: Float[Tensor, " bodies"] | None = None
    """From 0 to 1, how surely the legs carry each body; None: no floor is sought."""
    about: Float[Tensor, " bodies"] | None = None
    """Expected depth of lying people, in the units of `place`; NaN, None: unconstrained."""


@dataclass(frozen=True)
class Weighed:
    """Weights of a stage with the settings that all stages share."""

    stage: Stage
    config: FitConfig
    decode: Decode
    learned: bool
    """The code is that of a learned prior, normally distributed."""


def body_energy(at: Unknowns, frame: Frame, seen: Seen, by: Weighed) -> Energy:
    """E_Body, row by row."""
    points = points_of(at, frame, by.decode)
    pixels = project(points.keypoints, seen.K)
    image, rho = (HEIGHT / seen.height) ** 2, by.config.rho
    smooth = by.stage.smooth if len(seen.triples.rows) else 0.0
    joints = points.joints
    if by.config.by_size:
        joints = joints / size_of(joints)[:, None, None]
    solid, flat = by.config.smooth_joints, by.config.smooth_pixels
    space = weigh(
        ("keypoints", image, lambda: keypoint_cost(pixels, seen, rho)),
        ("smooth_joints", smooth * solid, lambda: smooth_joint_cost(joints, seen, by)),
        ("smooth_pixels", smooth * flat, lambda: smooth_pixel_cost(pixels, seen, by)),
        ("still", smooth * by.config.still, lambda: still_cost(joints, seen)),
        ("held", smooth * by.config.held, lambda: held_cost(joints, seen, by)),
    )
    ground, prior = _ground_energy(points, at, frame, seen, by), _prior_energy(at, frame, seen, by)
    parts = {**space.parts, **ground.parts, **prior.parts}
    if seen.about is None:
        return Energy(parts)
    share = torch.where(seen.about.isnan(), 1.0, OF_SHAPES)
    return Energy({name: share * part for name, part in parts.items()})


def _ground_energy(points: Points, at: Unknowns, frame: Frame, seen: Seen, by: Weighed) -> Energy:
    """How the floor and the way people lie down constrain their distances."""
    sought, pose, rows = bool(at.floor.numel()), by.stage.pose, len(at.place)
    floor = floor_of(at, frame)
    under = pose / by.config.support if sought or seen.floor is not None else 0.0
    stands = pose * by.config.stands if sought else 0.0
    lies = pose * by.config.lies if seen.about is not None else 0.0
    balance = by.config.balance * pose / BALANCE if sought and seen.standing is not None else 0.0

    def plane() -> Plane:
        return plane_of(floor, seen.up, seen.floor)

    def stand() -> Tensor:
        assert seen.soles is not None
        up, level = plane()
        height = sole_heights(points.joints, seen.soles, up) - level
        return geman_mcclure(height.square(), STEP)

    def balanced() -> Tensor:
        assert seen.standing is not None
        off = balance_cost(points.joints, plane()[0])
        return seen.standing * geman_mcclure(off, FALLING)

    def lie() -> Tensor:
        assert seen.about is not None
        return lying_cost(at.place[:, 2], seen.about)

    def level() -> Tensor:
        return level_cost(floor, seen.floor).expand(rows)

    every = torch.cat([points.joints, points.keypoints], 1)
    return weigh(
        ("support", under**2, lambda: support_cost(every, plane())),
        ("stands", stands**2, stand),
        ("balance", balance**2, balanced),
        ("level", pose**2 * FRAMES / rows if sought else 0.0, level),
        ("lies", lies**2, lie),
    )


def _prior_energy(at: Unknowns, frame: Frame, seen: Seen, by: Weighed) -> Energy:
    """What is known of poses and shapes, whatever is seen."""
    stage, config = by.stage, by.config
    angles = by.decode(at.code)
    count = torch.bincount(frame.person, minlength=len(at.betas)).to(at.betas)[frame.person]
    given = config.height_weight if seen.stature is not None else 0.0
    lasting = stage.shape if seen.lasting is not None else 0.0
    hands, face = min(1, at.hands.shape[1]), min(1, at.face.shape[1])
    expression = at.face[:, 3:]

    def pose() -> Tensor:
        return at.code.square().sum(-1) if by.learned else pose_cost(angles, seen)

    same = count.clamp_max(config.independent_frames)  # further frames repeat their errors

    def shape() -> Tensor:
        if seen.stature is None or seen.lasting is None:
            return at.betas.square().sum(-1)[frame.person] / same
        return shape_cost(seen.stature, at.betas)[frame.person] / same

    def height() -> Tensor:
        assert seen.stature is not None
        return height_cost(seen.stature, at.betas)[frame.person] / count

    def offset() -> Tensor:
        assert seen.lasting is not None
        return offset_cost(at.offset, seen.lasting)[frame.person] / same

    return weigh(
        ("pose", stage.pose**2, pose),
        ("limits", config.limits**2, lambda: limit_cost(angles)),
        ("bending", config.bending * stage.pose, lambda: bending_cost(angles)),
        ("shape", stage.shape**2, shape),
        ("height", given**2, height),
        ("offset", lasting**2, offset),
        ("hands", stage.hands**2 * hands, lambda: at.hands.square().sum(-1)),
        ("jaw", stage.jaw**2 * face, lambda: jaw_cost(at.face)),
        ("expression", stage.shape**2 * face, lambda: expression.square().sum(-1)),
    )


def geman_mcclure(squared: Float[Tensor, "*any"], rho: float) -> Float[Tensor, "*any"]:
    """ρ² r² / (r² + ρ²): r² near zero, ρ² far away."""
    return rho**2 * squared / (squared + rho**2)


def keypoint_cost(
    pixels: Float[Tensor, "bodies keypoints 2"], seen: Seen, rho: float
) -> Float[Tensor, " bodies"]:
    """Robust squared distances of projected keypoints from detected ones [px²]."""
    scaled = rho * seen.height / 1080
    cost = geman_mcclure((pixels - seen.pixels).square(), scaled).sum(-1)
    return (cost * seen.weight.square()).sum(-1)


def bending_cost(angles: Float[Tensor, "bodies angles"]) -> Float[Tensor, " bodies"]:
    """Elbows and knees that bend the wrong way: exp(±θ)²; 1 for a straight one."""
    bent = [(sign * angles[:, 3 * joint + axis]).exp().square() for joint, axis, sign in BENT]
    return torch.stack(bent, -1).sum(-1)


def pose_cost(angles: Float[Tensor, "bodies angles"], seen: Seen) -> Float[Tensor, " bodies"]:
    """Squared distance from the pose that is expected, in spreads; ankles keep the feet level.

    Few detectors see toes. An ankle that is expected to turn back what hip and knee turn forth
    keeps the foot as level as the trunk is upright; one at rest would stand people on their toes.
    """
    away = angles[:, :63] - seen.centre
    level = away.index_add(1, away.new_tensor(ANKLES, dtype=torch.long), away[:, HIPS])
    level = level.index_add(1, away.new_tensor(ANKLES, dtype=torch.long), away[:, KNEES])
    return (level / seen.spread).square().sum(-1)


def jaw_cost(face: Float[Tensor, "bodies face"]) -> Float[Tensor, " bodies"]:
    """Squared turns of the jaw; about y and z a hundred times as much as opening."""
    return face[:, 0].square() + 100 * face[:, 1:3].square().sum(-1)


def second_difference(
    values: Float[Tensor, "bodies points axes"], triples: Triples
) -> Float[Tensor, "triples points axes"]:
    """Twice the distance from the straight line through the neighbours, at their real times."""
    before, now, after = (values[triples.rows[:, k]] for k in range(3))
    share = triples.share[:, None, None]
    return 2 * (share * before + (1 - share) * after - now)


def _of_rows(
    cost: Float[Tensor, " triples"], triples: Triples, rows: int
) -> Float[Tensor, " bodies"]:
    """Costs of triples, each added to its middle row."""
    return cost.new_zeros(rows).index_add(0, triples.rows[:, 1], cost)


def smooth_joint_cost(
    joints: Float[Tensor, "bodies joints 3"], seen: Seen, by: Weighed
) -> Float[Tensor, " bodies"]:
    """Robust squared second differences of the joints of the body, over what people do."""
    triples = seen.triples
    second = second_difference(joints[:, :22], triples).square().sum(-1)
    cost = geman_mcclure(second, by.config.sigma_joints).sum(-1) / triples.expected.square()
    return _of_rows(cost, triples, len(joints))


def still_cost(joints: Float[Tensor, "bodies joints 3"], seen: Seen) -> Float[Tensor, " bodies"]:
    """Squared second differences of the pelvis, over what a body does that looks so still.

    The keypoints of a body that lies along the view hardly constrain its distance: frames that
    show the same pose constrain it jointly. Not robust, since a single frame is off by a metre.
    """
    triples = seen.triples
    second = second_difference(joints[:, :1], triples).square().sum((-1, -2))
    return _of_rows(second / triples.calm[:, 0].square(), triples, len(joints))


def held_cost(
    joints: Float[Tensor, "bodies joints 3"], seen: Seen, by: Weighed
) -> Float[Tensor, " bodies"]:
    """Robust squared second differences of trunk, head and arms about the pelvis, as `still_cost`.

    Single frames hardly constrain the depth of an arm, either. Legs are left out: a foot that
    stands still belongs to a body that walks on.
    """
    triples = seen.triples
    about = joints[:, UPPER] - joints[:, :1]
    second = second_difference(about, triples).square().sum(-1)
    cost = geman_mcclure(second, by.config.sigma_held) / triples.calm[:, UPPER].square()
    return _of_rows(cost.sum(-1), triples, len(joints))


def smooth_pixel_cost(
    pixels: Float[Tensor, "bodies keypoints 2"], seen: Seen, by: Weighed
) -> Float[Tensor, " bodies"]:
    """Robust squared second differences of projections where the middle one is seen [px²]."""
    triples = seen.triples
    second = second_difference(pixels, triples).square().sum(-1)
    cost = geman_mcclure(second, by.config.sigma_pixels) * seen.weight[triples.rows[:, 1]].square()
    return _of_rows(cost.sum(-1), triples, len(pixels))
