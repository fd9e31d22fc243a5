"""Single operations: onboard, instantiate, scale, heal, terminate and delete services (D3.2, section 2.3).

All operations are idempotent.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

from scan2sim.pipeline.core.errors import InputError, ScanError, SettingError, UnavailableError
from scan2sim.services.orchestration import onboarding
from scan2sim.services.orchestration.chart import REPLICA_COUNT_KEY
from scan2sim.services.orchestration.descriptor import Descriptor
from scan2sim.services.orchestration.instance import DesiredInstance, Instance, scale_request, upgrade_request
from scan2sim.services.orchestration.lifecycle import (
    Notify,
    WaitPolicy,
    find,
    find_owned,
    reconcile,
    wait_for_operation,
)
from scan2sim.services.orchestration.osm import FUNCTIONS, SERVICES, Osm, collection_of
from scan2sim.services.orchestration.package import Package
from scan2sim.services.orchestration.records import PackageRecord

NO_DEPLOYMENT = "-"
"""Takes the place of the deployment's name for instances and packages that were created by a single command."""
NOT_FOUND = ("OSM has no such package or instance", "`scan2sim orchestrate list` lists them")


@dataclass(frozen=True)
class Function:
    """Function of a network service, from its descriptor's record in OSM.

    Attributes:
        name: name of its chart or machine.
        container: True for a chart, False for a machine.
    """

    name: str
    container: bool


def onboard(osm: Osm, packages: Sequence[Package]) -> dict[str, str]:
    """Onboard a service's packages, functions first; returns record ids by descriptor type and id.

    Raises:
        InputError: a network service refers to a function that is neither among the packages nor in OSM, or two
            packages have the same id.
    """
    ordered = _functions_first(packages)
    known = {one.id for one in osm.packages(FUNCTIONS)} | {
        one.descriptor.id for one in packages if one.descriptor.type == "vnfd"
    }
    for one in ordered:
        _check_functions(one.descriptor, known, one.name)
    return {
        f"{one.descriptor.type} {one.descriptor.id}": onboarding.onboard(osm, one, NO_DEPLOYMENT) for one in ordered
    }


def onboard_each(osm: Osm, packages: Sequence[Package]) -> Iterator[str | ScanError]:
    """Onboard packages, functions first; yields the type and id of each, or why it isn't onboarded.

    Raises:
        InputError: two packages have the same id.
        UnavailableError: OSM can't be reached.
    """
    for package in _functions_first(packages):
        try:
            yield from onboard(osm, [package])
        except UnavailableError:
            raise
        except ScanError as error:
            yield error


def _functions_first(packages: Sequence[Package]) -> list[Package]:
    ids = [(one.descriptor.type, one.descriptor.id) for one in packages]
    duplicate = next((one for one in ids if ids.count(one) > 1), None)
    if duplicate is not None:
        raise InputError(duplicate[1], f"two packages ({duplicate[0]}) have this id", "Give each descriptor its own id")
    return sorted(packages, key=lambda one: one.descriptor.type, reverse=True)


def _check_functions(descriptor: Descriptor, known: set[str], where: str) -> None:
    for name in descriptor.functions:
        if name not in known:
            cause = f"refers to the function {name}, which is neither given nor in OSM"
            raise InputError(where, cause, "Also give its package (VNFD)")


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
    wait_policy: WaitPolicy,
    notify: Notify,
) -> None:
    """Create and start an instance of a network service.

    Args:
        name: name of the instance; nsd: id of its descriptor; vim: id of the VIM account.

    Raises:
        SettingError: there is no such descriptor.
        StepError: the name belongs to another owner, or OSM reports a failure.
    """
    record = _record(osm, SERVICES, nsd)
    function = function_of(osm, nsd)
    kind = "container" if function.container else "machine"
    desired = DesiredInstance(
        name,
        NO_DEPLOYMENT,
        function.name,
        kind,  # type: ignore[arg-type]
        nsd,
        vim,
        replicas,
        keys,
        values,
        namespace,
    )
    reconcile(osm, partial(find_owned, osm, name, NO_DEPLOYMENT), desired, record.record, wait_policy, notify)


def scale(osm: Osm, name: str, replicas: int, wait_policy: WaitPolicy, notify: Notify) -> None:
    """Set the number of replicas of an instance's function.

    Raises:
        SettingError: there is no such instance, or it isn't instantiated.
    """
    instance = _instantiated(osm, name)
    function = function_of(osm, instance.nsd)
    if function.container:
        if instance.values.get(REPLICA_COUNT_KEY) != replicas:
            body = upgrade_request(function.name, instance.values | {REPLICA_COUNT_KEY: replicas})
            _run(osm, instance, "action", body, wait_policy, notify)
        return
    by = 1 if replicas > instance.machine_count else -1
    for _ in range(abs(replicas - instance.machine_count)):
        _run(osm, instance, "scale", scale_request(by), WaitPolicy(wait_policy.timeout, True, wait_policy.stop), notify)


