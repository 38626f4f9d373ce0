"""From keypoints to bodies: the batch fit of a whole video, and the bias that noise leaves in it.

A limb that looks too short is bent, one that looks too long cannot be: noise makes people look
larger, so that they are put too near. How much depends on how noisy their keypoints are, how large
they are seen and what they do. So the bodies that were found are seen once more with as much noise
and fitted again (a parametric bootstrap): what changes is what noise had changed before. The
share of the known noise that the fit leaves gives the size of the unknown one.
"""

import dataclasses
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from mover.bodies import BodyModel, run_model
from mover.bodies.skinning import FLAT, SkinnedBody, growth_of, shaped, widths_of
from mover.core.observe import Energy, Observer, Step, silent
from mover.core.records import record, rows_of
from mover.core.types import Bodies, BodyPose, Camera, Keypoints, rows_by_person
from mover.fitting import FitConfig, Stage, tracks, unknowns
from mover.fitting.energy import (
    HEIGHT,
    FitState,
    Seen,
    distances_of_lying_people,
    sole_heights,
    soles_of,
    standing_share,
)
from mover.fitting.priors import UNKNOWN, kind_of, lasting_of, stature_of
from mover.fitting.start import begin, begin_from
from mover.fitting.unknowns import Unknowns, encoded
from mover.geometry.rotations import rotation_vectors

NORMAL = 0.6745  # median of the absolute value of a normal number
FEW = 20  # rows of a person at which half of the estimated bias is applied


@record
class Bias:
    """What noise does to people."""

    betas: Float[Tensor, "people shape"]
    depth: Float[Tensor, " people"]
    """Logarithm of how much farther they are, beside what the shape says."""


def noise_of(
    off: Float[Tensor, "bodies keypoints 2"],
    seen: Seen,
    person: Int[Tensor, " bodies"],
    left: float,
) -> Float[Tensor, " bodies"]:
    """Noise of the keypoints of each body's person along each axis [px]; 0: not known.

    From the median of how far they are `off` their projections by a fit [px], so that joints which
    are swapped or guessed at the wrong place do not count. A fit leaves the share `left` of the
    variance of the noise.
    """
    noise, there = off.new_zeros(len(off)), seen.weight > 0
    for one in person.unique():
        mine = person == one
        size = off[mine][there[mine]].abs().flatten()
        if len(size):
            noise[mine] = size.median() / (NORMAL * left**0.5)
    return noise


def at_most(seen: Seen, noise: Float[Tensor, " bodies"], pose: float) -> Tensor:
    """Weights, none larger than the noise [px] allows beside a pose prior of this weight."""
    most = pose * seen.height / HEIGHT / noise.clamp_min(1e-6)
    return torch.minimum(seen.weight, most[:, None])


def bias_of(
    found: Unknowns,
    again: Unknowns,
    person: Int[Tensor, " bodies"],
    share: Float[Tensor, " bodies"],
) -> Bias:
    """What changed in the bodies `found` that were seen and fitted `again`, with noise.

    `share` is how much of the variance of that noise is really in the keypoints.
    """
    count = torch.bincount(person, minlength=len(found.betas)).to(found.place)
    moved = again.place[:, 2] - found.place[:, 2]
    each = [person == k for k in range(len(count))]
    depth = torch.stack([moved[mine].median() for mine in each])
    known = count / (count + FEW) * torch.stack([share[mine].median() for mine in each])
    return Bias(known[:, None] * (again.betas - found.betas), known * depth)


def without(at: Unknowns, bias: Bias, person: Int[Tensor, " bodies"]) -> Unknowns:
    """The bodies without what noise did to them; their poses stay."""
    place = torch.cat([at.place[:, :2], (at.place[:, 2] - bias.depth[person])[:, None]], -1)
    return dataclasses.replace(at, place=place, betas=at.betas - bias.betas)


