"""The equations of the paper, written as they are printed."""

from dataclasses import dataclass, field, replace
from functools import cache
from typing import TypeVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from .constants import constant
from .geometry.camera import outermost, project, to_camera
from .geometry.placement import place, place_in
from .geometry.raster import Depths, Topology, Views, look
from .minimize import Energy, weigh
from .records import record
from .terms import Form
from .terms.bbox import bbox_term
from .terms.border import Borders, Fitted, fit_borders
from .terms.collision import BodySpace, collision_term
from .terms.contact import Touches, contact_term, gap_term, heading_term
from .terms.contact_reach import reach_term
from .terms.contact_trees import Trees, gaps
from .terms.depth import DepthRange, depth_term, free_space_term
from .terms.distance import distance_term
from .terms.factors import factors
from .terms.offscreen import offscreen_term
from .terms.scale import GROWTH, scale_term
from .terms.silhouette import edge_term, silhouette_term
from .terms.wall import Walls, wall_term
from .types import Camera, Layout, Objects

E = TypeVar("E")
UNIT = tuple((x, y, z) for x in (-0.5, 0.5) for y in (0.0, 1.0) for z in (-0.5, 0.5))


@dataclass(frozen=True)
class SceneWeights:
    """Weights of Eq. 1 in its order; zero removes a term and the need for its evidence."""

    bbox: float = 1000.0
    """lambda 1: objects fill their detected boxes."""
    silhouette: float = 0.3
    """lambda 2: objects cover their masks."""
    scale: float = 1000.0
    """lambda 3: objects keep their initial size."""
    depth: float = 8.0
    """lambda 4: who hides whom bounds the depth."""
    collision: float = 1000.0
    """lambda 5: people move through free space."""
    contact: float = 1e5
    """lambda 6: touching surfaces share a place."""
    edge: float = 0.0
    """Outlines follow the outlines of the masks (release only)."""
    offscreen: float = 0.0
    """Objects stay inside the image (release only)."""
    free_space: float = 0.0
    """Nothing hides a person that is seen (release only)."""
    distance: float = 0.0
    """Objects stay at the distance they were given, where nothing else tells it (robust only)."""
    heading: float = 0.0
    """Seats face where their sitters face (robust only)."""
    wall: float = 0.0
    """Furniture along a wall stands in one line (robust only)."""


@dataclass(frozen=True)
class SceneConfig:
    """How the room is priced."""

    weights: SceneWeights = field(default_factory=SceneWeights)
    form: Form = "paper"
    """As printed, as the authors released it, or normalised and robust."""
    growth: float = GROWTH
    """Price of another size as a whole, against that of another shape (robust only)."""


@record
class ImageCues:
    """What the still image says about each object."""

    boxes: Float[Tensor, "objects 4"]
    """Detected x_min, y_min, x_max, y_max [px]."""
    sides: Int[Tensor, "objects 4"]
    """What is known of each side of the box, see `terms.bbox`."""
    views: Views
    """The window of each object."""
    masks: Float[Tensor, "objects h w"]
    """Detected coverage of the window's pixels in [0, 1]."""
    keep: Bool[Tensor, "objects h w"]
    """False where it is unknown what would be seen; everywhere without a mask."""
    trust: Float[Tensor, " objects"]
    """Weight of the silhouette, below one where the shape is known to be wrong."""
    distance: Float[Tensor, " objects"] | None = None
    """From the camera to the middle of the base in the initial scene [m]; None: not known."""
    outline: Float[Tensor, "objects h w"] | None = None
    """Root of the distance to the mask's outline [px^0.5]; None: the edge term finds it anew."""
    borders: Borders | None = None
    """What the masks may be if their outlines are too wide or too narrow; None: they are not."""
    walls: Walls | None = None
    """Lines along which furniture stands; None: none are known."""


@record
class HumanCues:
    """What the people of all frames say about the room; None: that evidence is missing."""

    depth: DepthRange | None = None
    space: BodySpace | None = None
    touches: Touches | None = None
    trees: Trees | None = None
    """Finds what is touched faster; None: all points are compared."""


