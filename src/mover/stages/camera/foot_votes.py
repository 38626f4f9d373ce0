"""The weight of each sole point in the height of the floor: positions share theirs among frames."""

import dataclasses
from typing import Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor

from mover.core.records import record
from mover.energy.human_terms import FootContacts

STEP_NOISE = 0.015  # [m], of a sole's height, new in every frame
PLACE_NOISE = 0.01  # [m], of a sole's height, the same in a place
PLACE = 0.15  # [m], soles nearer than this stand in one place


@record
class Votes:
    """Sole points with their weight; float64."""

    foot_contacts: FootContacts
    people: Int[Tensor, " people"]
    """Tracks, sorted."""
    person_of: Int[Tensor, " soles"]
    """Index into `people`."""
    row_of: Int[Tensor, " soles"]
    """Points of one foot in one frame share a row."""
    place_of: Int[Tensor, " soles"]
    """Rows of one person on one spot share a place."""
    weight: Float[Tensor, " soles"]
    """One over the variance of the height [1/m²]."""


def vote(foot_contacts: FootContacts, by: Literal["places", "points", "sum"]) -> Votes:
    """Give every sole point its weight: places share theirs among all frames spent there."""
    if by == "sum":  # as printed: of all points together, here by their mean
        points, first = foot_contacts.points_cam.mean(0, keepdim=True), slice(1)
        who = {name: getattr(foot_contacts, name)[first] for name in ("person", "frame")}
        foot_contacts = dataclasses.replace(foot_contacts, points_cam=points, **who)
    points = foot_contacts.points_cam.detach().cpu().double()
    frame, person = foot_contacts.frame.cpu(), foot_contacts.person.cpu()
    people, person_of = person.unique(return_inverse=True)
    _, row_of = torch.stack([frame, person], -1).unique(dim=0, return_inverse=True)
    place_of = _places(points, person_of, row_of)
    per_row = row_of.bincount()
    weight = per_row.double().mean().reciprocal().expand(len(points)) / STEP_NOISE**2
    if by == "places":
        place_of_row = torch.zeros_like(per_row).scatter(0, row_of, place_of)
        stay = place_of_row.bincount()[place_of].double()
        weight = 1 / (STEP_NOISE**2 + stay * PLACE_NOISE**2) / per_row[row_of]
    contacts = dataclasses.replace(foot_contacts, points_cam=points, person=person, frame=frame)
    return Votes(contacts, people, person_of, row_of, place_of, weight)


def _places(
    points: Float[Tensor, "soles 3"],
    person_of: Int[Tensor, " soles"],
    row_of: Int[Tensor, " soles"],
) -> Int[Tensor, " soles"]:
    """Number the spots where people stood: a row joins the first spot of its person near it."""
    rows = int(row_of.max()) + 1
    ones = torch.ones(len(points), dtype=points.dtype)
    count = torch.zeros(rows, dtype=points.dtype).index_add(0, row_of, ones)
    centre = points.new_zeros(rows, 3).index_add(0, row_of, points) / count[:, None]
    owner = torch.zeros(rows, dtype=torch.long).scatter(0, row_of, person_of)
    spots, owners, place = centre[:0], owner[:0], torch.zeros(rows, dtype=torch.long)
    for row in range(rows):  # one after the other: a row may found the spot of later ones
        near = ((spots - centre[row]).norm(dim=-1) < PLACE) & (owners == owner[row])
        if bool(near.any()):
            place[row] = near.long().argmax()
            continue
        place[row] = len(spots)
        spots = torch.cat([spots, centre[row : row + 1]])
        owners = torch.cat([owners, owner[row : row + 1]])
    return place[row_of]
