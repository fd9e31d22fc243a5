from __future__ import annotations

import shutil
import stat
from datetime import timedelta
from pathlib import Path

import pytest
from typer.testing import CliRunner

from scan2sim.flows.cli import app
from scan2sim.pipeline.core.errors import InputError, SettingError
from scan2sim.services.teleoperation import adapter_key
from scan2sim.services.teleoperation.gateway import pki
from scan2sim.services.teleoperation.gateway.pki import certify
from scan2sim.services.teleoperation.identity import Identity, Role


@pytest.fixture(scope="module")
def parties(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("parties")
    options = "--gateway gate.example --gateway 10.0.0.1 --gateway ::1 --vehicle car --vehicle van-2 --station desk"
    assert CliRunner().invoke(app, ["teleop", "certificates", str(folder), *options.split()]).exit_code == 0
    return folder


def test_each_party_gets_a_folder_with_its_identity(parties: Path) -> None:
    found = {path.name: Identity.read(path).me for path in parties.iterdir() if path.name != "authority"}
    assert {name: (me.role, me.name) for name, me in found.items()} == {
        "gateway": (Role.GATEWAY, "gate.example"),
        "vehicle-car": (Role.VEHICLE, "car"),
        "vehicle-van-2": (Role.VEHICLE, "van-2"),
        "station-desk": (Role.STATION, "desk"),
    }
    assert set(found["gateway"].hosts) == {"gate.example", "10.0.0.1", "::1"}
    assert len({me.fingerprint for me in found.values()}) == 4


def test_keys_are_readable_by_their_user_only(parties: Path) -> None:
    keys = list(parties.rglob("key.pem"))
    assert len(keys) == 5 and all(stat.S_IMODE(path.stat().st_mode) == 0o600 for path in keys)
    key = parties.parent / "open" / "key.pem"
    shutil.copytree(parties / "vehicle-car", key.parent)
    key.chmod(0o640)
    with pytest.raises(InputError, match="accessible to other users"):
        Identity.read(key.parent)


def test_each_vehicle_has_a_key_for_its_adapter_that_renewal_keeps(tmp_path: Path) -> None:
    certify(tmp_path, vehicles=["car", "van"])
    files = [tmp_path / f"vehicle-{name}" / "adapter.key" for name in ("car", "van")]
    keys = [adapter_key.read(path) for path in files]
    assert len(set(keys)) == 2 and all(stat.S_IMODE(path.stat().st_mode) == 0o600 for path in files)
    certify(tmp_path, vehicles=["car", "van"], renew=True)
    assert [adapter_key.read(path) for path in files] == keys


def test_valid_certificates_are_kept_others_are_renewed(parties: Path, tmp_path: Path) -> None:
    folder = tmp_path / "parties"
    shutil.copytree(parties, folder)
    before = {name: Identity.read(folder / name).me.fingerprint for name in ("vehicle-car", "station-desk")}
    assert [one.created for one in certify(folder, vehicles=["car"], stations=["desk", "new"])] == [False, False, True]
    assert [one.created for one in certify(folder, vehicles=["car"], renew=True)] == [True]
    assert Identity.read(folder / "vehicle-car").me.fingerprint != before["vehicle-car"]
    assert Identity.read(folder / "station-desk").me.fingerprint == before["station-desk"]
    renewed = certify(folder, stations=["desk"], days=3000)  # less than a third of these days remains
    assert [one.created for one in renewed] == [True]
    assert [one.created for one in certify(folder, gateway=["elsewhere"])] == [True]
    assert Identity.read(folder / "gateway").me.hosts == ("elsewhere",)
    (folder / "vehicle-van-2" / "certificate.pem").write_text("damaged", encoding="utf-8")
    assert [one.created for one in certify(folder, vehicles=["van-2"])] == [True]


def test_mismatched_files_are_reported(parties: Path, tmp_path: Path) -> None:
    def copy(name: str, **others: Path) -> Path:
        folder = Path(shutil.copytree(parties / "vehicle-car", tmp_path / name))
        for file, path in others.items():
            shutil.copy(path, folder / f"{file}.pem")
        return folder

    certify(tmp_path / "other", vehicles=["car"])
    for folder, why in (
        (copy("key", key=parties / "station-desk" / "key.pem"), "doesn't match"),
        (copy("authority", authority=tmp_path / "other" / "vehicle-car" / "authority.pem"), "was not signed by"),
        (copy("none", certificate=parties / "authority" / "certificate.pem"), "contains no role and name"),
        (tmp_path / "nowhere", "file not found"),
    ):
        with pytest.raises(InputError, match=why):
            Identity.read(folder)
    with pytest.raises(InputError, match="belongs to a vehicle, not to a station"):
        Identity.read(parties / "vehicle-car", Role.STATION)


def test_expired_certificate_is_reported_and_renewed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patched:
        patched.setattr(pki, "CLOCK_SKEW_MAX", timedelta(days=5))
        certify(tmp_path, vehicles=["car"], days=-1)
    with pytest.raises(InputError, match="is valid only from"):
        Identity.read(tmp_path / "vehicle-car")
    assert certify(tmp_path, vehicles=["car"])[0].created
    assert Identity.read(tmp_path / "vehicle-car").remaining().days > 360


@pytest.mark.parametrize("name", ["", "../up", "a:b", "a b", "-", "x" * 61])
def test_invalid_names_are_refused(tmp_path: Path, name: str) -> None:
    for kind in ("vehicles", "stations", "gateway"):
        with pytest.raises(SettingError, match="is not a valid name"):
            certify(tmp_path, **{kind: [name]})  # type: ignore[arg-type]
    assert not list(tmp_path.iterdir())


def test_incomplete_authority_is_not_replaced(parties: Path, tmp_path: Path) -> None:
    shutil.copytree(parties, tmp_path / "parties")
    (tmp_path / "parties" / "authority" / "key.pem").unlink()
    with pytest.raises(InputError, match=r"key\.pem.*file not found"):
        certify(tmp_path / "parties", vehicles=["new"])