def scene_energy(
    layout: Layout,
    objects: Objects,
    camera: Camera,
    image: ImageCues,
    humans: HumanCues,
    config: SceneConfig,
) -> Energy:
    """Eq. 1: what the image and the people say about where the objects stand."""
    form, w = config.form, heard(config.weights, image, humans)
    verts = place_in(objects.verts, layout, camera.R_cam_world)
    drawn = cache(lambda: _draw(verts, objects, image.views, w))
    pixels = cache(lambda: project(verts, camera.K))
    many = factors(objects, humans.touches if w.contact else None, form)
    fitted = cache(lambda: _fit(drawn()[0], outermost(verts, camera.K), camera, image, w))
    loose = form == "robust" and image.borders is not None and w.silhouette
    return weigh(
        ("bbox", w.bbox, lambda: fitted().bbox if loose else bbox_term(
            project(_corners(objects, layout, camera) if form == "paper"
                    else outermost(verts, camera.K), camera.K),
            image.boxes, image.sides, float(camera.width), form)),
        ("silhouette", w.silhouette, lambda: fitted().silhouette if loose
            else image.trust * silhouette_term(drawn()[0], image.masks, image.keep, form)),
        ("scale", w.scale, lambda: scale_term(layout.log_scale, form, config.growth)),
        ("depth", w.depth, lambda: many.depth * depth_term(
            _known(drawn()[1]), image.masks, _known(humans.depth), form)),
        ("collision", w.collision, lambda: many.collision * collision_term(
            _collision_points(layout, objects, form), _known(humans.space), form)),
        ("contact", w.contact, lambda: _contact(layout, objects, humans, form)),
        ("edge", w.edge, lambda: edge_term(
            drawn()[0], image.masks, image.keep, image.outline)),
        ("offscreen", w.offscreen, lambda: offscreen_term(
            pixels(), verts, objects.real_verts, camera)),
        ("free_space", w.free_space, lambda: free_space_term(
            _known(drawn()[1]), image.masks, _known(humans.depth))),
        ("distance", w.distance, lambda: distance_term(layout, _known(image.distance))),
        ("heading", w.heading, lambda: heading_term(layout, _known(humans.touches))),
        ("wall", w.wall, lambda: wall_term(layout, objects.size, _known(image.walls))),
    )  # fmt: skip


def _fit(
    drawn: Tensor, extent: Tensor, camera: Camera, image: ImageCues, w: SceneWeights
) -> Fitted:
    """Box and silhouette under the border of each mask that suits them best."""
    seen = image.boxes, image.sides, image.keep
    here = drawn, project(extent, camera.K)
    return fit_borders(here, seen, image.trust, _known(image.borders), (w.bbox, w.silhouette))


def best_borders(
    layout: Layout, objects: Objects, camera: Camera, image: ImageCues, weights: SceneWeights
) -> Int[Tensor, "*starts objects"]:
    """Number of the shift of each mask's border that suits a layout best (`ImageCues.borders`)."""
    verts = place_in(objects.verts, layout, camera.R_cam_world)
    drawn, _ = _draw(verts, objects, image.views, replace(weights, depth=0.0, free_space=0.0))
    return _fit(drawn, outermost(verts, camera.K), camera, image, weights).shift


def heard(weights: SceneWeights, image: ImageCues, humans: HumanCues) -> SceneWeights:
    """The weights without those whose evidence is missing."""
    missing: dict[str, float] = {} if image.distance is not None else {"distance": 0.0}
    if image.walls is None:
        missing["wall"] = 0.0
    if humans.depth is None:
        missing |= {"depth": 0.0, "free_space": 0.0}
    if humans.space is None:
        missing["collision"] = 0.0
    if humans.touches is None:
        missing |= {"contact": 0.0, "heading": 0.0}
    return replace(weights, **missing)


def _draw(
    verts: Tensor, objects: Objects, views: Views, w: SceneWeights
) -> tuple[Tensor, Depths | None]:
    """Silhouettes and, where a term asks for them, depths."""
    asked = bool(w.depth or w.free_space)
    return look(verts, Topology(objects.faces, objects.edges), views, depth=asked)


def _contact(layout: Layout, objects: Objects, humans: HumanCues, form: Form) -> Tensor:
    """By search trees where there are any."""
    touches = _known(humans.touches)
    if humans.trees is None or (form == "release" and humans.trees.skin is None):
        regions = place(objects.top, layout), place(objects.back, layout)
        return contact_term(regions, touches, form)
    if form != "robust":
        return reach_term(layout, touches, humans.trees, form)
    found = gaps(layout, objects, touches, humans.trees)
    return gap_term(found, touches, len(objects.ids), form)


def _corners(
    objects: Objects, layout: Layout, camera: Camera
) -> Float[Tensor, "*starts objects 8 3"]:
    """The eight corners of each object's box in camera axes [m]."""
    corners = constant(UNIT, objects.size) * objects.size.unsqueeze(-2)
    return to_camera(place(corners, layout), camera.R_cam_world)


def _collision_points(layout: Layout, objects: Objects, form: Form) -> Tensor:
    """Vertices of the meshes (`paper`; the padding is sent far away) or even surface samples."""
    if form != "paper":
        return place(objects.samples, layout)
    verts = place(objects.verts, layout)
    return torch.where(objects.real_verts.unsqueeze(-1), verts, torch.full_like(verts, 1e3))


def _known(evidence: E | None) -> E:
    """Evidence whose weight is not zero (see `heard`)."""
    assert evidence is not None
    return evidence
