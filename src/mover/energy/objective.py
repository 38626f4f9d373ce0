"""Eq. 1 as a list of terms: what each costs, and the evidence that it needs.

A new term is a function in `image_terms`, `human_terms` or `prior_terms`, a weight in
`SceneWeights` and a row in `SCENE_TERMS`; its evidence is a field of `ImageCues` or `HumanCues`,
indexed by its axis `objects`.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeVar, cast

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mover.core.devices import constant
from mover.core.observe import Energy, PerItem
from mover.core.records import record, rows_of
from mover.core.types import Camera, Layout, Objects
from mover.energy import human_terms as people
from mover.energy import image_terms as picture
from mover.energy import prior_terms as prior
from mover.energy.config import SceneConfig, SceneWeights
from mover.energy.minimize import Term, active_weights, sum_terms, there
from mover.geometry.camera import outermost, project, to_camera
from mover.geometry.placement import place, place_in
from mover.geometry.raster import Crops, Depths, Topology, look

E = TypeVar("E")
Rows = Int[Tensor, " rows"]
DEEP = {"depth", "measured"}  # evidence that is compared with drawn depths
UNIT = tuple((x, y, z) for x in (-0.5, 0.5) for y in (0.0, 1.0) for z in (-0.5, 0.5))


@record
class ImageCues:
    """What the still image says about each object."""

    boxes: Float[Tensor, "objects 4"]
    """Detected x_min, y_min, x_max, y_max [px]."""
    sides: Int[Tensor, "objects 4"]
    """What is known of each side of the box, see `image_terms`."""
    views: Crops
    """The window of each object."""
    masks: Float[Tensor, "objects h w"]
    """Detected coverage of the window's pixels in [0, 1]."""
    keep: Bool[Tensor, "objects h w"]
    """False where it is unknown what would be seen; everywhere without a mask."""
    trust: Float[Tensor, " objects"]
    """Weight of the silhouette, below one where the shape is known to be wrong."""
    distance: Float[Tensor, " objects"] | None = None
    """From the camera to the middle of the base in the initial scene [m]; None: not known."""
    borders: picture.Borders | None = None
    """What the masks may be if their outlines are too wide or too narrow; None: they are not."""
    walls: prior.Walls | None = None
    """Lines along which furniture stands; None: none are known."""
    given: prior.Given | None = None
    """What is known of the objects before they are seen; None: nothing."""
    measured: picture.Measured | None = None
    """What a depth network sees; None: there is none."""
    beside: Float[Tensor, "objects 4 2"] | None = None
    """Shares of each side that something touches, and that something is near to; None: unknown."""


@record
class HumanCues:
    """What the people of all frames say about the room; None: that evidence is missing."""

    depth: people.DepthRange | None = None
    space: people.BodySpace | None = None
    touches: people.ContactPoints | None = None


@dataclass(frozen=True)
class SceneEvidence:
    """All that Eq. 1 knows, whatever the layout."""

    objects: Objects
    camera: Camera
    image: ImageCues
    humans: HumanCues

    def has(self, name: str) -> bool:
        """Whether a field of the cues is known."""
        return {**vars(self.image), **vars(self.humans)}[name] is not None

    def some(self, rows: Rows) -> "SceneEvidence":
        """That about rows of (starts x objects), counted through."""
        n = len(self.objects.ids)
        image = of_objects(self.image, rows % n, n)
        humans = of_objects(self.humans, rows % n, n)
        return SceneEvidence(some_objects(self.objects, rows), self.camera, image, humans)

    def bare(self) -> "SceneEvidence":
        """That without meshes, maps and people, which `Term.bare` terms do not look at."""
        none = torch.zeros(0).to(self.image.sides)
        objects = rows_of(self.objects, none, "verts", "faces", "edges", "samples", "region")
        return SceneEvidence(objects, self.camera, rows_of(self.image, none, "h"), HumanCues())


