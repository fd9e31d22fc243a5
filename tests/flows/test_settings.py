"""Settings: defaults of D3.2, the user's values, and rejected values."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_args, get_type_hints

import pytest
from typer.testing import CliRunner

from scan2sim.flows.cli import COMMANDS, app, loaded
from scan2sim.flows.commands.option_ranges import NumericOptions
from scan2sim.flows.pipelines.bag import BagSource
from scan2sim.flows.pipelines.images import Images
from scan2sim.flows.pipelines.settings import Settings
from scan2sim.flows.pipelines.steps import STEPS
from scan2sim.flows.reports.settings_page import __doc__ as settings_page_module
from scan2sim.flows.reports.settings_page import settings_page
from scan2sim.flows.reports.view import ViewParams
from scan2sim.pipeline.core.errors import SettingError
from scan2sim.pipeline.core.parameters import described
from scan2sim.pipeline.core.step import Params
from scan2sim.pipeline.io.world_formats import SceneParams
from scan2sim.pipeline.pose_check.conventions import PhotoConventions
from scan2sim.pipeline.steps.decimate import DECIMATE
from scan2sim.pipeline.steps.export import EXPORT
from scan2sim.pipeline.steps.import_sweeps import SweepsParams
from scan2sim.pipeline.steps.split import SPLIT
from scan2sim.pipeline.steps.trim import TRIM
from scan2sim.pipeline.tiling.cut_corridor import CutParams
from scan2sim.services.monitoring.autoscale.traffic_model import TrafficParams
from scan2sim.services.monitoring.embedded_broker import BrokerParams
from scan2sim.services.monitoring.settings.archive import QueryParams
from scan2sim.services.monitoring.settings.bus import MuteParams, ScaleParams
from scan2sim.services.monitoring.settings.dashboard import PageParams
from scan2sim.services.monitoring.settings.monitor import DatasetParams, TalkerParams, TopicParams, WorkParams
from scan2sim.services.orchestration.settings import ApplyParams, ScaleInstanceParams
from scan2sim.services.qos.encoding import ChoiceParams
from scan2sim.services.qos.measure import MeasureParams
from scan2sim.services.teleoperation.settings import (
    DemoParams,
    ReplayParams,
    StationParams,
    VehicleParams,
)
from scan2sim.services.teleoperation.settings import MeasureParams as DrivenParams
from scan2sim.services.teleoperation.vehicle.adapter import AdapterParams
from scan2sim.services.toolboxes.settings import CameraParams, NodeParams, ServeParams
from scan2sim.services.toolboxes.tasks import classify, detect, movement, segment
from scan2sim.services.world_camera.settings import WorldCameraParams
from scan2sim.slam.steps.track import Filmed
from scan2sim.texturing.texture_layout import UnwrapParams, check_size
from tests.conftest import ROOT


def test_defaults_are_those_of_d32() -> None:
    settings = Settings.read()
    assert [settings.params(DECIMATE, g).target for g in ("terrain", "building", "vegetation")] == [
        100_000,
        100_000,
        300_000,
    ]
    assert [settings.params(TRIM, g).max_edge for g in ("terrain", "building", "vegetation")] == [0.5, 0.25, 0.25]


def test_class_overrides_general_setting_and_command_line_overrides_file(tmp_path: Path) -> None:
    (tmp_path / "s.toml").write_text(
        "[decimate]\ntarget = 20000\n[decimate.building]\ntarget = 30000\n", encoding="utf-8"
    )
    settings = Settings.read(tmp_path / "s.toml", ["decimate.vegetation.target=40000", "split.vegetation=both"])
    assert [settings.params(DECIMATE, g).target for g in ("terrain", "building", "vegetation")] == [
        20_000,
        30_000,
        40_000,
    ]
    assert settings.params(SPLIT).vegetation == "both"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("decimat.target=50000", "Did you mean `decimate`"),
        ("decimate.targt=50000", "Did you mean `target`"),
        ("decimate.roof.target=50000", "no such parameter"),
        ("decimate.target", "is not an assignment"),
        ("target=5", "is not an assignment"),
    ],
)
def test_unknown_names_are_rejected_with_a_suggestion(text: str, message: str) -> None:
    with pytest.raises(SettingError) as caught:
        Settings.read(None, [text]).check(STEPS)
    assert message in str(caught.value)


@pytest.mark.parametrize(
    "text",
    ["decimate.target=5", "decimate.target=many", "split.vegetation=maybe", "voxel.size=-1", "texture.device=gpu"],
)
def test_values_out_of_range_are_rejected(text: str) -> None:
    settings = Settings.read(None, [text])
    step = next(s for s in STEPS if s.name == text.split(".")[0])
    with pytest.raises(SettingError, match=text.split("=")[0]):
        settings.params(step, "terrain")


@pytest.mark.parametrize("text", ['["gazebo", "mujoco"]', "[gazebo,mujoco]", "[gazebo, mujoco]", "['gazebo','mujoco']"])
def test_a_list_of_words_needs_no_quotes(text: str) -> None:
    settings = Settings.read(None, [f"export.formats={text}"])
    assert list(settings.params(EXPORT).formats) == ["gazebo", "mujoco"]


def test_what_the_pipeline_passes_is_no_setting() -> None:
    with pytest.raises(SettingError, match="no such parameter"):
        Settings.read(None, ["clip.context={}"]).check(STEPS)


def test_broken_file_is_rejected(tmp_path: Path) -> None:
    (tmp_path / "s.toml").write_text("[decimate\n", encoding="utf-8")
    with pytest.raises(SettingError, match="TOML"):
        Settings.read(tmp_path / "s.toml")


# every setting: wild values are rejected with name and range, or are harmless

MODELS: dict[str, type[Params]] = {
    **{step.name: step.params for step in STEPS}, "": NumericOptions,
}  # fmt: skip
SETTINGS = [(where, name) for where, model in MODELS.items() for name in model.settings()]
WILD_VALUES: tuple[Any, ...] = (
    float("nan"), float("inf"), float("-inf"), -1, -1e300, 0, 1e300, 1e-300, 10**30, "9" * 6000, "wild", "a\0b",
    "x" * 100_000, [], {}, [float("nan")] * 3, [1e300] * 2, True, None,
)  # fmt: skip


@pytest.mark.parametrize(("where", "name"), SETTINGS)
def test_wild_values_are_rejected_with_name_and_range(where: str, name: str) -> None:
    model = MODELS[where]
    cell = {"name": "a", "seed": (0, 0)}
    required = (
        {"context": cell} if "context" in model.model_fields and model.model_fields["context"].is_required() else {}
    )
    for value in WILD_VALUES:
        try:
            made = model.of(where, required | {name: value})
        except SettingError as error:
            where_named = f"{where}.{name}" if where else f"--{name.replace('_', '-')}"
            assert error.where == where_named and described(model.model_fields[name]) in error.cause, (value, error)
            assert len(str(error)) < 400, "the message doesn't repeat a long value"
        else:
            assert is_harmless(getattr(made, name)), (value, made)


def is_harmless(value: object) -> bool:
    """Whether all numbers in a value are finite and at most 1e10."""
    if isinstance(value, (list, tuple)):
        return all(map(is_harmless, value))
    return not isinstance(value, (int, float)) or abs(value) <= 1e10


@pytest.mark.parametrize(("where", "name"), SETTINGS)
def test_every_number_has_minimum_and_maximum(where: str, name: str) -> None:
    assert "any" not in described(MODELS[where].model_fields[name]).replace(",", "").split()


def test_settings_page_is_up_to_date() -> None:
    page = ROOT / "docs" / "reference" / "settings.md"
    assert page.read_text(encoding="utf-8") == settings_page(), settings_page_module


def leaves(command: Any) -> Iterator[Any]:
    """The commands of a group and of the groups in it; a command itself."""
    if hasattr(command, "commands"):
        for one in command.commands.values():
            yield from leaves(one)
    else:
        yield command


def test_every_numeric_option_has_a_range() -> None:
    hints = [get_type_hints(one.callback) for name in COMMANDS for one in leaves(loaded(name))]
    shown = (SceneParams, ViewParams, PhotoConventions, WorldCameraParams)
    boxes = (detect.Params, movement.Params, classify.Params, segment.Params, ServeParams, NodeParams, CameraParams)
    nodes = (TopicParams, TalkerParams, DatasetParams, WorkParams, ScaleParams, MuteParams, BrokerParams)
    bus = (QueryParams, TrafficParams, PageParams, *nodes)
    osm, qos = (ApplyParams, ScaleInstanceParams), (MeasureParams, ChoiceParams)
    driven = (VehicleParams, DemoParams, AdapterParams, DrivenParams, StationParams, ReplayParams)
    numbers = {name for of in hints for name, kind in of.items() if {int, float} & {kind, *get_args(kind)}}
    assert len(numbers) > 15 and numbers <= {
        name
        for model in (
            NumericOptions,
            Filmed,
            CutParams,
            SweepsParams,
            BagSource,
            Images,
            *shown,
            *qos,
            *osm,
            *bus,
            *boxes,
            *driven,
        )
        for name in model.model_fields
    }


@pytest.mark.parametrize(
    ("arguments", "option"),
    [
        (("slam", "v.mp4", "--focal", "nan"), "--focal"),
        (("slam", "v.mp4", "--focal", "-5"), "--focal"),
        (("slam", "v.mp4", "--focal", "0"), "--focal"),
        (("slam", "v.mp4", "--focal", "inf"), "--focal"),
        (("slam", "v.mp4", "--centre", "nan", "3"), "--centre"),
        (("slam", "v.mp4", "--fps", "0"), "--fps"),
        (("slam", "v.mp4", "--set", "track.sigma=nan"), "track.sigma"),
        (("run", "tile", "--hold-out", "1"), "sweeps.hold_out"),
        (("run", "data_samples/tile", "--set", "export.world_origin=[nan, 0, 0]"), "export.world_origin"),
        (("run", "data_samples/tile", "--set", "export.world_origin=[1e300, 0, 0]"), "export.world_origin"),
        (("run", "data_samples/tile", "--set", "poisson.threads=100000"), "poisson.threads"),
        (("run", "data_samples/tile", "--set", "unwrap.texel=1e-9"), "unwrap.texel"),
        (("run", "data_samples/tile", "--set", "unwrap.vegetation.texel=nan"), "unwrap.texel"),
        (("run", "data_samples/tile", "--set", f"voxel.size={'9' * 6000}"), "voxel.size"),
        (("tile", "data_samples/tile", "--length", "nan"), "--length"),
        (("survey", "data_samples/tile", "--buffer", "inf"), "--buffer"),
    ],
)
def test_commands_reject_wild_numbers_before_they_run(arguments: tuple[str, ...], option: str, tmp_path: Path) -> None:
    given = ["data_samples/tile" if a == "tile" and i else a for i, a in enumerate(arguments)]
    result = CliRunner().invoke(app, [*given, "--out", str(tmp_path / "out")])
    assert isinstance(result.exception, SettingError) and result.exception.where == option
    assert "must be" in result.exception.cause and not (tmp_path / "out" / "steps").exists()


def test_sample_of_wild_size_is_rejected(tmp_path: Path) -> None:
    for option, value in (("--length", "1e300"), ("--points", "nan"), ("--photos", "-3"), ("--seed", "-1")):
        result = CliRunner().invoke(app, ["sample", str(tmp_path / "street"), option, value])
        assert isinstance(result.exception, SettingError) and result.exception.where == option


def test_texel_too_small_for_a_surface_is_rejected() -> None:
    check_size(2e8, UnwrapParams(texel=0.01))
    with pytest.raises(SettingError, match=r"texels of 0\.0005 m give .* Set unwrap\.texel=0\.0023 or larger"):
        check_size(8e10, UnwrapParams(texel=0.0005))
