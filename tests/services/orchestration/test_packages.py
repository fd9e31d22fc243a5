"""Packages: what is written is right and repeatable, and what is read is not trusted."""

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
from scan2sim.services.orchestration.package import build, unpacked
from scan2sim.services.orchestration.sol006 import Kind
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
    """A .tar.gz of files; with a link of that name, or a first file that says it is so large."""
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
def test_what_comes_along_is_packed_and_read_again(which: str, kind: Kind) -> None:
    made = build(description.read(which), Environment.EDGE, kind)
    function, service = (unpacked(one.data, one.name) for one in (made.function, made.service))
    assert function.descriptor.sort == "vnfd" and service.descriptor.sort == "nsd"
    assert service.descriptor.functions == (function.descriptor.id,)
    again = build(description.read(which), Environment.EDGE, kind)
    assert again.function.data == made.function.data and again.service.data == made.service.data


def test_ids_change_with_what_they_name() -> None:
    service = description.read("detect")
    edge, cloud = (build(service, where, "container").function.descriptor.id for where in ("edge", "cloud"))  # type: ignore[arg-type]
    other = build(service.model_copy(update={"port": 9090}), Environment.EDGE, "container").function.descriptor.id
    assert len({edge, cloud, other}) == 3


def test_needs_of_the_mission_go_into_descriptors_and_chart() -> None:
    made = build(description.read("detect"), Environment.EDGE, "machine")
    body = made.function.descriptor.body["vnfd"]
    assert body["virtual-compute-desc"][0]["virtual-cpu"]["num-virtual-cpu"] == 8  # D3.2, table 7
    assert body["virtual-compute-desc"][0]["virtual-memory"]["size"] == 16
    link = made.service.descriptor.body["nsd"]["nsd"][0]["virtual-link-desc"][0]
    assert link["df"][0]["qos"] == {"latency": 100, "packet-delay-variation": 50, "packet-loss-ratio": 0.0001}
    service = description.read("detect")
    values = json.loads(chart.files(service, service.needed(Environment.EDGE), "1.0.0")["values.yaml"])
    assert values["resources"] == {"requests": {"cpu": "8"}, "limits": {"memory": "16384Mi"}}


@pytest.mark.parametrize("which", description.names())
def test_a_charts_templates_are_what_kubernetes_takes_once_values_are_in(which: str) -> None:
    service = description.read(which)
    files = chart.files(service, service.needed(Environment.EDGE), "1.0.0")
    values = json.loads(files["values.yaml"])

    def put(match: re.Match[str]) -> str:
        return json.dumps(values[match[1]])

    made = {}
    for path, text in files.items():
        filled = re.sub(r"\{\{ toJson \.Values\.(\w+) \}\}", put, text)
        made[path] = json.loads(re.sub(r"\{\{ .*? \}\}", "x", filled))
    spec = made["templates/deployment.yaml"]["spec"]
    pod = spec["template"]["spec"]
    container = pod["containers"][0]
    assert spec["replicas"] == 1 and spec["selector"]["matchLabels"] == spec["template"]["metadata"]["labels"]
    assert made["templates/variables.yaml"]["data"] == service.variables
    assert bool(service.token) == ("volumeMounts" in container) == bool(pod["volumes"])
    if service.token:
        (mounted,), (volume,) = container["volumeMounts"], pod["volumes"]
        (item,) = volume["secret"]["items"]
        assert made["templates/token.yaml"]["data"].keys() == {item["key"]} and mounted["name"] == volume["name"]
        assert f"{mounted['mountPath']}/{item['path']}" == service.token
    assert container["ports"][0]["name"] == made["templates/service.yaml"]["spec"]["ports"][0]["targetPort"]


@pytest.mark.parametrize("which", description.names())
def test_what_listens_in_a_cluster_has_a_token(which: str) -> None:
    """Pods are reached by others, and the services of this project refuse to listen there without a token."""
    service = description.read(which)
    words = (*service.command, *service.arguments)
    if words[:1] == ("prefect",):  # a worker, which serves its health alone
        assert service.token is None
    else:
        assert service.token and words[words.index("--token") + 1] == service.token


