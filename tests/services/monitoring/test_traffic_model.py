"""Traffic model: daily curve, random events, reproducibility."""

from __future__ import annotations

from pathlib import Path

import pytest
from typer.testing import CliRunner

from scan2sim.flows.cli import app
from scan2sim.pipeline.core.errors import SettingError
from scan2sim.services.monitoring.autoscale import traffic_model
from scan2sim.services.monitoring.autoscale.traffic_model import TrafficParams, events, rate, traffic_share
from scan2sim.services.monitoring.event_csv import read_events


def test_weekdays_have_two_rush_hours_and_weekends_none() -> None:
    day = [traffic_share(0, hour / 10) for hour in range(240)]
    tops = [i / 10 for i in range(1, 239) if day[i] >= day[i - 1] and day[i] > day[i + 1]]
    assert len(tops) == 2 and 7.5 < tops[0] < 8.5 and 17 < tops[1] < 18.5
    assert max(day) <= 1 and min(day) < 0.1 and max(day[:50]) < 0.15
    assert max(traffic_share(6, hour / 10) for hour in range(240)) < 0.6


@pytest.mark.parametrize(("cameras", "above", "below"), [(10, 0.8, 2.0), (20, 1.6, 4.0), (50, 4.0, 10.0)])
def test_peak_rates_match_figure_5_of_d3_2(cameras: int, above: float, below: float) -> None:
    assert above < max(rate(cameras, 0, hour / 10) for hour in range(60, 100)) < below


def test_random_events_follow_the_rate(tmp_path: Path) -> None:
    drawn = list(events(TrafficParams(out=tmp_path / "x", cameras=200)))
    for hour in (6, 7, 8, 9):
        count = sum(hour - 6 <= seconds / 3600 < hour - 5 for seconds, _ in drawn)
        expected = sum(rate(200, 0, hour + minute / 60) * 60 for minute in range(60))
        assert abs(count - expected) < 5 * expected**0.5
    sizes = [size for _, size in drawn]
    assert 50_000 <= min(sizes) < 51_000 and 499_000 < max(sizes) <= 500_000


def test_command_writes_a_file_that_the_dataset_talker_reads(tmp_path: Path) -> None:
    def made(name: str, seed: str) -> bytes:
        given = ["--cameras", "10", "--from", "7", "--to", "8", "--seed", seed]
        result = CliRunner().invoke(app, ["monitor", "traffic", str(tmp_path / name), *given])
        assert result.exit_code == 0, result.output
        return (tmp_path / name).read_bytes()

    assert made("a.csv", "3") == made("b.csv", "3") != made("c.csv", "4")
    assert 1500 < len(list(read_events(tmp_path / "a.csv"))) < 3500


def test_end_before_start_is_rejected(tmp_path: Path) -> None:
    with pytest.raises(SettingError, match="must be after --from"):
        traffic_model.write(TrafficParams(out=tmp_path / "x", from_hour=10, to_hour=6))
