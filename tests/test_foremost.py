"""Which skin of a body is asked for what it touches: that which reaches farthest."""

import torch

from mover.energy.body_contact import Skin, Surface, gather_matches, touch_term

SEAT, BACK = 0, 1
HEIGHTS = torch.tensor([0.0, 0.01, 0.03, 0.035])  # over the mattress: a back arches
GROUP = torch.tensor([SEAT, SEAT, BACK, BACK])


def on_a_mattress(lying: list[bool], lift: float = 0.0) -> tuple[Skin, Surface]:
    """Bodies whose seats rest on a level surface under hollow backs."""
    count, places = len(lying), torch.tensor([-0.1, 0.0, 0.3, 0.4])
    one = torch.stack([places, HEIGHTS + lift, torch.zeros(4)], -1)
    down = torch.tensor([0.0, -1.0, 0.0]).expand(count, 4, 3)
    skin = Skin(
        one.expand(count, 4, 3), down, torch.ones(count, 4), GROUP, torch.arange(count),
        torch.zeros(count, 3), torch.tensor(lying), 0.0,
    )  # fmt: skip
    top = torch.stack([places, torch.zeros(4), torch.zeros(4)], -1)
    return skin, Surface(top, -down[0], torch.zeros(4).long(), torch.zeros(1))


def test_the_hollow_back_of_who_lies_is_not_drawn_down_while_the_seat_rests() -> None:
    skin, mattress = on_a_mattress([True, False])
    found = gather_matches(skin, mattress)
    asked = torch.zeros(2, 4).index_put((found.body, found.point), found.weight)
    torch.testing.assert_close(asked, torch.tensor([[1.0, 1, 0, 0], [1.0, 1, 1, 1]]))
    slope = torch.autograd.functional.jacobian(
        lambda x: touch_term(x, found, 0.1).sum(), skin.points
    )
    assert (slope[0, GROUP == BACK] == 0).all()
    assert (slope[1, GROUP == BACK, 1] > 0).all()


def test_a_mattress_bears_who_lies_by_what_rests_on_it_wherever_the_body_begins() -> None:
    for lift in (-0.05, 0.05):
        skin, mattress = on_a_mattress([True], lift)
        found = gather_matches(skin, mattress)
        shifts = torch.linspace(-0.08, 0.08, 161)
        up = torch.tensor([0.0, 1.0, 0.0])
        cost = torch.stack([touch_term(skin.points + s * up, found, 0.1).sum() for s in shifts])
        lowest = (skin.points[0, :, 1] + shifts[cost.argmin()]).min()
        assert abs(float(lowest)) < 0.007  # between both points of the seat
