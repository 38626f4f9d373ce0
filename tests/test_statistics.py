"""Paired bootstrap and Holm's correction against cases that can be worked out."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import bootstrap, false_discovery_control, norm

from mover_bench.studies.compare import (
    FEWEST,
    RESAMPLES,
    holm,
    interval,
    is_significant,
    paired,
    paired_rooms,
)

VALUES = st.lists(st.floats(-1, 1), min_size=2, max_size=20)


def test_equal_rows_have_no_difference() -> None:
    values = np.random.default_rng(0).normal(size=20).tolist()
    found = paired(values, values)
    assert (found.mean, found.low, found.high, found.p) == (0, 0, 0, 1)


def test_rows_are_compared_in_the_rooms_that_both_have() -> None:
    ours, theirs = {3: 1.0, 1: 0.5, 7: 0.2}, {1: 0.1, 2: 9.0, 3: 0.4}
    assert paired_rooms(ours, theirs) == paired([1.0, 0.5], [0.4, 0.1])
    assert paired_rooms(ours, {2: 9.0}) is None


def test_a_known_shift_is_found_under_larger_differences_between_rooms() -> None:
    """Rooms differ by 1, the rows by .1: only the pairing can tell."""
    draw = np.random.default_rng(1)
    rooms = draw.normal(size=20)
    rows = rooms + 0.1 + 0.02 * draw.normal(size=20)
    found = paired(rows.tolist(), rooms.tolist())
    assert found.low < 0.1 < found.high
    assert found.high - found.low < 0.03
    assert found.p == pytest.approx(1 / (RESAMPLES + 1))
    alone = interval(rows)
    assert alone.high - alone.low > 0.5


def test_the_interval_is_that_of_another_library() -> None:
    values = np.random.default_rng(2).gamma(2.0, size=30)
    other = bootstrap(
        (values,), np.mean, n_resamples=20_000, method="percentile",
        rng=np.random.default_rng(3),
    ).confidence_interval  # fmt: skip
    found = interval(values)
    assert (found.low, found.high) == pytest.approx((other.low, other.high), abs=0.02)


def test_the_interval_and_p_of_many_rooms_are_those_of_the_normal_law() -> None:
    values = 0.1 + np.random.default_rng(4).normal(size=400)
    found = interval(values)
    error = values.std() / math.sqrt(len(values))
    assert (found.low, found.high) == pytest.approx(
        (found.mean - 1.96 * error, found.mean + 1.96 * error), abs=0.1 * error
    )
    assert found.p == pytest.approx(2 * norm.sf(found.mean / error), rel=0.15)


def test_two_rooms_have_the_distribution_that_one_can_count() -> None:
    """Of (0, 1): mean 0, .5, 1 with chances 1/4, 1/2, 1/4; not above zero in a quarter."""
    found = interval([0.0, 1.0])
    assert (found.low, found.high) == (0, 1)
    assert found.p == pytest.approx(0.5, abs=0.02)


@given(VALUES, st.floats(0.1, 10))
@settings(max_examples=30, deadline=None)
def test_p_knows_neither_sign_nor_unit(values: list[float], unit: float) -> None:
    one, other = interval(values), interval([-unit * v for v in values])
    assert one.p == pytest.approx(other.p, abs=1e-3)
    assert one.low == pytest.approx(-other.high / unit, abs=1e-6)
    assert 0 < one.p <= 1


def test_equal_seeds_give_equal_numbers_and_others_hardly_different_ones() -> None:
    values = np.random.default_rng(5).normal(size=15)
    assert interval(values, 7) == interval(values, 7)
    assert interval(values, 7) != interval(values, 8)
    assert interval(values, 7).low == pytest.approx(interval(values, 8).low, abs=0.03)


def test_the_same_difference_in_every_room_is_beyond_doubt() -> None:
    assert interval([0.1] * 20).p == pytest.approx(1 / (RESAMPLES + 1))
    assert interval([0.1] * 6).p == 2 / 2**6
    assert interval([0.0] * 6).p == 1


def test_rows_of_other_rooms_are_refused() -> None:
    with pytest.raises(ValueError, match="2 and 1 rooms"):
        paired([1.0, 2.0], [1.0])
    with pytest.raises(ValueError, match="at least 1"):
        paired([], [])


class TestHolm:
    def test_a_family_worked_out_by_hand(self) -> None:
        """.01 x 4, .02 x 3, then .03 x 2 = .06 is not less; .5 stays."""
        assert holm([0.5, 0.01, 0.03, 0.02]) == pytest.approx([0.5, 0.04, 0.06, 0.06])

    def test_the_largest_may_not_be_smaller_than_those_before_it(self) -> None:
        assert holm([0.02, 0.03]) == pytest.approx([0.04, 0.04])
        assert holm([0.6, 0.7]) == [1, 1]

    def test_nobody_and_one_are_families_too(self) -> None:
        assert holm([]) == []
        assert holm([0.03]) == [0.03]

    @given(st.lists(st.floats(0, 1), min_size=1, max_size=12))
    def test_it_lies_between_no_correction_and_bonferroni(self, chances: list[float]) -> None:
        for found, chance in zip(holm(chances), chances, strict=True):
            assert chance <= found <= min(1, len(chances) * chance) + 1e-12

    @given(st.lists(st.floats(0, 1), min_size=1, max_size=12))
    def test_it_rejects_what_the_procedure_rejects(self, chances: list[float]) -> None:
        """Step down: stop at the first k with p_(k) > level / (m - k + 1)."""
        level, rejected = 0.05, set[int]()
        order = sorted(range(len(chances)), key=lambda k: chances[k])
        for place, index in enumerate(order):
            if chances[index] * (len(chances) - place) > level:
                break
            rejected.add(index)
        assert rejected == {k for k, p in enumerate(holm(chances)) if p <= level}

    @given(st.lists(st.floats(0.001, 1), min_size=1, max_size=12))
    def test_it_is_stricter_than_a_control_of_the_false_discovery_rate(self, chances) -> None:
        weaker = false_discovery_control(chances)
        assert all(a >= b - 1e-12 for a, b in zip(holm(chances), weaker, strict=True))


def test_five_rooms_prove_nothing_and_six_may() -> None:
    assert not is_significant(FEWEST - 1, 2e-4)
    assert is_significant(FEWEST, 2e-4)
    assert not is_significant(FEWEST, 0.06)
    assert 2 / 2**FEWEST < 0.05 < 2 / 2 ** (FEWEST - 1)


def test_a_family_without_any_difference_rarely_claims_one() -> None:
    """Of 60 studies of 10 rows of 12 rooms without any effect, Holm leaves few with a claim.

    With a chance of 5 %, eight or more are claimed in one of a hundred times.
    """
    draw, claims = np.random.default_rng(6), 0
    for _ in range(60):
        rows = [interval(draw.normal(size=12), resamples=1000) for _ in range(10)]
        claims += any(
            is_significant(row.rooms, p)
            for row, p in zip(rows, holm([row.p for row in rows]), strict=True)
        )
    assert claims <= 7
