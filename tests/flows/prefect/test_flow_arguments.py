"""Arguments of the flows: paths that workers find, names that Prefect accepts."""

from __future__ import annotations

import logging
import re
from pathlib import Path
from types import SimpleNamespace

import pytest

pytest.importorskip("prefect", reason="Prefect isn't installed")

from prefect.client.schemas.actions import ArtifactCreate

from scan2sim.flows.deployed import tile
from scan2sim.pipeline.core.errors import SettingError


def test_paths_are_the_same_for_workers_in_another_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert tile.absolute("out", "town") == str(tmp_path / "town")
    assert tile.absolute("out", "s3://bucket/town") == "s3://bucket/town"


@pytest.mark.parametrize("path", ["town", "~/town", ""])
def test_relative_path_of_a_deployment_is_rejected(path: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The worker would write the world into a temporary folder, which it deletes."""
    monkeypatch.setattr(tile, "deployment", SimpleNamespace(id="a deployment"))
    with pytest.raises(SettingError, match=re.escape(f"out: `{path}` isn't an absolute path")):
        tile.absolute("out", path)
    assert tile.absolute("out", "/data/town") == "/data/town"


@pytest.mark.parametrize(("runner", "address"), [("dask", None), ("threads", "tcp://HEAD:8786")])
def test_no_workers_without_a_cluster(runner: str, address: str | None) -> None:
    with pytest.raises(SettingError, match="workers: 0 workers are those of a cluster"):
        tile.prefect_executor(runner, 0, address)


def test_refused_artifact_does_not_fail_the_run(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    asked = list[str]()

    def refuse(*_: object, key: str, **__: object) -> None:
        asked.append(key)
        raise RuntimeError("429 Too Many Requests")

    monkeypatch.setattr(tile, "create_progress_artifact", refuse)
    monkeypatch.setattr(tile, "get_run_logger", lambda: logging.getLogger("run"))
    show = tile._progress()
    for percent in (10.0, 20.0):
        show("street_0001", percent)
    assert asked == ["progress-street-0001"] and "429 Too Many Requests" in caplog.text


@pytest.mark.parametrize("name", ["Town 2026.11", "Straße_7", "tile.0001", "(copy)"])
def test_any_folder_has_artifacts(name: str) -> None:
    key = tile.artifact_key("survey", name)
    assert ArtifactCreate(key=key).key == key
