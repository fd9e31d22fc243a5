"""Class codes of other surveys: mapping to the project's classes, and warnings about unknown codes."""

from __future__ import annotations

from pathlib import Path

import laspy
import numpy as np
import pytest
from laspy.vlrs.known import ClassificationLookupVlr

from scan2sim.pipeline.core.classes import CODE, code_of, parse_mapping
from scan2sim.pipeline.core.errors import InputError, SettingError
from scan2sim.pipeline.core.step import silent
from scan2sim.pipeline.core.types import Frame, PointCloud
from scan2sim.pipeline.importers.clouds_and_photos import import_las
from scan2sim.pipeline.io import clouds
from scan2sim.pipeline.io.clouds import las
from scan2sim.pipeline.io.las_classes import write_classified
from scan2sim.pipeline.io.survey import read_survey
from scan2sim.pipeline.io.tile import read_tile
from scan2sim.pipeline.steps.ingest import IngestParams, ingest
from scan2sim.pipeline.steps.split import SplitParams, split
from scan2sim.pipeline.tiling.cut_corridor import CutParams, cut_survey
from tests.fakes.steps import step_params
from tests.present import present

N = 2000
LABEL = np.repeat([2, 1, 31, 65, 200], N // 5).astype(np.uint8)


def foreign(path: Path, software: str = "TerraScan", names: dict[int, str] | None = None) -> Path:
    """A LAS file of another program."""
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.generating_software, header.scales = software, np.full(3, 0.001)
    if names:
        lookup = ClassificationLookupVlr()
        lookup.lookups.update(names)
        header.vlrs.append(lookup)
    record = laspy.ScaleAwarePointRecord.zeros(N, header=header)
    record["x"], record["y"], record["z"] = np.random.default_rng(0).uniform(0, 30, (3, N))
    record["classification"] = LABEL
    with laspy.open(path, mode="w", header=header) as writer:
        writer.write_points(record)
    return path


def mapped(path: Path, given: dict[int, int] | None = None) -> list[int]:
    """The project's codes to which codes 2, 1, 31, 65 and 200 of a file are mapped."""
    return clouds.code_table(path, given or {})[[2, 1, 31, 65, 200]].tolist()


def test_project_codes_are_recognized_only_if_the_file_declares_them(tmp_path: Path) -> None:
    assert mapped(foreign(tmp_path / "a.las")) == [2, 1, 31, 1, 1]
    assert mapped(foreign(tmp_path / "b.las", "made by SCAN2SIM 0.1")) == [2, 1, 31, 65, 1]
    assert mapped(foreign(tmp_path / "c.las", names={65: "Pole", 200: "Road sign", 31: "fence"})) == [2, 1, 68, 65, 64]
    assert mapped(foreign(tmp_path / "d.las", "scan2sim", {65: "something"})) == [2, 1, 31, 1, 1]
    assert mapped(foreign(tmp_path / "e.las"), {65: 7, 200: 5, 2: 11}) == [11, 1, 31, 7, 5]


def test_written_codes_are_read_back_as_project_classes(tmp_path: Path) -> None:
    las.write(tmp_path / "own.laz", PointCloud(Frame(), np.zeros((5, 3), np.float32), classification=LABEL[:5]))
    assert mapped(tmp_path / "own.laz")[3] == 65
    code = np.full(N, 65, np.uint8)
    write_classified(foreign(tmp_path / "a.las"), tmp_path / "classified.laz", code, code, code)
    assert mapped(tmp_path / "classified.laz")[3] == 65


def test_user_class_mapping_is_parsed_and_validated(tmp_path: Path) -> None:
    assert parse_mapping("65=noise, 200=5,31=Road sign") == {65: 7, 200: 5, 31: 64}
    assert code_of("ground") == CODE["terrain"]
    refused = {"65": "names no class", "5=noise,5=6": "5=6.*again", "65=x": "no class 'x'", "x=6": "no code"}
    for text, message in (refused | {"256=6": "no code"}).items():
        with pytest.raises(SettingError, match=message):
            parse_mapping(text)
    (tmp_path / "tile.toml").write_text(
        'name = "t"\ncrs = "local"\nclouds = ["a.las"]\n[classes]\n65 = "fog"\n', encoding="utf-8"
    )
    foreign(tmp_path / "a.las")
    with pytest.raises(InputError, match=r"tile\.toml: field `classes`: there is no class 'fog'.*pole"):
        read_tile(tmp_path)


def test_warning_reports_uncodes_of_with_share_and_remedy(tmp_path: Path) -> None:
    tile = read_tile(import_las([foreign(tmp_path / "a.las")], tmp_path / "tile", crs="local", classes={200: 5}))
    assert tile.classes == {200: 5}
    params = step_params(IngestParams, origin=tile.frame.origin, classes=dict(tile.classes))
    done = ingest({"cloud.0000": tile.clouds[0]}, params, tmp_path, silent)
    assert len(done.warnings) == 1 and "codes 65 (20.0%) are the survey's own" in done.warnings[0]
    assert "--classes 65=building" in done.warnings[0]
    (tmp_path / "split").mkdir()
    parted = split({"cloud": done.files["cloud"]}, SplitParams(), tmp_path / "split", silent)
    assert parted.metrics["points"] == {"terrain": 400, "building": 0, "vegetation": 400, "rest": 1200}
    warning = next(w for w in parted.warnings if "no known class" in w and "%" in w)
    assert warning.startswith("60.0% of the points") and "unclassified 40.0%, code_31 20.0%" in warning
    assert '31 = "building"' in warning and "segment.overwrite=true" in warning
    cloud = PointCloud.load(done.files["cloud"])
    cloud.take(np.flatnonzero(present(cloud.classification) != 31)).save(tmp_path / "rest.npz")
    parted = split({"cloud": tmp_path / "rest.npz"}, SplitParams(), tmp_path / "split", silent)
    assert "Classify the cloud again" in parted.warnings[-1] and "[classes]" not in parted.warnings[-1]


def test_conversion_to_laz_keeps_survey_codes(tmp_path: Path) -> None:
    rows = np.column_stack([np.random.default_rng(0).uniform(0, 30, (N, 3)), LABEL])
    np.savetxt(tmp_path / "a.csv", rows, "%.3f,%.3f,%.3f,%d", header="x,y,z,classification", comments="")
    tile = read_tile(import_las([tmp_path / "a.csv"], tmp_path / "tile", crs="local", classes={65: 64}))
    assert mapped(tile.clouds[0], dict(tile.classes)) == [2, 1, 31, 64, 1]


def test_tiles_keep_the_class_mapping_of_the_corridor(tmp_path: Path) -> None:
    path = import_las([foreign(tmp_path / "a.las")], tmp_path / "tile", crs="local", classes={65: 69})
    warned: list[str] = []
    survey = read_survey(cut_survey(path, tmp_path / "survey", CutParams(length=100.0), warn=warned.append))
    assert len(warned) == 1 and warned[0].startswith("a.las: codes 200 (20.0%) are the survey's own")
    tile = read_tile(next(iter(survey.tiles.values())))
    codes = clouds.code_table(tile.clouds[0], tile.classes)[clouds.read(tile.clouds[0], tile.frame).classification]
    assert np.unique(codes).tolist() == [1, 2, 31, 69]