@dataclass(frozen=True)
class PlacedScene:
    """The room under some layouts, with what several terms need: found when first asked for."""

    layout: Layout
    known: SceneEvidence
    config: SceneConfig
    """Its weights are those whose evidence is there."""

    @cached_property
    def verts_cam(self) -> Float[Tensor, "*starts objects verts 3"]:
        """Vertices in camera axes [m]."""
        return place_in(self.known.objects.verts, self.layout, self.known.camera.R_cam_world)

    @cached_property
    def pixels(self) -> Float[Tensor, "*starts objects verts 2"]:
        """Vertices in the image [px]."""
        return project(self.verts_cam, self.known.camera.K)

    @cached_property
    def extent(self) -> Float[Tensor, "*starts objects 4 2"]:
        """The outermost vertices in the image [px]."""
        K = self.known.camera.K
        return project(outermost(self.verts_cam, K), K)

    @cached_property
    def _drawn(self) -> tuple[Tensor, Depths | None]:
        """Silhouettes and, where a term has bounds for them, depths."""
        weights, objects = self.config.weights, self.known.objects
        bounded = any(getattr(weights, t.name) for t in SCENE_TERMS if DEEP & {*t.needs})
        shape = Topology(objects.faces, objects.edges)
        return look(self.verts_cam, shape, self.known.image.views, depth=bounded)

    @property
    def silhouettes(self) -> Float[Tensor, "*starts objects h w"]:
        """Drawn coverage of the windows' pixels in [0, 1]."""
        return self._drawn[0]

    @property
    def depths(self) -> Depths:
        """First and last surfaces, for terms that need some evidence of `DEEP`."""
        return there(self._drawn[1])

    @property
    def loose(self) -> bool:
        """Whether box and silhouette choose the border of the mask."""
        free = self.known.image.borders is not None and self.config.weights.silhouette
        return self.config.form == "robust" and bool(free)

    @cached_property
    def fitted(self) -> picture.BestShift:
        """Box and silhouette under the border of each mask that suits them best."""
        image, w = self.known.image, self.config.weights
        return picture.fit_borders(
            self.silhouettes, self.extent, image.boxes, image.sides, image.keep, image.trust,
            there(image.borders), (w.bbox, w.silhouette),
        )  # fmt: skip


def _bbox(s: PlacedScene) -> PerItem:
    camera, image, form = s.known.camera, s.known.image, s.config.form
    if s.loose:
        return s.fitted.bbox
    pixels = project(_corners(s), camera.K) if form == "paper" else s.extent
    return picture.bbox_term(pixels, image.boxes, image.sides, float(camera.width), form)


def _silhouette(s: PlacedScene) -> PerItem:
    image = s.known.image
    if s.loose:
        return s.fitted.silhouette
    own = image.masks, image.keep, s.config.form
    return image.trust * picture.silhouette_term(s.silhouettes, *own)


def _depth(s: PlacedScene) -> PerItem:
    bounds = there(s.known.humans.depth)
    contradiction = s.config.readings.contradiction
    return people.depth_term(s.depths, s.known.image.masks, bounds, s.config.form, contradiction)


def _collision(s: PlacedScene) -> PerItem:
    objects, space, reads = s.known.objects, there(s.known.humans.space), s.config.readings
    if s.config.form == "paper":
        every = reads.surface == "vertices"
        points, real = (objects.verts, objects.real_verts) if every else (objects.samples, None)
        return people.collision_term(place(points, s.layout), space, reads.lookup, real)
    touches = s.known.humans.touches if s.config.weights.contact else None
    share = people.collision_share(objects, touches)
    return share * people.collision_term(place(objects.samples, s.layout), space)


def _contact(s: PlacedScene) -> PerItem:
    objects, humans = s.known.objects, s.known.humans
    touches = there(humans.touches)
    form, contact = s.config.form, s.config.readings.contact
    components = form == "paper" and contact == "components"
    distance = people.contact_distance(s.layout, objects, touches, components)
    return people.contact_term(distance, touches, len(objects.ids), form, contact)


def _corners(s: PlacedScene) -> Float[Tensor, "*starts objects 8 3"]:
    """The eight corners of each object's box in camera axes [m]."""
    size = s.known.objects.size
    corners = constant(UNIT, size) * size.unsqueeze(-2)
    return to_camera(place(corners, s.layout), s.known.camera.R_cam_world)


