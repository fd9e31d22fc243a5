"""Descriptors of a service as ETSI's SOL006 has them: of its function (VNFD), of the network service around it (NSD).

A function is either `container`, a Helm chart on a Kubernetes cluster, or `machine`, a virtual machine of an image. Its
needs are D3.2's (table 2): processor and memory go into the function, delay, jitter and losses into the link.
"""

from __future__ import annotations

from typing import Any, Literal

from scan2sim.services.orchestration.description import Description
from scan2sim.services.qos.requirements import Requirements

Kind = Literal["container", "machine"]

PROVIDER = "scan2sim"
NETWORK, PORT, FLAVOUR, MEMBER = "mgmtnet", "mgmt-ext", "default-df", "1"
"""Names within descriptors: the link, the connection point on it, the deployment flavour, the function's number."""
ASPECT = "replicas"
"""What machines are scaled by."""
CORES, MEMORY = 1, 2048
"""Of a machine of which neither is asked, MB."""


def vnfd(service: Description, needs: Requirements, kind: Kind, name: str, version: str, chart: str) -> dict[str, Any]:
    """The function's descriptor.

    Args:
        name: its id; version: of it.
        chart: Helm chart, as REPOSITORY/CHART, or as a folder of the package.
    """
    about = {
        "id": name,
        "product-name": name,
        "provider": PROVIDER,
        "version": version,
        "description": _described(service, needs),
        "mgmt-cp": PORT,
    }
    made = _container(service, chart) if kind == "container" else _machine(service, needs)
    return {"vnfd": about | made}


def nsd(service: Description, needs: Requirements, name: str, version: str, function: str) -> dict[str, Any]:
    """The network service's descriptor: one function (its VNFD's id) on one link."""
    quality = {
        "latency": needs.delay and round(needs.delay.value),
        "packet-delay-variation": needs.jitter and round(needs.jitter.value),
        "packet-loss-ratio": needs.loss_rate and needs.loss_rate.value,
    }
    quality = {key: value for key, value in quality.items() if value is not None}
    link: dict[str, Any] = {"id": NETWORK, "mgmt-network": True}
    if quality:
        link["df"] = [{"id": FLAVOUR, "qos": quality}]
    point = {"constituent-base-element-id": MEMBER, "constituent-cpd-id": PORT}
    on_link = {"virtual-link-profile-id": NETWORK, "constituent-cpd-id": [point]}
    profile = {"id": MEMBER, "vnfd-id": function, "virtual-link-connectivity": [on_link]}
    one = {
        "id": name,
        "name": name,
        "designer": PROVIDER,
        "version": version,
        "description": _described(service, needs),
        "vnfd-id": [function],
        "virtual-link-desc": [link],
        "df": [{"id": FLAVOUR, "vnf-profile": [profile]}],
    }
    return {"nsd": {"nsd": [one]}}


def _container(service: Description, chart: str) -> dict[str, Any]:
    return {
        "kdu": [{"name": service.name, "helm-chart": chart, "helm-version": "v3"}],
        "k8s-cluster": {"nets": [{"id": NETWORK}]},
        "ext-cpd": [{"id": PORT, "k8s-cluster-net": NETWORK}],
        "df": [{"id": FLAVOUR}],
    }


def _machine(service: Description, needs: Requirements) -> dict[str, Any]:
    cores = int(needs.cpu_cores.value) if needs.cpu_cores else CORES
    memory = needs.memory.value if needs.memory else MEMORY
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
        "id": FLAVOUR,
        "vdu-profile": [
            {"id": service.name, "min-number-of-instances": 1, "max-number-of-instances": service.replicas}
        ],
        "instantiation-level": [{"id": "one", "vdu-level": [{"vdu-id": service.name, "number-of-instances": 1}]}],
        "scaling-aspect": [
            {
                "id": ASPECT,
                "name": ASPECT,
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
        "ext-cpd": [{"id": PORT, "int-cpd": {"vdu-id": service.name, "cpd": "eth0"}}],
        "df": [flavour],
    }


def _described(service: Description, needs: Requirements) -> str:
    """Title and what no field is for."""
    rest = [f"{needs.bandwidth.value:g} Mbit/s" if needs.bandwidth else "", needs.slice or ""]
    said = ", ".join(part for part in rest if part)
    return f"{service.title} ({said})" if said else service.title