def test_a_package_is_known_by_what_it_holds_not_by_its_name(tmp_path: Path) -> None:
    path = tmp_path / "my_nsd.tar.gz"
    path.write_bytes(archive({"x/anything.yaml": VNFD.encode()}))
    assert package.read(path).descriptor.sort == "vnfd"


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (archive({"/etc/x.yaml": VNFD.encode()}), "outside of itself"),
        (archive({"x/../../x.yaml": VNFD.encode()}), "outside of itself"),
        (archive({"x/x.yaml": VNFD.encode()}, link="x/link"), "a link or a device"),
        (archive({"x/x.yaml": VNFD.encode(), "y/y.yaml": b""}), "one folder"),
        (archive({"x.yaml": VNFD.encode()}), "one folder"),
        (archive({"x/x.yaml": VNFD.encode(), "x/y.yaml": VNFD.encode()}), "2 descriptors"),
        (archive({"x/readme": b"nothing"}), "0 descriptors"),
        (archive({"x/x.yaml": VNFD.encode(), "x/checksums.txt": b"00\tx.yaml\n"}), "isn't what checksums.txt says"),
        (archive({"x/x.yaml": VNFD.encode(), "x/checksums.txt": b"00\tgone\n"}), "lacks gone"),
        (archive({"x/x.yaml": b"\xff\xfe"}), "UTF-8"),
        (archive({f"x/{i}": b"" for i in range(1100)}), "more than 1,000 files"),
        (b"PK\x03\x04 and so on", "is a ZIP"),
        (b"nothing of the kind", "is no .tar.gz"),
        (archive({"x/x.yaml": VNFD.encode()})[:-40], "is no .tar.gz"),
        (b"", "is no .tar.gz"),
    ],
)
def test_archives_that_mean_harm_or_are_none_are_refused(data: bytes, said: str) -> None:
    with pytest.raises(InputError, match=re.escape(said)):
        unpacked(data, "bad.tar.gz")


@pytest.mark.parametrize("kind", ["file", "header"])
def test_a_bomb_is_refused_before_it_is_unpacked(kind: str) -> None:
    """Of ten gigabytes: a file that says so, and a header of the archive's own that does."""
    member = tarfile.TarInfo("x/x.yaml")
    member.size = 10 * 2**30
    member.type = tarfile.REGTYPE if kind == "file" else tarfile.XHDTYPE
    data = io.BytesIO()
    with gzip.GzipFile(fileobj=data, mode="wb") as packed:
        packed.write(member.tobuf(tarfile.GNU_FORMAT))
        for _ in range(80):
            packed.write(bytes(2**20))
    with pytest.raises(InputError, match="more than 67,108,864 bytes|is no .tar.gz"):
        unpacked(data.getvalue(), "bomb.tar.gz")


BILLION = "\n".join(["a0: &a0 [x, x]", *(f"a{i}: &a{i} [*a{i - 1}, *a{i - 1}]" for i in range(1, 40))])


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (BILLION, "aliases are refused"),
        ("vnfd: &a {b: 1}\nother: *a", "aliases are refused"),
        ("[" * 2000, "levels"),
        ("a: " + "x" * 1_100_000, "1,000,000 bytes"),
        ("vnfd:vnfd-catalog:\n  vnfd: []", "model before SOL006"),
        ("nsd-catalog: {nsd: []}", "model before SOL006"),
        ("just text", "is no descriptor"),
        ("other: 1", "is no descriptor"),
        (VNFD + "  id: pong\n", "stands twice"),
        (VNFD.replace("mgmt-cp: mgmt-ext", "mgmt-interface: {cp: x}"), "mgmt"),
        (NSD.replace("vnfd-id: ping\n        v", "vnfd-id: pong\n        v"), "doesn't list"),
        (NSD.replace("virtual-link-desc: [{id: mgmtnet", "virtual-link-desc: [{id: other"), "is no link"),
        ("vnfd: !!python/object/apply:os.system ['true']", "no YAML that is taken"),
    ],
)
def test_descriptors_that_cant_be_are_refused_with_what_to_change(text: str, said: str) -> None:
    with pytest.raises(InputError, match=re.escape(said)):
        descriptor.read(text, "vnfd.yaml")


def test_unicode_is_kept() -> None:
    made = Description(name="gruss", title="Grüße, 你好", image="a/b:1", machine="b")
    found = unpacked(build(made, Environment.EDGE, "container").function.data, "x").descriptor
    assert found.body["vnfd"]["description"] == "Grüße, 你好"


def test_descriptions_are_checked(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text('name = "My Service"\ntitle = "x"\nimage = "a"\nmachine = "b"', encoding="utf-8")
    with pytest.raises(InputError, match="name"):
        description.read(path)
    with pytest.raises(InputError, match="one of: classify"):
        description.read("nothing")
    elsewhere = description.read("worker").model_copy(update={"needs": None, "requirements": "traffic"})
    with pytest.raises(SettingError, match="has no requirements there"):
        build(elsewhere, Environment.ROBOT, "container")
