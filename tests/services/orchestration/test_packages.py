"""Packages: written ones are valid and reproducible, read ones are validated."""

from __future__ import annotations

import gzip
import io
import json
import re
import tarfile
from pathlib import Path

import pytest

from scan2sim.pipeline.core.errors import InputError, SettingError
from scan2sim.services.orchestration import chart, description, descriptor, package
from scan2sim.services.orchestration.description import Description
from scan2sim.services.orchestration.package import build, parse
from scan2sim.services.orchestration.sol006 import FunctionKind
from scan2sim.services.qos.requirements import Environment

VNFD = """
vnfd:
  id: ping
  product-name: ping
  provider: me
  version: "1"
  mgmt-cp: mgmt-ext
  kdu: [{name: ping, helm-chart: stable/ping}]
  k8s-cluster: {nets: [{id: mgmtnet}]}
  ext-cpd: [{id: mgmt-ext, k8s-cluster-net: mgmtnet}]
  df: [{id: default-df}]
"""
NSD = """
nsd:
  nsd:
  - id: pings
    name: pings
    version: "1"
    vnfd-id: [ping]
    virtual-link-desc: [{id: mgmtnet, mgmt-network: true}]
    df:
    - id: default-df
      vnf-profile:
      - id: "1"
        vnfd-id: ping
        virtual-link-connectivity: [{virtual-link-profile-id: mgmtnet, constituent-cpd-id: []}]
"""


def archive(files: dict[str, bytes], *, link: str = "", size: int = -1) -> bytes:
    """A .tar.gz of files; `link`: name of a symbolic link in it."""
    data = io.BytesIO()
    with tarfile.open(fileobj=data, mode="w:gz") as made:
        for path, content in files.items():
            member = tarfile.TarInfo(path)
            member.size = len(content)
            made.addfile(member, io.BytesIO(content))
        if link:
            member = tarfile.TarInfo(link)
            member.type, member.linkname = tarfile.SYMTYPE, "/etc/passwd"
            made.addfile(member)
    return data.getvalue()


@pytest.mark.parametrize("which", description.names())
@pytest.mark.parametrize("kind", ["container", "machine"])
def test_built_in_services_can_be_packaged_and_read_again(which: str, kind: FunctionKind) -> None:
    made = build(description.read(which), Environment.EDGE, kind)
    function, service = (parse(one.data, one.name) for one in (made.function, made.service))
    assert function.descriptor.type == "vnfd" and service.descriptor.type == "nsd"
    assert service.descriptor.functions == (function.descriptor.id,)
    again = build(description.read(which), Environment.EDGE, kind)
    assert again.function.data == made.function.data and again.service.data == made.service.data


def test_ids_change_with_the_content() -> None:
    service = description.read("detect")
    edge, cloud = (build(service, where, "container").function.descriptor.id for where in ("edge", "cloud"))  # type: ignore[arg-type]
    other = build(service.model_copy(update={"port": 9090}), Environment.EDGE, "container").function.descriptor.id
    assert len({edge, cloud, other}) == 3


def test_requirements_are_written_into_descriptors_and_chart() -> None:
    made = build(description.read("detect"), Environment.EDGE, "machine")
    body = made.function.descriptor.body["vnfd"]
    assert body["virtual-compute-desc"][0]["virtual-cpu"]["num-virtual-cpu"] == 8  # D3.2, table 7
    assert body["virtual-compute-desc"][0]["virtual-memory"]["size"] == 16
    link = made.service.descriptor.body["nsd"]["nsd"][0]["virtual-link-desc"][0]
    assert link["df"][0]["qos"] == {"latency": 100, "packet-delay-variation": 50, "packet-loss-ratio": 0.0001}
    service = description.read("detect")
    values = json.loads(chart.files(service, service.requirements_in(Environment.EDGE), "1.0.0")["values.yaml"])
    assert values["resources"] == {"requests": {"cpu": "8"}, "limits": {"memory": "16384Mi"}}


@pytest.mark.parametrize("which", description.names())
def test_a_chart_is_valid_once_helm_has_inserted_the_values(which: str) -> None:
    service = description.read(which)
    files = chart.files(service, service.requirements_in(Environment.EDGE), "1.0.0")
    values = json.loads(files["values.yaml"])

    def insert(match: re.Match[str]) -> str:
        return json.dumps(values[match[1]])

    made = {}
    for path, text in files.items():
        filled = re.sub(r"\{\{ toJson \.Values\.(\w+) \}\}", insert, re.sub(r"\{\{ range .*?\{\{ end \}\}", "", text))
        made[path] = json.loads(re.sub(r"\{\{ .*? \}\}", "x", filled))
    spec = made["templates/deployment.yaml"]["spec"]
    pod = spec["template"]["spec"]
    container = pod["containers"][0]
    assert spec["replicas"] == 1 and spec["selector"]["matchLabels"] == spec["template"]["metadata"]["labels"]
    assert made["templates/variables.yaml"]["data"] == service.variables
    assert bool(service.token) == bool(container["volumeMounts"]) == bool(pod["volumes"])
    if service.token:
        (mounted,), (volume,) = container["volumeMounts"], pod["volumes"]
        (item,) = volume["secret"]["items"]
        assert made["templates/token.yaml"]["data"].keys() == {item["key"]} and mounted["name"] == volume["name"]
        assert f"{mounted['mountPath']}/{item['path']}" == service.token
    assert container["ports"][0]["name"] == made["templates/service.yaml"]["spec"]["ports"][0]["targetPort"]