SHAPES = 10
EXPRESSION = 10
HANDS = 12  # principal components of each hand, where the model has them; else its angles are used


@dataclass(frozen=True)
class FitInputs:
    """What bodies are fitted to, and with what."""

    keypoints: Keypoints
    camera: Camera  #: the true lens; its rotation is the first guess of upright
    model: SkinnedBody
    start: Bodies | None = None  #: bodies of another tool in the camera frame, with parameters
    prior: unknowns.PosePrior = unknowns.ANGLES
    ground: float | None = None
    """Height of the floor in the camera's world [m], where it is known: no person goes below it."""
    heights: tuple[float, ...] = ()
    """How tall each person is, in the order of their numbers, or one for everybody [m]."""


@record
class Fitted:
    """Bodies in the camera frame, and how well they explain the keypoints."""

    bodies: Bodies
    rows: Int[Tensor, " bodies"]  #: the row of the keypoints of each body
    miss: Float[Tensor, " bodies"]  #: root mean square distance of the keypoints that are seen [px]
    warnings: tuple[str, ...]


def fit_bodies(
    inputs: FitInputs, config: FitConfig | None = None, observe: Observer = silent
) -> Fitted:
    """Fit a body model to the keypoints of a video: E_Body of the paper.

    Raises:
        InputError: If no row has enough keypoints.
    """
    config, model, camera = config or FitConfig(), inputs.model, inputs.camera
    rows, warnings = tracks.usable_rows(inputs.keypoints, config)
    stature = stature_of(model, inputs.heights, inputs.keypoints.person, rows)
    some = rows_of(inputs.keypoints, rows)
    rig = unknowns.rig_of(model, some.layout, tracks.seen_at_all(some, config))
    seen = dataclasses.replace(tracks.seen_of(some, rig, camera, config), floor=inputs.ground)
    if inputs.start is None:
        start = begin(some, seen, rig, camera, config)
    else:
        start = begin_from(inputs.start, some, seen, rig)
    seen = dataclasses.replace(
        seen, centre=start.centre, spread=start.spread, stature=stature,
        lasting=lasting_of(rig.names) if config.lasting else None,
    )  # fmt: skip
    people, person = some.person.unique(return_inverse=True)
    frame = unknowns.Frame(rig, start.root, person, growth_of(model), inputs.prior)
    code = encoded(inputs.prior, start.at.code)
    at = dataclasses.replace(
        start.at, code=code, **_widened(len(code), len(people), rig, model, config)
    )
    state = _on_a_floor(FitState(at, frame, seen, config), model)
    state = _solved(state, some, observe)
    bodies = bodies_of(pose_of(state.at, frame, model), model, some)
    spread = UNKNOWN if bool(stature.given.isnan().any()) else 0.0
    return Fitted(dataclasses.replace(bodies, size_spread=spread), rows, miss_of(state), warnings)


def _widened(
    rows: int, people: int, rig: unknowns.Rig, model: SkinnedBody, config: FitConfig
) -> dict[str, Tensor]:
    """Shapes of all people, and hands and faces where they are seen and the model has them."""
    skin = rig.model
    hands, face = 0, 0
    if len(skin.parents) > 24 and any("index" in name for name in rig.names):
        space = model.hands
        hands = unknowns.HAND if space is None else min(HANDS, space.components.shape[1])
    if len(skin.parents) == 55 and any(n.startswith("face_") for n in rig.names):
        assert model.expression_dirs is not None
        face = 3 + min(EXPRESSION, model.expression_dirs.shape[-1])
    return {
        "betas": torch.zeros(people, min(SHAPES, skin.shape_dirs.shape[-1])),
        "hands": torch.zeros(rows, 2 * hands),
        "face": torch.zeros(rows, face),
        "offset": torch.zeros(people, len(rig.names) if config.lasting else 0, 3),
    }