def heal(osm: Osm, name: str, wait_policy: WaitPolicy, notify: Notify) -> None:
    """Repair an instance: restart machines; upgrade a chart to its current values (Kubernetes heals pods itself).

    Raises:
        SettingError: there is no such instance, or it isn't instantiated.
    """
    instance = _instantiated(osm, name)
    function = function_of(osm, instance.nsd)
    if function.container:
        _run(osm, instance, "action", upgrade_request(function.name, instance.values), wait_policy, notify)
        return
    functions = osm.instance(instance.id).functions or ()
    broken = [{"vnfInstanceId": key, "cause": "asked for"} for key in functions]
    _run(osm, instance, "heal", {"healVnfData": broken}, wait_policy, notify)


def terminate(osm: Osm, name: str, wait_policy: WaitPolicy, notify: Notify) -> None:
    """Terminate an instance and keep its record.

    Raises:
        SettingError: there is no such instance.
    """
    instance = _find(osm, name)
    if instance.running_operation:
        wait_for_operation(osm, instance.name, instance.running_operation.record, wait_policy, notify)
        instance = _find(osm, name)
    if instance.instantiated:
        _run(osm, instance, "terminate", {}, WaitPolicy(wait_policy.timeout, True, wait_policy.stop), notify)


def delete_instance(osm: Osm, name: str, wait_policy: WaitPolicy, notify: Notify) -> None:
    """Wait for an instance's running operations, terminate it and delete its record.

    Raises:
        SettingError: there is no such instance.
    """
    instance = _find(osm, name)
    reconcile(osm, partial(find, osm, instance.id), None, "", wait_policy, notify)


def delete_packages(osm: Osm, ids: Sequence[str]) -> None:
    """Delete network services, then functions, by the ids of their descriptors.

    Raises:
        SettingError: an id doesn't exist. OsmError: a package is still in use.
    """
    found = [(where, one) for where in (SERVICES, FUNCTIONS) for one in osm.packages(where) if one.id in ids]
    missing = set(ids) - {one.id for _, one in found}
    if missing:
        raise SettingError(min(missing), *NOT_FOUND)
    for where, one in found:
        osm.remove(where, one.record)


def delete(osm: Osm, packages: Sequence[Package], wait_policy: WaitPolicy, notify: Notify) -> None:
    """Delete all that belongs to the given packages: instances, network services, functions."""
    services = {one.descriptor.id for one in packages if one.descriptor.type == "nsd"}
    for running in osm.instances():
        if running.descriptor in services:
            delete_instance(osm, running.record, wait_policy, notify)
    for one in sorted(packages, key=lambda one: one.descriptor.type):
        record = onboarding.record_of(one, osm.packages(collection_of(one)))
        if record:
            notify(f"removing {one.descriptor.id}")
            osm.remove(collection_of(one), record.record)


def function_of(osm: Osm, nsd: str) -> Function:
    """Function of a network service, given by the id of its descriptor.

    Raises:
        SettingError: OSM doesn't have the package.
    """
    names = _record(osm, SERVICES, nsd).functions or ("",)
    record = _record(osm, FUNCTIONS, names[0])
    units = record.charts or record.machines
    if not units:
        raise SettingError(nsd, "its function has neither a chart nor a machine", "Deploy another network service")
    return Function(units[0].name or units[0].id, bool(record.charts))


def _record(osm: Osm, collection: str, name: str) -> PackageRecord:
    found = next((one for one in osm.packages(collection) if name in (one.id, one.record)), None)
    if found is None:
        raise SettingError(name, "OSM has no such package", "Onboard it: scan2sim orchestrate onboard")
    return found


def _find(osm: Osm, name: str) -> Instance:
    instance = find(osm, name)
    if instance is None:
        raise SettingError(name, *NOT_FOUND)
    return instance


def _instantiated(osm: Osm, name: str) -> Instance:
    instance = _find(osm, name)
    if not instance.instantiated:
        raise SettingError(name, f"not running (state: {instance.state or 'created'})", "Instantiate it first")
    return instance


def _run(
    osm: Osm, instance: Instance, kind: str, body: Mapping[str, Any], wait_policy: WaitPolicy, notify: Notify
) -> None:
    operation = osm.start_operation(instance.id, kind, body)
    if wait_policy.wait:
        wait_for_operation(osm, instance.name, operation, wait_policy, notify)