@pytest.mark.parametrize("which", description.names())
def test_services_that_listen_in_a_cluster_have_a_token(which: str) -> None:
    """Other pods can connect to them, and they refuse to listen there without a token."""
    service = description.read(which)
    words = (*service.command, *service.arguments)
    if words[:1] == ("prefect",):  # a worker, which serves only its health check
        assert service.token is None
    else:
        assert service.token and words[words.index("--token") + 1] == service.token


def test_the_type_of_a_package_is_read_from_its_descriptor_not_its_name(tmp_path: Path) -> None:
    path = tmp_path / "my_nsd.tar.gz"
    path.write_bytes(archive({"x/anything.yaml": VNFD.encode()}))
    assert package.read(path).descriptor.type == "vnfd"


@pytest.mark.parametrize(
    ("data", "expected"),
    [
        (archive({"/etc/x.yaml": VNFD.encode()}), "path traversal"),
        (archive({"x/../../x.yaml": VNFD.encode()}), "path traversal"),
        (archive({"x/x.yaml": VNFD.encode()}, link="x/link"), "a link that leaves the archive"),
        (archive({"x/x.yaml": VNFD.encode(), "y/y.yaml": b""}), "one folder"),
        (archive({"x.yaml": VNFD.encode()}), "one folder"),
        (archive({"x/x.yaml": VNFD.encode(), "x/y.yaml": VNFD.encode()}), "2 descriptors"),
        (archive({"x/readme": b"nothing"}), "0 descriptors"),
        (archive({"x/x.yaml": VNFD.encode(), "x/checksums.txt": b"00\tx.yaml\n"}), "x.yaml doesn't match its checksum"),
        (
            archive({"x/x.yaml": VNFD.encode(), "x/checksums.txt": b"00\tgone\n"}),
            "gone, listed in checksums.txt, is missing",
        ),
        (archive({"x/x.yaml": b"\xff\xfe"}), "UTF-8"),
        (archive({f"x/{i}": b"" for i in range(1100)}), "more than 1,000 files"),
        (b"PK\x03\x04 and so on", "is a ZIP"),
        (b"nothing of the kind", "not a readable .tar.gz"),
        (archive({"x/x.yaml": VNFD.encode()})[:-40], "not a readable .tar.gz"),
        (b"", "not a readable .tar.gz"),
    ],
)
def test_malicious_or_invalid_archives_are_rejected(data: bytes, expected: str) -> None:
    with pytest.raises(InputError, match=re.escape(expected)):
        parse(data, "bad.tar.gz")


@pytest.mark.parametrize("kind", ["file", "header"])
def test_a_decompression_bomb_is_rejected(kind: str) -> None:
    """A file of ten gigabytes, or an archive header of that size."""
    member = tarfile.TarInfo("x/x.yaml")
    member.size = 10 * 2**30
    member.type = tarfile.REGTYPE if kind == "file" else tarfile.XHDTYPE
    data = io.BytesIO()
    with gzip.GzipFile(fileobj=data, mode="wb") as packed:
        packed.write(member.tobuf(tarfile.GNU_FORMAT))
        for _ in range(80):
            packed.write(bytes(2**20))
    with pytest.raises(InputError, match=r"more than 67,108,864 bytes|not a readable \.tar\.gz"):
        parse(data.getvalue(), "bomb.tar.gz")


BILLION = "\n".join(["a0: &a0 [x, x]", *(f"a{i}: &a{i} [*a{i - 1}, *a{i - 1}]" for i in range(1, 40))])


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (BILLION, "aliases aren't allowed"),
        ("vnfd: &a {b: 1}\nother: *a", "aliases aren't allowed"),
        ("[" * 2000, "levels"),
        ("a: " + "x" * 1_100_000, "1,000,000 characters"),
        ("vnfd:vnfd-catalog:\n  vnfd: []", "model before SOL006"),
        ("nsd-catalog: {nsd: []}", "model before SOL006"),
        ("just text", "not a descriptor"),
        ("other: 1", "not a descriptor"),
        (VNFD + "  id: pong\n", "duplicate key"),
        (VNFD.replace("mgmt-cp: mgmt-ext", "mgmt-interface: {cp: x}"), "mgmt"),
        (NSD.replace("vnfd-id: ping\n        v", "vnfd-id: pong\n        v"), "missing in `vnfd-id`"),
        (NSD.replace("virtual-link-desc: [{id: mgmtnet", "virtual-link-desc: [{id: other"), "isn't defined"),
        ("vnfd: !!python/object/apply:os.system ['true']", "invalid YAML"),
    ],
)
def test_invalid_descriptors_are_rejected_with_a_reason(text: str, expected: str) -> None:
    with pytest.raises(InputError, match=re.escape(expected)):
        descriptor.read(text, "vnfd.yaml")


def test_unicode_is_kept() -> None:
    made = Description(name="gruss", title="Grüße, 你好", image="a/b:1", machine="b")
    found = parse(build(made, Environment.EDGE, "container").function.data, "x").descriptor
    assert found.body["vnfd"]["description"] == "Grüße, 你好"


def test_invalid_descriptions_are_rejected(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text('name = "My Service"\ntitle = "x"\nimage = "a"\nmachine = "b"', encoding="utf-8")
    with pytest.raises(InputError, match="name"):
        description.read(path)
    with pytest.raises(InputError, match="one of: classify"):
        description.read("nothing")
    traffic = description.read("worker").model_copy(update={"needs": None, "requirements": "traffic"})
    with pytest.raises(SettingError, match="has no requirements for it"):
        build(traffic, Environment.ROBOT, "container")