def _on_a_floor(state: FitState, model: SkinnedBody) -> FitState:
    """With a floor that is sought, first level and below the feet."""
    seen = state.seen
    if not state.config.stands:
        return state
    soles = soles_of(model)
    low = sole_heights(state.points.joints, soles, seen.up)
    level = low.median() if seen.floor is None else low.new_tensor(seen.floor)
    floor = torch.stack([torch.zeros_like(level), torch.zeros_like(level), level])
    return state.at_values(floor=floor).given(soles=soles)


def _solved(state: FitState, keypoints: Keypoints, observe: Observer) -> FitState:
    """All rows; the shapes first from some of them where there are too many at once."""
    windows = tracks.windows_of(keypoints, state.config)
    first, bias = _stages(state, keypoints, windows[0].rows, unknowns.EVERYTHING, observe)
    parts = [first]
    if len(windows) > 1:
        shared = {name: getattr(first, name) for name in ("betas", "offset", "floor")}
        whole = state.at_values(**shared)
        windows = windows[1:]
        parts = [_stages(whole, keypoints, w.rows, unknowns.OF_ROWS, observe)[0] for w in windows]
    back = torch.argsort(torch.cat([w.rows[w.keep] for w in windows]))
    fields = {
        name: torch.cat([
            getattr(part, name)[w.keep] for part, w in zip(parts, windows, strict=True)
        ])[back]
        for name in unknowns.OF_ROWS
    }  # fmt: skip
    at = dataclasses.replace(parts[0], **fields)
    at = at if bias is None else without(at, bias, state.frame.person)
    return dataclasses.replace(state, at=at)


def _stages(
    state: FitState,
    keypoints: Keypoints,
    rows: Int[Tensor, " rows"],
    free: tuple[str, ...],
    observe: Observer,
) -> tuple[unknowns.Unknowns, Bias | None]:
    """All stages over some of the rows, and what noise did to all of them; None: not known."""
    config, names = state.config, state.frame.rig.names
    stages, some = tracks.stages_of(config, names), rows_of(keypoints, rows)
    at, frame = rows_of(state.at, rows, "bodies"), rows_of(state.frame, rows, "bodies")
    state, noise = FitState(at, frame, rows_of(state.seen, rows, "bodies"), config), None
    speed = None  # of joints across the view [m/s]
    if some.fps is not None:
        there = tracks.confidence_of(some, config) > 0
        pixels = tracks.joint_speed(some, there).to(at.place)
        speed = pixels * unknowns.log_depth(at, frame).exp()[:, None] / state.seen.K[0, 0]
    state = state.given(motion=tracks.motion_of(some, speed, config))
    for index, stage in enumerate(stages):
        if state.at.floor.numel():  # the share of the bodies that their legs carry
            standing = standing_share(state.points.joints, state.plane[0])
            state = state.given(standing=standing)
        if index == 1 and config.left:
            state = _lowered(state, dataclasses.replace(stage, steps=config.noise_steps), free)
            off = state.pixels - state.seen.pixels
            noise = noise_of(off, state.seen, state.frame.person, config.left)
            state = state.given(weight=at_most(state.seen, noise, stage.pose))
        state = _laid(_lowered(state, stage, free), some)
        if state.seen.about is not None:  # not jointly: the lying bodies moved the upright ones
            state = _lowered(state, stage, unknowns.OF_ROWS)
        observe(Step("fit_bodies", index, len(stages)))
    shared = len(free) == len(unknowns.EVERYTHING)
    return state.at, _bias(state, noise, stages[-1]) if shared and noise is not None else None


def _lowered(state: FitState, stage: Stage, free: tuple[str, ...]) -> FitState:
    """Minimise E_Body of one stage."""
    factor = tracks.factors_of(stage)
    weight = state.seen.weight
    weight = weight * weight.new_tensor([factor[kind_of(n)] for n in state.frame.rig.names])
    staged = state.given(weight=weight)

    def energy(at: unknowns.Unknowns) -> Energy:
        return dataclasses.replace(staged, at=at).energy(stage)

    return dataclasses.replace(state, at=unknowns.solve(energy, state.at, stage.steps, free))


