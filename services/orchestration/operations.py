"""What is done to one service by hand: brought in, started, scaled, healed, ended, removed (D3.2, section 2.3).

Each may be repeated: what is so already stays.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

from scan2sim.pipeline.core.errors import InputError, SettingError
from scan2sim.services.orchestration import onboarding
from scan2sim.services.orchestration.chart import REPLICAS
from scan2sim.services.orchestration.descriptor import Descriptor
from scan2sim.services.orchestration.instance import Instance, Wanted, scale, upgrade
from scan2sim.services.orchestration.lifecycle import Patience, Say, bring, find, find_own, follow
from scan2sim.services.orchestration.osm import FUNCTIONS, SERVICES, Osm, collection_of
from scan2sim.services.orchestration.package import Package

BY_HAND = "-"
"""Stands for a deployment's name where there is none."""
ABSENT = ("OSM has no such package or instance", "`scan2sim orchestrate list` lists them")


@dataclass(frozen=True)
class Function:
    """Of a network service: its descriptor's record in OSM.

    Attributes:
        name: of its chart, or of its machine.
        container: whether it is a chart.
    """

    name: str
    container: bool


def onboard(osm: Osm, packages: Sequence[Package]) -> dict[str, str]:
    """Onboard a service's packages, functions first; returns their records by their descriptors' ids.

    Raises:
        InputError: a network service names a function that is neither among them nor in OSM.
    """
    ordered = sorted(packages, key=lambda one: one.descriptor.sort, reverse=True)
    ids = [(one.descriptor.sort, one.descriptor.id) for one in packages]
    twice = next((one for one in ids if ids.count(one) > 1), None)
    if twice is not None:
        raise InputError(twice[1], f"is the id of two packages ({twice[0]})", "Give each descriptor an id of its own")
    known = {str(one.get("id")) for one in osm.packages(FUNCTIONS)} | {
        one.descriptor.id for one in packages if one.descriptor.sort == "vnfd"
    }
    for one in ordered:
        _check_functions(one.descriptor, known, one.name)
    return {f"{one.descriptor.sort} {one.descriptor.id}": onboarding.onboard(osm, one, BY_HAND) for one in ordered}


def _check_functions(found: Descriptor, known: set[str], where: str) -> None:
    for name in found.functions:
        if name not in known:
            cause = f"is of the function {name}, which is neither given nor in OSM"
            raise InputError(where, cause, "Give its package (VNFD), too")


def instantiate(
    osm: Osm,
    name: str,
    nsd: str,
    vim: str,
    *,
    replicas: int = 1,
    keys: tuple[str, ...] = (),
    values: Mapping[str, Any] | None = None,
    namespace: str = "",
    patience: Patience,
    say: Say,
) -> None:
    """Have an instance of a network service run.

    Args:
        name: that it is given; nsd: its descriptor's id; vim: VIM account's id.

    Raises:
        SettingError: there is no such descriptor. StepError: the name is another one's, or OSM gave up.
    """
    record = _record(osm, SERVICES, nsd)
    function = function_of(osm, nsd)
    kind = "container" if function.container else "machine"
    wanted = Wanted(name, BY_HAND, function.name, kind, nsd, vim, replicas, keys, values, namespace)  # type: ignore[arg-type]
    bring(osm, partial(find_own, osm, name, BY_HAND), wanted, str(record["_id"]), patience, say)


def resize(osm: Osm, name: str, replicas: int, patience: Patience, say: Say) -> None:
    """Have so many of an instance's function.

    Raises:
        SettingError: there is no such instance, or it isn't running.
    """
    there = _running(osm, name)
    function = function_of(osm, there.nsd)
    if function.container:
        if there.values.get(REPLICAS) != replicas:
            body = upgrade(function.name, there.values | {REPLICAS: replicas})
            _wait(osm, there, "action", body, patience, say)
        return
    by = 1 if replicas > there.machines else -1
    for _ in range(abs(replicas - there.machines)):
        _wait(osm, there, "scale", scale(by), Patience(patience.timeout, True, patience.stop), say)


