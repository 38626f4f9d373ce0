"""What placing the objects needs, and what comes of it."""

from dataclasses import replace

from jaxtyping import Bool, Float
from torch import Tensor

from mover.core.records import record
from mover.core.types import Camera, Layout, Objects
from mover.energy.human_terms import DepthRange
from mover.energy.image_terms import Borders
from mover.energy.objective import HumanCues, ImageCues
from mover.energy.prior_terms import Walls
from mover.geometry.raster import Crops


@record
class Pinned:
    """Objects that the user has placed: they are part of the energy but do not move."""

    fixed: Bool[Tensor, " objects"]
    layout: Layout
    """Without an axis of starts; rows that are not fixed have no meaning."""


@record
class PlaceInputs:
    """What placing the objects needs."""

    objects: Objects
    camera: Camera
    ground: float
    image: ImageCues
    humans: HumanCues
    starts: Layout
    """Candidates on a leading axis."""
    reference: Float[Tensor, " objects"]
    """Yaw that breaks ties: of the sitters where there are any, else the initial one [rad]."""
    pinned: Pinned | None = None
    """Objects that stay where they are; None: all may move."""


@record
class Placed:
    """Where the objects ended."""

    layout: Layout
    """The chosen candidate of each object."""
    candidates: Layout
    """All that were left, best first."""
    energy: Float[Tensor, "starts objects"]
    """Of the candidates."""
    trace: Float[Tensor, " steps"]
    """Total energy before each step of the last descent, summed over the candidates."""
    walls: Walls | None = None
    """The lines along which furniture was placed; None: none."""


def hold(layout: Layout, pinned: Pinned | None) -> Layout:
    """The layout with the pinned objects at their positions, in every start; no gradient there."""
    return layout if pinned is None else Layout.where(pinned.fixed, pinned.layout, layout)


def with_walls(inputs: PlaceInputs, walls: Walls | None) -> PlaceInputs:
    """The inputs with the lines along which furniture stands."""
    return replace(inputs, image=replace(inputs.image, walls=walls))


def coarser_image(image: ImageCues, factor: int) -> ImageCues:
    """The same with `factor` times fewer pixels along each side.

    Raises:
        ValueError: If the windows are not a multiple of it.
    """
    views = image.views
    if factor < 1 or views.height % factor or views.width % factor:
        raise ValueError(
            f"coarser_image: windows of {views.height} x {views.width}, which {factor} does not"
            " divide"
        )
    if factor == 1:
        return image
    zoom = views.K.new_tensor([1 / factor, 1 / factor, 1.0])[:, None]
    borders, measured = image.borders, image.measured
    return replace(
        image,
        views=Crops(views.K * zoom, views.height // factor, views.width // factor),
        masks=_tiles(image.masks, factor).mean((-3, -1)),
        keep=_tiles(image.keep, factor).all(-1).all(-2),
        borders=borders and Borders(borders.shifts, _tiles(borders.masks, factor).mean((-3, -1))),
        measured=measured and replace(measured, depth=_middles(measured.depth, factor)),
    )


def coarser_humans(humans: HumanCues, factor: int) -> HumanCues:
    """The same with the bounds of the depth at one pixel of each tile."""
    if factor == 1 or humans.depth is None:
        return humans
    near, far = (_middles(bound, factor) for bound in (humans.depth.near, humans.depth.far))
    depth = DepthRange(near, far, humans.depth.area * factor**2)
    return replace(humans, depth=depth)


def _middles(image: Tensor, factor: int) -> Tensor:
    """One pixel of each tile: bounds and depths have no mean."""
    middle = factor // 2
    return image[..., middle::factor, middle::factor]


def _tiles(image: Tensor, factor: int) -> Tensor:
    return image.unflatten(-1, (-1, factor)).unflatten(-3, (-1, factor))
