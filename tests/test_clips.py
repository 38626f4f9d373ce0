"""Scores of clips: what a room that is right must show, on a room that is right."""

from pathlib import Path

import pytest
import torch

from mover.core.errors import InputError
from mover_bench.cli import ExperimentArgs
from mover_bench.experiment.judge_clips import judge_clips, table_of, tops_below


def test_the_surface_under_a_point_is_the_highest_one_below_it():
    square = torch.tensor([[0.0, 0, 0], [1, 0, 0], [1, 0, 1], [0, 0, 1]])
    floor, seat = square * 4 - 1, square + torch.tensor([0, 0.5, 0.0])
    slope = square.clone()
    slope[:, 1] = 0.2 * slope[:, 0]
    slope[:, 0] += 2
    faces = torch.cat([x[torch.tensor([[0, 1, 2], [0, 2, 3]])] for x in (floor, seat, slope)])
    points = torch.tensor([[0.5, 0.6, 0.5], [0.5, 0.4, 0.4], [0.5, 0.3, 0.4], [2.5, 0.9, 0.5]])
    above = torch.tensor([[9.0, 1.0, 9.0]])
    found = tops_below(torch.cat([points, above]), faces)
    assert found.tolist() == pytest.approx([0.5, 0.5, -1, 0.1, -torch.inf], abs=1e-6)


def test_a_folder_without_clips_is_refused_and_a_table_has_a_row_for_each_object(tmp_path: Path):
    for source in (None, tmp_path):
        with pytest.raises(InputError, match="--source: expected a folder of clips"):
            judge_clips(ExperimentArgs(set="clips", source=source))
    rows = [{"object": "bed_0", "size": "1.00 x 0.50 x 2.00", "iou": 0.7}, {"object": "chair_0"}]
    table = table_of({"a": {"stature": 1.7, "objects": rows}})
    assert table.count("\n| a | 1.7 |") == 2
    assert "| bed_0 | 1.00 x 0.50 x 2.00 |" in table
