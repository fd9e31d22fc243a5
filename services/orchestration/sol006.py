"""ETSI SOL006 descriptors of a service: its network function (VNFD) and the network service (NSD) that contains it.

A function is either a `container` (a Helm chart on a Kubernetes cluster) or a `machine` (a virtual machine image). Its
requirements come from D3.2, table 2: processor and memory are written into the VNFD; delay, jitter and loss rate into
the NSD's virtual link.
"""

from __future__ import annotations

from typing import Any, Literal

from scan2sim.services.orchestration.description import Description
from scan2sim.services.qos.requirements import Requirements

FunctionKind = Literal["container", "machine"]

PROVIDER = "scan2sim"
LINK_ID, CONNECTION_POINT_ID, FLAVOUR_ID, MEMBER_INDEX = "mgmtnet", "mgmt-ext", "default-df", "1"
"""Names used in descriptors: virtual link, connection point, deployment flavour, member VNF index."""
SCALING_ASPECT = "replicas"
"""Name of the aspect by which machines are scaled."""
DEFAULT_CORES, DEFAULT_MEMORY_MB = 1, 2048
"""Size of a machine without requirements."""


def vnfd(
    service: Description, needs: Requirements, kind: FunctionKind, name: str, version: str, chart: str
) -> dict[str, Any]:
    """Descriptor of the network function (VNFD).

    Args:
        name, version: id and version of the descriptor.
        chart: Helm chart, as REPOSITORY/CHART or as a folder in the package.
    """
    about = {
        "id": name,
        "product-name": name,
        "provider": PROVIDER,
        "version": version,
        "description": _description_text(service, needs),
        "mgmt-cp": CONNECTION_POINT_ID,
    }
    made = _container(service, chart) if kind == "container" else _machine(service, needs)
    return {"vnfd": about | made}


def nsd(service: Description, needs: Requirements, name: str, version: str, function: str) -> dict[str, Any]:
    """Descriptor of the network service (NSD): one function, given by its VNFD's id, on one virtual link."""
    quality = {
        "latency": needs.delay and round(needs.delay.value),
        "packet-delay-variation": needs.jitter and round(needs.jitter.value),
        "packet-loss-ratio": needs.loss_rate and needs.loss_rate.value,
    }
    quality = {key: value for key, value in quality.items() if value is not None}
    link: dict[str, Any] = {"id": LINK_ID, "mgmt-network": True}
    if quality:
        link["df"] = [{"id": FLAVOUR_ID, "qos": quality}]
    point = {"constituent-base-element-id": MEMBER_INDEX, "constituent-cpd-id": CONNECTION_POINT_ID}
    on_link = {"virtual-link-profile-id": LINK_ID, "constituent-cpd-id": [point]}
    profile = {"id": MEMBER_INDEX, "vnfd-id": function, "virtual-link-connectivity": [on_link]}
    one = {
        "id": name,
        "name": name,
        "designer": PROVIDER,
        "version": version,
        "description": _description_text(service, needs),
        "vnfd-id": [function],
        "virtual-link-desc": [link],
        "df": [{"id": FLAVOUR_ID, "vnf-profile": [profile]}],
    }
    return {"nsd": {"nsd": [one]}}


def _container(service: Description, chart: str) -> dict[str, Any]:
    return {
        "kdu": [{"name": service.name, "helm-chart": chart, "helm-version": "v3"}],
        "k8s-cluster": {"nets": [{"id": LINK_ID}]},
        "ext-cpd": [{"id": CONNECTION_POINT_ID, "k8s-cluster-net": LINK_ID}],
        "df": [{"id": FLAVOUR_ID}],
    }


def _machine(service: Description, needs: Requirements) -> dict[str, Any]:
    cores = int(needs.cpu_cores.value) if needs.cpu_cores else DEFAULT_CORES
    memory = needs.memory.value if needs.memory else DEFAULT_MEMORY_MB
    port = {"name": "eth0", "position": 1, "virtual-interface": {"type": "PARAVIRT"}}
    unit = {
        "id": service.name,
        "name": service.name,
        "sw-image-desc": service.machine,
        "virtual-compute-desc": "compute",
        "virtual-storage-desc": ["disk"],
        "int-cpd": [{"id": "eth0", "virtual-network-interface-requirement": [port]}],
    }
    one_more = {"id": "one", "vdu-delta": [{"id": service.name, "number-of-instances": 1}]}
    flavour = {
        "id": FLAVOUR_ID,
        "vdu-profile": [
            {"id": service.name, "min-number-of-instances": 1, "max-number-of-instances": service.replicas}
        ],
        "instantiation-level": [{"id": "one", "vdu-level": [{"vdu-id": service.name, "number-of-instances": 1}]}],
        "scaling-aspect": [
            {
                "id": SCALING_ASPECT,
                "name": SCALING_ASPECT,
                "max-scale-level": max(1, service.replicas - 1),
                "aspect-delta-details": {"deltas": [one_more]},
            }
        ],
    }
    return {
        "virtual-compute-desc": [
            {
                "id": "compute",
                "virtual-cpu": {"num-virtual-cpu": cores},
                "virtual-memory": {"size": round(memory / 1024, 2)},  # GB
            }
        ],
        "virtual-storage-desc": [{"id": "disk", "size-of-storage": service.storage}],
        "sw-image-desc": [{"id": service.machine, "name": service.machine, "image": service.machine}],
        "vdu": [unit],
        "ext-cpd": [{"id": CONNECTION_POINT_ID, "int-cpd": {"vdu-id": service.name, "cpd": "eth0"}}],
        "df": [flavour],
    }


def _description_text(service: Description, needs: Requirements) -> str:
    """Title, followed by the requirements that have no field in the descriptor."""
    rest = [f"{needs.bandwidth.value:g} Mbit/s" if needs.bandwidth else "", needs.slice or ""]
    extra = ", ".join(part for part in rest if part)
    return f"{service.title} ({extra})" if extra else service.title