def _bias(state: FitState, noise: Float[Tensor, " bodies"], stage: Stage) -> Bias:
    """What noise did to shapes and distances: as much of it again, always the same."""
    config, person = state.config, state.frame.person
    drawn = torch.randn(state.pixels.shape, generator=torch.Generator().manual_seed(0))
    pixels = state.pixels + noise[:, None, None] * drawn.to(noise)
    quick = dataclasses.replace(stage, steps=config.noise_steps)
    again = _lowered(state.given(pixels=pixels), quick, unknowns.EVERYTHING)
    left = noise_of(again.pixels - pixels, state.seen, person, config.left)
    share = (noise / left.clamp_min(1e-6)).square().clamp_max(1)
    return bias_of(state.at, again.at, person, share)


def _laid(state: FitState, keypoints: Keypoints) -> FitState:
    """Move people who lie along the view to their expected distance."""
    if keypoints.fps is None or not state.config.lies:
        return state
    at, seen = state.at, state.seen
    time = keypoints.frame / keypoints.fps
    rows = rows_by_person(keypoints.frame, keypoints.person)
    about = distances_of_lying_people(state.points.joints, seen.up, rows, time)
    free = about.isnan()
    if bool(free.all()):
        return state
    about = about - unknowns.grown(at, state.frame)[state.frame.person]
    depth = torch.where(free, at.place[:, 2], about)
    place = torch.cat([at.place[:, :2], depth[:, None]], -1)
    return state.at_values(place=place).given(about=about)


def pose_of(at: unknowns.Unknowns, frame: unknowns.Frame, model: SkinnedBody) -> BodyPose:
    """Parameters of the fitted bodies."""
    angles = frame.prior.decode(at.code)
    width = widths_of(model)["body_pose"]
    body = torch.cat([angles, angles.new_zeros(len(angles), width - angles.shape[1])], -1)
    betas = at.betas[frame.person]
    rest = shaped(model, betas)[1][:, 0]
    extra: dict[str, Tensor] = {}
    if at.face.shape[1]:
        extra = {"jaw_pose": at.face[:, :3], "expression": at.face[:, 3:]}
    if at.face.shape[1] and model.expression_joint_dirs is not None:
        count = at.face.shape[1] - 3
        dirs = model.expression_joint_dirs[0, :, :count].to(rest)
        rest = rest + at.face[:, 3:] @ dirs.mT
    if at.hands.shape[1]:
        extra["left_hand_pose"], extra["right_hand_pose"] = (
            unknowns.hand_angles(frame.rig, at.hands, side) for side in (0, 1)
        )
        extra[FLAT] = body.new_ones(len(body), 1)
    return BodyPose(
        model=model.name, gender=model.gender, betas=betas,
        global_orient=rotation_vectors(unknowns.turns_of(at, frame)[:, 0]), body_pose=body,
        transl=unknowns.pelvis_of(at, frame) - rest, extra=extra,
    )  # fmt: skip


def bodies_of(pose: BodyPose, model: BodyModel, keypoints: Keypoints) -> Bodies:
    """Meshes and joints, in the camera frame."""
    verts, joints = run_model(model, pose)
    return Bodies(
        verts=verts, faces=model.faces, joints=joints, joint_names=model.joint_names,
        frame=keypoints.frame, person=keypoints.person, fps=keypoints.fps, space="camera",
        pose=pose,
    )  # fmt: skip


def miss_of(state: FitState) -> Float[Tensor, " bodies"]:
    """Root mean square distance of the keypoints that are seen from their projections [px]."""
    there = (state.seen.weight > 0).to(state.seen.pixels)
    squared = (state.pixels - state.seen.pixels).square().sum(-1) * there
    return (squared.sum(1) / there.sum(1).clamp_min(1)).sqrt()
