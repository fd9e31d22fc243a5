from __future__ import annotations

import shutil
import stat
from datetime import timedelta
from pathlib import Path

import pytest
from typer.testing import CliRunner

from scan2sim.flows.cli import app
from scan2sim.pipeline.core.errors import InputError, SettingError
from scan2sim.services.teleoperation.gateway import pki
from scan2sim.services.teleoperation.gateway.identity import Identity, Role
from scan2sim.services.teleoperation.gateway.pki import certify


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("parties")
    words = "--gateway gate.example --gateway 10.0.0.1 --gateway ::1 --vehicle car --vehicle van-2 --station desk"
    assert CliRunner().invoke(app, ["teleop", "certificates", str(folder), *words.split()]).exit_code == 0
    return folder


def test_every_party_gets_a_folder_that_says_who_it_is(made: Path) -> None:
    found = {path.name: Identity.read(path).me for path in made.iterdir() if path.name != "authority"}
    assert {name: (me.role, me.name) for name, me in found.items()} == {
        "gateway": (Role.GATEWAY, "gate.example"),
        "vehicle-car": (Role.VEHICLE, "car"),
        "vehicle-van-2": (Role.VEHICLE, "van-2"),
        "station-desk": (Role.STATION, "desk"),
    }
    assert set(found["gateway"].hosts) == {"gate.example", "10.0.0.1", "::1"}
    assert len({me.fingerprint for me in found.values()}) == 4


def test_keys_are_their_users_alone(made: Path) -> None:
    keys = list(made.rglob("key.pem"))
    assert len(keys) == 5 and all(stat.S_IMODE(path.stat().st_mode) == 0o600 for path in keys)
    key = made.parent / "open" / "key.pem"
    shutil.copytree(made / "vehicle-car", key.parent)
    key.chmod(0o640)
    with pytest.raises(InputError, match="open to other users"):
        Identity.read(key.parent)


def test_what_holds_is_kept_what_ends_or_is_asked_for_is_renewed(made: Path, tmp_path: Path) -> None:
    folder = tmp_path / "parties"
    shutil.copytree(made, folder)
    before = {name: Identity.read(folder / name).me.fingerprint for name in ("vehicle-car", "station-desk")}
    assert [one.made for one in certify(folder, vehicles=["car"], stations=["desk", "new"])] == [False, False, True]
    assert [one.made for one in certify(folder, vehicles=["car"], renew=True)] == [True]
    assert Identity.read(folder / "vehicle-car").me.fingerprint != before["vehicle-car"]
    assert Identity.read(folder / "station-desk").me.fingerprint == before["station-desk"]
    assert [one.made for one in certify(folder, stations=["desk"], days=3000)] == [True]  # a third of that isn't left
    assert [one.made for one in certify(folder, gateway=["elsewhere"])] == [True]
    assert Identity.read(folder / "gateway").me.hosts == ("elsewhere",)
    (folder / "vehicle-van-2" / "certificate.pem").write_text("damaged", encoding="utf-8")
    assert [one.made for one in certify(folder, vehicles=["van-2"])] == [True]


def test_files_that_do_not_fit_are_told(made: Path, tmp_path: Path) -> None:
    def taken(name: str, **others: Path) -> Path:
        folder = Path(shutil.copytree(made / "vehicle-car", tmp_path / name))
        for file, path in others.items():
            shutil.copy(path, folder / f"{file}.pem")
        return folder

    certify(tmp_path / "other", vehicles=["car"])
    for folder, why in (
        (taken("key", key=made / "station-desk" / "key.pem"), "doesn't belong to"),
        (taken("authority", authority=tmp_path / "other" / "vehicle-car" / "authority.pem"), "isn't signed by"),
        (taken("none", certificate=made / "authority" / "certificate.pem"), "says no role and name"),
        (tmp_path / "nowhere", "isn't there"),
    ):
        with pytest.raises(InputError, match=why):
            Identity.read(folder)
    with pytest.raises(InputError, match="a vehicle's, not a station's"):
        Identity.read(made / "vehicle-car", Role.STATION)


def test_an_expired_certificate_is_told_and_renewed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patched:
        patched.setattr(pki, "BEFORE", timedelta(days=5))
        certify(tmp_path, vehicles=["car"], days=-1)
    with pytest.raises(InputError, match="is valid from"):
        Identity.read(tmp_path / "vehicle-car")
    assert certify(tmp_path, vehicles=["car"])[0].made
    assert Identity.read(tmp_path / "vehicle-car").left().days > 360


@pytest.mark.parametrize("name", ["", "../up", "a:b", "a b", "-", "x" * 61])
def test_names_that_lead_elsewhere_are_refused(tmp_path: Path, name: str) -> None:
    for kind in ("vehicles", "stations", "gateway"):
        with pytest.raises(SettingError, match="can't be its name"):
            certify(tmp_path, **{kind: [name]})  # type: ignore[arg-type]
    assert not list(tmp_path.iterdir())


def test_a_lost_half_of_the_authority_is_not_replaced_by_another(made: Path, tmp_path: Path) -> None:
    shutil.copytree(made, tmp_path / "parties")
    (tmp_path / "parties" / "authority" / "key.pem").unlink()
    with pytest.raises(InputError, match=r"key\.pem.*isn't there"):
        certify(tmp_path / "parties", vehicles=["new"])