SCENE_TERMS: tuple[Term[PlacedScene], ...] = (
    Term("bbox", _bbox, fused=True),
    Term("silhouette", _silhouette, fused=True),
    Term(
        "scale", lambda s: prior.scale_term(s.layout.log_scale, s.config.form, s.config.growth),
        fused=True,
    ),
    Term("depth", _depth, ("depth",), fused=True),
    Term("collision", _collision, ("space",), fused=True),
    Term("contact", _contact, ("touches",), fused=True),
    Term(
        "distance", lambda s: prior.distance_term(s.layout, there(s.known.image.distance)),
        ("distance",), fused=True,
    ),
    Term(
        "heading", lambda s: people.heading_term(s.layout, there(s.known.humans.touches)),
        ("touches",), fused=True,
    ),
    Term(
        "wall",
        lambda s: prior.wall_term(s.layout, s.known.objects.size, there(s.known.image.walls)),
        ("walls",), bare=True,
    ),
    Term(
        "given", lambda s: prior.given_term(s.layout, there(s.known.image.given)),
        ("given",), bare=True,
    ),
    Term(
        "measured", lambda s: picture.measured_term(
            s.depths, s.known.image.masks, there(s.known.image.measured)),
        ("measured",),
    ),
)  # fmt: skip
"""All terms of Eq. 1; what is not in this list does not count, what is cannot be forgotten."""


def scene_energy(
    layout: Layout,
    objects: Objects,
    camera: Camera,
    image: ImageCues,
    humans: HumanCues,
    config: SceneConfig,
) -> Energy:
    """Eq. 1: what the image and the people say about where the objects stand."""
    known = SceneEvidence(objects, camera, image, humans)
    return energy_of_terms(SCENE_TERMS, layout, known, active_config(config, known))


def energy_of_terms(
    terms: Iterable[Term[PlacedScene]], layout: Layout, known: SceneEvidence, config: SceneConfig
) -> Energy:
    """Some terms of Eq. 1, for weights whose evidence is there (see `active_config`)."""
    return sum_terms(config.weights, terms, PlacedScene(layout, known, config))


def active_config(config: SceneConfig, known: SceneEvidence) -> SceneConfig:
    """The same without the weights whose evidence is missing."""
    return replace(config, weights=active_weights(config.weights, SCENE_TERMS, known.has))


def best_borders(
    layout: Layout, objects: Objects, camera: Camera, image: ImageCues, weights: SceneWeights
) -> Int[Tensor, "*starts objects"]:
    """Number of the shift of each mask's border that suits a layout best (`ImageCues.borders`)."""
    known = SceneEvidence(objects, camera, image, HumanCues())
    config = active_config(SceneConfig(weights, "robust"), known)
    return PlacedScene(layout, known, config).fitted.shift


def of_objects(evidence: E, index: Rows, count: int) -> E:
    """What evidence says about the objects of this index, along the axis `objects` of its tensors.

    Args:
        evidence: A record; its axes have names (`items` is one for each object, too).
        index: Objects, each as often as it is asked for.
        count: Number of all objects.
    """
    if isinstance(evidence, people.ContactPoints):
        return cast(E, people.some_touches(evidence, index, count))
    if isinstance(evidence, HumanCues) and evidence.touches is not None:
        touches = people.some_touches(evidence.touches, index, count)
        rest = rows_of(replace(evidence, touches=None), index, "objects", "items")
        return cast(E, replace(rest, touches=touches))
    return rows_of(evidence, index, "objects", "items")


def some_supports(supports: Int[Tensor, " objects"], rows: Rows) -> Int[Tensor, " rows"]:
    """Supports of rows of (starts x objects), as indices into `rows`; -1: the floor.

    Raises:
        ValueError: If an object is requested without its support.
    """
    n = len(supports)
    index = rows % n
    place = torch.full((int(rows.max()) // n * n + n if len(rows) else n,), -1).to(rows)
    place[rows] = torch.arange(len(rows)).to(rows)
    below = supports[index]
    carrier = place[(rows - index + below).clamp_min(0)]
    if bool(((below >= 0) & (carrier < 0)).any()):
        raise ValueError("some_supports: an object without its support")
    return torch.where(below >= 0, carrier, below)


def some_objects(objects: Objects, rows: Rows) -> Objects:
    """The objects of rows of (starts x objects), counted through; carriers come with their loads.

    Raises:
        ValueError: If an object is requested without its support.
    """
    n = len(objects.ids)
    index = rows % n
    supports, names = some_supports(objects.supports, rows), index.tolist()
    return replace(
        of_objects(objects, index, n),
        supports=supports,
        ids=tuple(objects.ids[i] for i in names),
        categories=tuple(objects.categories[i] for i in names),
    )
