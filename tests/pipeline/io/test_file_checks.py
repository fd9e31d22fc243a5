"""Files that users give."""

from __future__ import annotations

from scan2sim.pipeline.io.file_checks import natural_order


def test_numbers_in_names_count_as_numbers() -> None:
    names = ["10.jpg", "sweep2_b.pcd", "9.jpg", "sweep2_a.pcd", "sweep10.pcd", "007.jpg", "m².jpg", "5².jpg"]
    expected = ["5².jpg", "007.jpg", "9.jpg", "10.jpg", "m².jpg", "sweep2_a.pcd", "sweep2_b.pcd", "sweep10.pcd"]
    assert sorted(names, key=natural_order) == expected