def heal(osm: Osm, name: str, patience: Patience, say: Say) -> None:
    """Have an instance's function made whole: machines anew; a chart is applied again, as Kubernetes heals pods itself.

    Raises:
        SettingError: there is no such instance, or it isn't running.
    """
    there = _running(osm, name)
    function = function_of(osm, there.nsd)
    if function.container:
        _wait(osm, there, "action", upgrade(function.name, there.values), patience, say)
        return
    record = next(one for one in osm.instances() if one["_id"] == there.id)
    broken = [{"vnfInstanceId": key, "cause": "asked for"} for key in record.get("constituent-vnfr-ref", ())]
    _wait(osm, there, "heal", {"healVnfData": broken}, patience, say)


def terminate(osm: Osm, name: str, patience: Patience, say: Say) -> None:
    """End an instance, and keep its record.

    Raises:
        SettingError: there is no such instance.
    """
    there = _there(osm, name)
    if there.running:
        follow(osm, there.name, str(there.running["_id"]), patience, say)
        there = _there(osm, name)
    if there.instantiated:
        _wait(osm, there, "terminate", {}, Patience(patience.timeout, True, patience.stop), say)


def delete_instance(osm: Osm, name: str, patience: Patience, say: Say) -> None:
    """End an instance and forget it, with what may still be begun for it waited for.

    Raises:
        SettingError: there is no such instance.
    """
    there = _there(osm, name)
    bring(osm, partial(find, osm, there.id), None, "", patience, say)


def delete_packages(osm: Osm, ids: Sequence[str]) -> None:
    """Remove network services and functions by their descriptors' ids, in that order.

    Raises:
        SettingError: there is none of an id. Refused: something uses it.
    """
    found = [(where, one) for where in (SERVICES, FUNCTIONS) for one in osm.packages(where) if one.get("id") in ids]
    missing = set(ids) - {str(one.get("id")) for _, one in found}
    if missing:
        raise SettingError(min(missing), *ABSENT)
    for where, one in found:
        osm.remove(where, str(one["_id"]))


def delete(osm: Osm, packages: Sequence[Package], patience: Patience, say: Say) -> None:
    """Undo a service by its packages: its instances, its network service, its functions."""
    services = {one.descriptor.id for one in packages if one.descriptor.sort == "nsd"}
    for record in osm.instances():
        if Instance.of(record, ()).nsd in services:
            delete_instance(osm, str(record["_id"]), patience, say)
    for one in sorted(packages, key=lambda one: one.descriptor.sort):
        record_there = onboarding.record_of(one, osm.packages(collection_of(one)))
        if record_there:
            say(f"removes {one.descriptor.id}")
            osm.remove(collection_of(one), str(record_there["_id"]))


def function_of(osm: Osm, nsd: str) -> Function:
    """The function of a network service.

    Raises:
        SettingError: it isn't in OSM.
    """
    names = _record(osm, SERVICES, nsd).get("vnfd-id") or [""]
    record = _record(osm, FUNCTIONS, str(names[0]))
    units = record.get("kdu") or record.get("vdu") or [{}]
    return Function(str(units[0].get("name") or units[0].get("id")), bool(record.get("kdu")))


def _record(osm: Osm, collection: str, name: str) -> Mapping[str, Any]:
    found = next((one for one in osm.packages(collection) if name in (one.get("id"), one["_id"])), None)
    if found is None:
        raise SettingError(name, "is no package in OSM", "Onboard it: scan2sim orchestrate onboard")
    return found


def _there(osm: Osm, name: str) -> Instance:
    there = find(osm, name)
    if there is None:
        raise SettingError(name, *ABSENT)
    return there


def _running(osm: Osm, name: str) -> Instance:
    there = _there(osm, name)
    if not there.instantiated:
        raise SettingError(name, f"isn't running ({there.state or 'created only'})", "Instantiate it first")
    return there


def _wait(osm: Osm, there: Instance, what: str, body: Mapping[str, Any], patience: Patience, say: Say) -> None:
    operation = osm.act(there.id, what, body)
    if patience.wait:
        follow(osm, there.name, operation, patience, say)
